"""What every method of deforming tissue has in common: it answers loads, one after the other.

A study asks many methods the same cases.  ``Method.step`` is what is timed: everything that depends
on the load and that a user waits for, but no field of mesh size.  ``displacement`` and
``von_mises`` recover the fields.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.problem import FullProblem, Load

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Footprints that press at the same time, and the nodal forces they amount to.

    Attributes
    ----------
    nodes : ndarray, shape (k,), int
        The loaded nodes.
    forces : ndarray, shape (k, 3), mN
        On the loaded nodes.
    shares : ndarray, shape (contacts, k), mN
        The part of each contact, in its direction.
    radius : float, optional
        Of the footprints, mm; the scene's if absent.
    """

    contacts: tuple[Load, ...]
    nodes: NDArray[np.int64]
    forces: Array = field(repr=False)
    shares: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    radius: float | None = None

    @classmethod
    def of(cls, problem: FullProblem, *contacts: Load) -> Case:
        """Case of one or more pressed footprints on a scene's body."""
        return cls.pressed(contacts, [problem.unit_load(x.position)[0] for x in contacts])

    @classmethod
    def pressed(
        cls, contacts: tuple[Load, ...], weights: Sequence[Array], radius: float | None = None
    ) -> Case:
        """Case of contacts, each with the nodal weights (n,) mm^2 of its unit pressure."""
        shares = np.array([x.pressure * own for x, own in zip(contacts, weights, strict=True)])
        nodes = np.flatnonzero(np.any(shares != 0.0, axis=0))
        directions = np.array([contact.direction for contact in contacts])
        return cls(contacts, nodes, shares[:, nodes].T @ directions, shares[:, nodes], radius)

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
    """Full solutions to learn from: loads, and displacements (k, 3 n) mm."""

    loads: Sequence[Load]
    displacements: Array


@dataclass(frozen=True)
class Answer:
    """Result of a method's step.

    Attributes
    ----------
    state : object
        State of the body at the end of the step: its fields are recovered from it, and the next
        step starts from it.  Without an answer, the state before the step.
    converged : bool
        Whether the method reports an answer at all.
    doubted : bool
        Whether the method says that the answer may be wrong.  Most cannot tell.
    refused : bool
        Whether it declined the case instead of trying.
    """

    state: Any = field(repr=False)
    converged: bool = True
    iterations: int = 0
    doubted: bool = False
    refused: bool = False

    @property
    def trusted(self) -> bool:
        """Whether the method vouches for the answer."""
        return self.converged and not self.doubted


class Method(ABC):
    """A way to answer cases.

    Parameters
    ----------
    problem : FullProblem
        Of the scene.
    unknowns : int
        Numbers solved for in a step.
    label : str
        Describes the size of the method, for people.
    """

    def __init__(self, problem: FullProblem, unknowns: int, label: str) -> None:
        self.problem, self.unknowns, self.label = problem, unknowns, label

    def at_rest(self) -> Any:
        """State of a body to which nothing has happened: None, unless a method remembers more."""
        return None

    @abstractmethod
    def step(self, state: Any, case: Case, dt: float = 0.0) -> Answer:
        """Answer a case that is reached ``dt`` (s) after a state, which is not changed.

        Methods for elastic tissue depend on the case alone.  A load without an answer is reported,
        not raised.

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

    def von_mises(self, state: Any) -> Array:
        """Nodal von Mises stress (n,) kPa."""
        return self.problem.von_mises(self.displacement(state))

    def solve(self, case: Case) -> Answer:
        """Answer a case from rest: one step of no time."""
        return self.step(self.at_rest(), case)

    def follow(self, steps: Iterable[tuple[Case, float]]) -> list[Any]:
        """States at the ends of steps, one after the other from rest."""
        states = [self.at_rest()]
        for case, dt in steps:
            states.append(self.step(states[-1], case, dt).state)
        return states[1:]
