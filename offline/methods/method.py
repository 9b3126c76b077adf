"""What every method of deforming tissue has in common: it answers loads, one after the other.

``Method.step`` is what studies time: everything that depends on the load and that a user waits for,
but no field of mesh size.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.terms import Past
from palpate.shared.arrays import Array, Ints

Foot = tuple[Array, Array]
"""Where a contact presses, mm, and the normal there."""


@dataclass(frozen=True)
class Case:
    """Footprints that press at the same time, and the nodal forces they amount to."""

    contacts: tuple[Load, ...]
    nodes: Ints  # (k,) that are loaded
    forces: Array  # (k, 3) mN, on those
    feet: tuple[Foot, ...] = ()
    radius: float | None = None  # mm, of the footprints; the scene's if absent

    @classmethod
    def of(
        cls,
        problem: FullProblem,
        *contacts: Load,
        feet: Sequence[Foot] = (),
        radius: float | None = None,
    ) -> Case:
        """Case of footprints, pressed on the accessible surface unless ``feet`` are given."""
        feet = feet or [problem.surface.project(contact.position)[:2] for contact in contacts]
        forces = np.zeros((len(problem.mesh.nodes), 3))
        for contact, foot in zip(contacts, feet, strict=True):
            weights = contact.pressure * problem.unit_load_at(*foot, radius)
            forces += np.outer(weights, contact.direction)
        nodes = np.flatnonzero(forces.any(axis=1))
        return cls(contacts, nodes, forces[nodes], tuple(feet), radius)

    @classmethod
    def of_tip(cls, position: Array, direction: Array) -> Case:
        """Case of the rigid tip with its centre at a position; its nodal forces are not known."""
        return cls((Load(position, direction, 0.0),), np.empty(0, np.int64), np.empty((0, 3)))

    def load(self, nodes: int) -> Array:
        """Nodal forces (nodes, 3) mN of the whole body."""
        load = np.zeros((nodes, 3))
        load[self.nodes] = self.forces
        return load


Steps = Sequence[tuple[Case, float]]
"""A history: cases, and the time (s) in which each is reached from the one before."""


@dataclass(frozen=True)
class Snapshots:
    """Full solutions to learn from."""

    loads: Sequence[Load]
    displacements: Array  # (k, 3 n) mm


@dataclass(frozen=True)
class Answer:
    """Result of a method's step.

    Its fields are recovered from the state of the body at the end of the step, from which the next
    step starts.  Without an answer that is the state before the step.
    """

    state: Any
    converged: bool = True  # whether there is an answer at all
    doubted: bool = False  # whether the method says that it may be wrong; most cannot tell
    refused: bool = False  # whether the method declined the case instead of trying

    @property
    def trusted(self) -> bool:
        """Whether the method vouches for the answer."""
        return self.converged and not self.doubted


class Method(ABC):
    """A way to answer cases: how many numbers it solves for in a step, and that for people."""

    def __init__(self, problem: FullProblem, unknowns: int, label: str) -> None:
        self.problem, self.unknowns, self.label = problem, unknowns, label

    def at_rest(self) -> Any:
        """State of a body to which nothing has happened: None, unless a method remembers more."""
        return None

    @abstractmethod
    def step(self, state: Any, case: Case, dt: float = 0.0) -> Answer:
        """Answer a case that is reached ``dt`` (s) after a state, which is not changed.

        A load without an answer is reported, not raised.

        Raises
        ------
        ValueError
            If the method knows time and ``dt`` is negative or not a number.
        """

    @abstractmethod
    def field(self, state: Any) -> Array:
        """Nodal displacement (n, 3) mm of an answer."""

    def displacement(self, state: Any) -> Array:
        """Nodal displacement (n, 3) mm of an answer, or at rest."""
        return np.zeros_like(self.problem.mesh.nodes) if state is None else self.field(state)

    def past(self, state: Any) -> Past | None:
        """What the tissue remembers in a state: nothing, unless a method knows time."""
        return None

    def von_mises(self, state: Any) -> Array:
        """Nodal von Mises stress (n,) kPa."""
        return self.problem.von_mises(self.displacement(state), self.past(state))

    def solve(self, case: Case) -> Answer:
        """Answer a case from rest: one step of no time."""
        return self.step(self.at_rest(), case)
