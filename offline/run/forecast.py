"""What a training is about to make, and roughly how long that takes."""

from __future__ import annotations

from palpate.offline.choose.size import first_place, ladder
from palpate.offline.fem.problem import FullProblem
from palpate.offline.info import duration
from palpate.offline.reduce.sampling import spacing_count
from palpate.shared.scene import divisions_of

MODEL, MODEL_AND_DOF = 0.35, 1.75e-4
"""Core seconds that training takes for a local model, and more for each degree of freedom; all
stages shared out.  Measured on elastic scenes of 1900 to 7800 degrees of freedom, warm cache."""

TIP, TIME = 3.0, 2.0
"""How many times as long it takes for the rigid tip as well, and for visco-elastic tissue."""


def forecast(problem: FullProblem, workers: int) -> str:
    """Mesh, number of local models and time of a training, in one line for people."""
    scene = problem.scene
    dofs, size, more = problem.mesh.nodes.size, scene.training.size, ""
    if size is None:  # the size that training tries first
        size, more = ladder(scene.tissue)[max(first_place(scene.tolerance), 0)], " or more"
    models = spacing_count(problem.surface, size.patch_spacing)
    seconds = models * (MODEL + MODEL_AND_DOF * dofs) / workers
    seconds *= (TIP if scene.endoscope.tip else 1.0) * (TIME if scene.tissue.prony else 1.0)
    cores = "1 free core" if workers == 1 else f"{workers} free cores"
    return (
        f"{scene.name}: {' x '.join(map(str, divisions_of(scene.geometry)))} elements "
        f"{scene.geometry.element}, {dofs} DOFs; about {models}{more} local models; about "
        f"{duration(seconds)} on {cores}, and longer the first time, while code is compiled"
    )
