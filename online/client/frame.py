"""Where a program's own coordinates lie in those of a scene's body."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError

ROUND_OFF = 1e-6
"""By which the product of a rotation's rows may differ from the identity."""


class Frame(NamedTuple):
    """A program's coordinates: ``position of the body (mm) = origin + unit * rotation @ own``.

    Make one with `of`, which checks it. Points, directions and so on are the last axis of arrays.

    Examples
    --------
    A game engine in metres whose y points up and whose z points to the viewer:

    >>> frame = Frame.of([[1, 0, 0], [0, 0, -1], [0, 1, 0]], origin=(5, 20, 10), unit=1000.0)
    >>> frame.to_body([0.001, 0.002, 0.0]).tolist()
    [6.0, 20.0, 12.0]
    """

    rotation: Array  # (3, 3); left-handed coordinates have a mirror in it
    origin: Array  # (3,) mm, of the program's coordinates in the body
    unit: float  # mm that the program's unit of length is
    newton: float  # mN that the program's unit of force is

    @classmethod
    def of(
        cls,
        rotation: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        origin: ArrayLike = (0, 0, 0),
        unit: float = 1.0,
        newton: float = 1.0,
    ) -> Self:
        """A frame; raise `PalpateError` where the rotation is none, or a unit is not above 0."""
        turn, start = np.asarray(rotation, float), np.asarray(origin, float)
        if turn.shape != (3, 3) or not np.abs(turn @ turn.T - np.eye(3)).max() < ROUND_OFF:
            raise PalpateError("rotation: must be 3 x 3, its rows unit vectors at right angles")
        if start.shape != (3,) or not np.isfinite(start).all():
            raise PalpateError("origin: must be three finite numbers, mm")
        if not (0.0 < unit < np.inf and 0.0 < newton < np.inf):
            raise PalpateError("unit, newton: must be above 0")
        return cls(turn, start, unit, newton)

    def to_body(self, positions: ArrayLike) -> Array:
        """Positions of the program in the body, mm."""
        return self.origin + self.unit * (np.asarray(positions, float) @ self.rotation.T)

    def from_body(self, positions: ArrayLike) -> Array:
        """Positions of the body (mm) in the program."""
        return (np.asarray(positions, float) - self.origin) @ self.rotation / self.unit

    def displacements(self, moved: ArrayLike) -> Array:
        """Displacements of the body (mm) in the program."""
        return np.asarray(moved, float) @ self.rotation / self.unit

    def directions(self, normals: ArrayLike) -> Array:
        """Unit vectors of the body, such as normals, in the program."""
        return np.asarray(normals, float) @ self.rotation

    def forces(self, forces: ArrayLike) -> Array:
        """Forces of the body (mN) in the program."""
        return np.asarray(forces, float) @ self.rotation / self.newton

    def tangent(self, tangent: ArrayLike) -> Array:
        """Derivative of a force in a position (mN/mm) in the program's units."""
        turned: Array = self.rotation.T @ np.asarray(tangent, float) @ self.rotation
        return turned * (self.unit / self.newton)
