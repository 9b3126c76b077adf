"""Full solutions that studies learn from and compare with, computed by worker processes."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.body_mesh import own_mesh
from palpate.offline.fem.graded import FIT_FOR_FOOTPRINTS, Graded
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.methods.method import Case, Method, Snapshots, Steps
from palpate.offline.run.workers import Checkpoint, content_key, open_artifact, worker_pool
from palpate.offline.validate import compare
from palpate.offline.validate.queries import HISTORIES, LOADS
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene


class Fields(NamedTuple):
    """Displacements and von Mises stresses at the moments of a history.

    Stresses are without the near field of a contact, which is the same for all methods.
    """

    displacements: NDArray[Any]  # (t, n, 3) mm
    stresses: NDArray[Any]  # (t, n) kPa

    @classmethod
    def of(cls, method: Method, states: Sequence[Any]) -> Self:
        """Recover the fields of a method's states."""
        return cls(
            np.array([method.displacement(state) for state in states]),
            np.array([method.von_mises(state) for state in states]),
        )

    def errors(self, problem: FullProblem, exact: Self) -> tuple[float, float]:
        """Relative L2 errors over moments and volume, of stress over ``counted_volumes``."""
        volumes = problem.nodal_volumes, problem.counted_volumes
        moved, stress = (
            relative(own.swapaxes(0, 1), full.astype(float).swapaxes(0, 1), weights)
            for own, full, weights in zip(self, exact, volumes, strict=True)
        )
        return moved, stress

    def total_errors(
        self, problem: FullProblem, load: Load, exact: tuple[Array, Array]
    ) -> tuple[float, float]:
        """The same of the answer to a load, beside a graded mesh.

        Stress is recovered from the displacement, with the near field of the load.
        """
        u, volumes = self.displacements[-1].astype(float), problem.nodal_volumes
        stress = problem.von_mises(u, contact=problem.footprint(load))
        moved = relative(u, exact[0], volumes)
        return moved, relative(stress, exact[1], problem.counted_volumes)


def opened(artifact: Path, scene: Scene | None) -> tuple[ReducedModel, FullProblem]:
    """Reduced and full model of an artifact; of its scene with the files, or of tissue with time.

    Raises
    ------
    PalpateError
        If the artifact was trained on another scene.
    QueryError
        If there is no scene and its tissue is elastic.
    """
    if scene is None:
        return compare.opened(artifact, HISTORIES)
    atlas, problem = compare.opened(artifact)
    if atlas.scene.text != scene.text:
        raise PalpateError(f"{artifact}: trained on another scene than {scene.name!r}")
    return atlas, FullProblem(scene, problem.mesh, problem.surface)


@lru_cache(maxsize=4)
def of_tissue(problem: FullProblem, **changes: Any) -> FullProblem:
    """The same body of tissue that differs in what is given."""
    scene = problem.scene
    if all(getattr(scene.tissue, key) == value for key, value in changes.items()):
        return problem
    return FullProblem(scene.of_tissue(**changes), problem.mesh, problem.surface)


def kept_results(artifact: Path, scene: Scene, name: str, settings: object) -> Checkpoint:
    """What a killed study goes on from: named by all that its results depend on."""
    sha = hashlib.sha256(artifact.read_bytes() + str(settings).encode()).hexdigest()[:16]
    return Checkpoint(artifact.parent / f".{artifact.stem}.{name}", f"{content_key(scene)}-{sha}")


def in_parallel(
    artifact: Path,
    checkpoint: Checkpoint,
    title: str,
    tasks: Mapping[str, list[tuple[Any, ...]]],
) -> dict[str, list[Any]]:
    """Results of the tasks of each kind (``run.workers``), from worker processes or kept ones."""
    named = {f"{kind} {i}": task for kind, own in tasks.items() for i, task in enumerate(own)}
    with worker_pool(open_artifact, artifact) as pool:
        found = checkpoint.resume(title, pool, named)
    return {kind: [found[f"{kind} {i}"] for i in range(len(own))] for kind, own in tasks.items()}


def random_steps(
    atlas: ReducedModel, problem: FullProblem, count: int, rng: np.random.Generator, in_time: bool
) -> list[Steps]:
    """Random histories of footprints, or single loads, over the whole surface and range."""
    queries = (HISTORIES if in_time else LOADS).random(atlas, count, rng)
    return [[(Case.of(problem, load), load.dt) for load in query] for query in queries]


def followed(problem: FullProblem, steps: Steps, tip: bool = False) -> Fields | None:
    """The full model's answers, if it has any; a task for ``run.workers``.

    The steps are of one contact each, which tells the centre of the rigid tip if that presses.
    """
    contacts = [replace(case.contacts[0], dt=dt) for case, dt in steps]
    asked = [TipPosition(x.position, x.dt) if tip else x for x in contacts]
    found = problem.reference(asked, near_field=False)
    return None if found is None else Fields(found.u, found.s)


def snapshots(solved: Sequence[tuple[Steps, Fields | None]]) -> Snapshots:
    """What methods learn from full solutions of histories; an error if there are none."""
    found = [(steps, own) for steps, own in solved if own is not None]
    if not found:
        raise PalpateError("snapshots: the full model could follow none of the histories")
    loads = [case.contacts[0] for steps, _ in found for case, _ in steps]
    rows = np.concatenate([own.displacements for _, own in found]).astype(float)
    return Snapshots(loads, rows.reshape(len(rows), -1))


def graded(problem: FullProblem, scene: Scene, load: Load) -> tuple[Array, Array] | None:
    """What a mesh graded towards a load says at the nodes of a scene's own, if it has an answer.

    Displacement (n, 3) mm and von Mises stress (n,) kPa, the near field included.  A task for
    ``run.workers``; ``scene`` is the problem's with its files.
    """
    x, normal, _ = problem.surface.project(load.position)
    fine = Graded(scene, x, FIT_FOR_FOOTPRINTS)
    try:
        u, _ = fine.problem.press_at(x, normal, load.pressure * load.direction)
    except NoEquilibrium:
        return None
    stress = fine.problem.von_mises(u, contact=fine.problem.footprint(load))
    at = own_mesh(scene).sites
    return fine.at(at, u), fine.at(at, stress)
