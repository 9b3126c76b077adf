"""Full solutions that studies learn from and compare with, computed by worker processes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load, Step, TipPosition
from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Case, Method, Snapshots, Steps
from palpate.offline.reduce.queries import random_histories, random_loads
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.workers import resume
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]


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

    @classmethod
    def at_once(cls, problem: FullProblem, displacements: Sequence[Array]) -> Fields:
        """Fields of tissue that remembers nothing, with displacements (3 n,) or (n, 3) mm."""
        u = np.reshape(displacements, (len(displacements), -1, 3))
        return cls(u, np.array([problem.von_mises(x) for x in u]))

    def errors(self, problem: FullProblem, exact: Fields) -> tuple[float, float]:
        """Relative L2 errors over the moments and all nodes, or those beyond the clamped layer."""
        kept = problem.beyond_clamped_layer
        u, s = (field.astype(float) for field in exact)
        return relative(self.displacements, u), relative(self.stresses[:, kept], s[:, kept])


def kept_results(artifact: Path, scene: Scene, name: str, settings: object) -> Checkpoint:
    """What a killed study goes on from: named by all that its results depend on."""
    sha = hashlib.sha256(artifact.read_bytes() + str(settings).encode()).hexdigest()[:16]
    return Checkpoint(artifact.parent / f".{artifact.stem}.{name}", f"{content_key(scene)}-{sha}")


def random_steps(
    atlas: ReducedModel, problem: FullProblem, count: int, rng: np.random.Generator, in_time: bool
) -> list[Steps]:
    """Random histories of footprints, or single loads, over the whole surface and range."""
    if in_time:
        histories = random_histories(atlas, count, rng)
    else:
        histories = [[load] for load in random_loads(atlas, count, rng)]
    return [[(Case.of(problem, load), load.dt) for load in history] for history in histories]


def full_histories(
    histories: Mapping[str, Steps],
    pool: Executor,
    checkpoint: Checkpoint,
    tips: frozenset[str] = frozenset(),
) -> dict[str, Fields]:
    """Full solutions of the histories that the full model can follow.

    Parameters
    ----------
    histories : mapping of str to Steps
        Of one contact each.
    tips : set of str
        Names of the histories of the rigid tip, whose contacts tell its centre.
    """
    queries: dict[str, list[Step]] = {}
    for name, steps in histories.items():
        contacts = [replace(case.contacts[0], dt=dt) for case, dt in steps]
        queries[name] = [
            TipPosition(load.position, load.dt) if name in tips else load for load in contacts
        ]
    tasks = {name: (FullProblem.reference, query) for name, query in queries.items()}
    found = resume("full histories", pool, checkpoint, tasks)
    return {name: Fields(own.u, own.s) for name, own in found.items() if own is not None}


def snapshots(histories: Sequence[Steps], found: Sequence[Fields]) -> Snapshots:
    """What methods learn from full solutions of histories; an error if there are none."""
    if not found:
        raise PalpateError("snapshots: the full model could follow none of the histories")
    loads = [case.contacts[0] for steps in histories for case, _ in steps]
    rows = np.concatenate([own.displacements for own in found]).astype(float)
    return Snapshots(loads, rows.reshape(len(rows), -1))


_kept: dict[float, Remeshed] = {}
"""Refined meshes of a worker process, kept from one task to the next."""


def refined(problem: FullProblem, scene: Scene, factor: float, load: Load) -> Array:
    """Displacement (n, 3) mm of a scene's nodes in a finer mesh, nan without an equilibrium.

    A task for ``run.workers``, all of one scene.
    """
    if factor not in _kept:
        _kept[factor] = Remeshed(scene, factor)
    answer = _kept[factor].solve(Case.of(problem, load))
    if answer.converged:
        return _kept[factor].displacement(answer.state)
    return np.full((len(problem.mesh.nodes), 3), np.nan)
