"""Full solutions that studies learn from and compare with, computed by worker processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Case, Method, Snapshots
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.workers import resume
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.validate.histories import loads_of, random_histories
from palpate.offline.validate.norms import relative
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

Steps = Sequence[tuple[Case, float]]
"""A history: cases, and the time (s) in which each is reached from the one before."""


class Fields(NamedTuple):
    """Displacements and von Mises stresses at the moments of a history."""

    displacements: NDArray[Any]  # (t, n, 3) mm
    stresses: NDArray[Any]  # (t, n) kPa

    @classmethod
    def of(cls, method: Method, states: Sequence[Any]) -> Fields:
        """Recover the fields of a method's states."""
        return cls(
            np.array([method.displacement(state) for state in states]),
            np.array([method.von_mises(state) for state in states]),
        )

    def errors(self, workshop: Workshop, exact: Fields) -> tuple[float, float]:
        """Relative L2 errors over the moments and all nodes, or those beyond the clamped layer."""
        kept = workshop.beyond_clamped_layer
        u, s = (field.astype(float) for field in exact)
        return relative(self.displacements, u), relative(self.stresses[:, kept], s[:, kept])


def full_solutions(
    title: str, loads: Sequence[Load], pool: Executor, checkpoint: Checkpoint
) -> Snapshots:
    """The loads that have an equilibrium, and their displacements."""
    tasks = {f"{title}-{len(loads)}-{i}": (Workshop.sample, load) for i, load in enumerate(loads)}
    found = resume(
        title, pool, checkpoint, tasks, lambda u: {"u": np.empty(0) if u is None else u.ravel()}
    )
    pairs = [(load, found[name]["u"]) for name, load in zip(tasks, loads, strict=True)]
    solved = [(load, u.astype(float)) for load, u in pairs if u.size]
    if not solved:
        raise PalpateError(f"{title}: no load has an equilibrium")
    return Snapshots([load for load, _ in solved], np.stack([u for _, u in solved]))


def random_steps(
    atlas: ReducedModel, workshop: Workshop, count: int, rng: np.random.Generator
) -> list[Steps]:
    """Random histories of footprints over the whole surface and range."""
    return [
        [(Case.of(workshop, load), dt) for load, dt in zip(*loads_of(presses), strict=True)]
        for presses in random_histories(atlas, count, rng)
    ]


def full_histories(
    histories: Mapping[str, Steps], tips: set[str], pool: Executor, checkpoint: Checkpoint
) -> dict[str, Fields]:
    """Full solutions of the histories that the full model can follow.

    Parameters
    ----------
    histories : mapping of str to Steps
        Of one contact each.
    tips : set of str
        Names of the histories of the rigid tip, whose contacts tell its centre.
    """

    def task(name: str) -> tuple[Any, ...]:
        loads = [case.contacts[0] for case, _ in histories[name]]
        times = [dt for _, dt in histories[name]]
        if name in tips:
            return Workshop.follow_tip, np.array([load.position for load in loads]), times
        return Workshop.follow, loads, times

    def pack(found: Sequence[Any] | None) -> dict[str, Any]:
        return {} if found is None else {"u": found[0], "s": found[1]}

    tasks = {name: task(name) for name in histories}
    found = resume("full histories", pool, checkpoint, tasks, pack)
    return {name: Fields(own["u"], own["s"]) for name, own in found.items() if own}


_kept: dict[float, Remeshed] = {}
"""Refined meshes of a worker process, kept from one task to the next."""


def refined(workshop: Workshop, scene: Scene, factor: float, load: Load) -> Array:
    """Displacement (n, 3) mm of a scene's nodes in a finer mesh, nan without an equilibrium.

    A task for ``run.workers``, all of one scene.
    """
    if factor not in _kept:
        _kept[factor] = Remeshed(scene, factor)
    answer = _kept[factor].solve(Case.of(workshop, load))
    if answer.converged:
        return _kept[factor].displacement(answer.state)
    return np.full((len(workshop.mesh.nodes), 3), np.nan)
