"""Compile what training and queries run before it is needed, by as many workers as there are.

Workers that need a kernel at the same time would each compile it.
"""

import numpy as np

from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.sphere import FORCE
from palpate.offline.reduce.footprint_models import LocalTrainer, untrained
from palpate.offline.reduce.load_range import untested
from palpate.offline.reduce.ritz import Footprint
from palpate.shared.arrays import Array
from palpate.shared.local_models import LocalModels
from palpate.shared.mechanics.footprint import LIMIT_FIELDS
from palpate.shared.mechanics.tip import EDGE_FIELD
from palpate.shared.model import ReducedModel
from palpate.shared.near_field import Contact
from palpate.shared.reduced.points import LANES
from palpate.shared.stress_field import StressField


def compile_tip(problem: FullProblem) -> None:
    """Queries of the tip, on a model of nothing."""
    if problem.scene.endoscope.tip:
        model, x = _queried(problem, _nothing(problem)), _above(problem)
        model.touch(x)
        model.touch_many([x])


def compile_loads(problem: FullProblem) -> None:
    """Queries of loads, and what local models are trained with."""
    models, x = _nothing(problem), problem.surface.vertices[0]
    model = _queried(problem, models)
    model.press(x, 0.0)
    model.solve_many([x], [0.0])
    LocalTrainer(problem, models).tangent_changes(np.zeros((1, LANES)))


def compile_fields(problem: FullProblem) -> None:
    """Stress of both models, and the rigid sphere of references."""
    x, normal = problem.surface.vertices[0], problem.surface.normals[0]
    radius = problem.scene.endoscope.radius
    contact = Contact(x, normal, np.zeros(EDGE_FIELD), -normal, radius)
    still = np.zeros((len(problem.mesh.nodes), 3))
    singly = StressField(problem.body, np.float32), still.astype(np.float32)
    for field, u in ((problem.stress_field, still), singly):
        field.von_mises(u, None, contact)
        field.peaks(u, None, contact)
    if problem.scene.endoscope.tip:
        problem.contact.touch(_above(problem), still, FORCE)


KERNELS = compile_tip, compile_fields, compile_loads
"""The first takes longest, and the last shares much with it."""


def _nothing(problem: FullProblem) -> LocalModels:
    """A local model whose modes are zero."""
    at = Footprint(problem.surface.vertices[0], problem.surface.normals[0], 1.0)
    whole, mix = np.zeros((LANES, LANES), np.int16), np.zeros((LANES, LANES), np.float32)
    states = np.zeros((len(problem.model.free), LANES))
    return untrained(problem, states, at, 1.0, whole, mix)


def _queried(problem: FullProblem, models: LocalModels) -> ReducedModel:
    return untested(problem, models, np.ones((len(problem.surface.vertices), LIMIT_FIELDS)))


def _above(problem: FullProblem) -> Array:
    """A place (3,) mm of the tip off the tissue."""
    surface, radius = problem.surface, problem.scene.endoscope.radius
    return surface.vertices[0] + 2.0 * radius * surface.normals[0]
