"""Places of a body, as a scene names them: what is held, what can be touched, what is of its own.

A place is made of the faces or elements for which every key of its table holds.  On the boundary
`any` holds where one of its tables does, `without` where its table does not, so that places are
joined by and, or and not.
"""

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from palpate.shared.part import Length, Part, optional

Range = tuple[float, float]
Point = tuple[float, float, float]
Angle = Annotated[float, Field(gt=0, lt=180)]


class Place(Part):
    """Where something is: all keys hold, judged at the centres of faces or elements."""

    together: ClassVar[tuple[tuple[str, str], ...]] = (("near", "radius"),)
    """Keys that say nothing without each other."""

    x: Range | None = optional("all of it", "[from, to] mm")
    y: Range | None = optional("all of it", "[from, to] mm")
    z: Range | None = optional("all of it", "[from, to] mm")
    near: Point | None = optional("all of it", "point [x, y, z] mm")
    radius: Length | None = optional("needed with near", "largest distance from that point, mm")
    set: str | None = optional("all of it", "named set of the body's file, or a label")

    @classmethod
    def places(cls) -> tuple[str, ...]:
        """Keys that say where."""
        return tuple(cls.model_fields)

    @model_validator(mode="after")
    def _says_a_place(self) -> Self:
        if not self.model_fields_set.intersection(self.places()):
            keys = ", ".join(self.places())
            raise PydanticCustomError("place", "must name a place: one of {keys}", {"keys": keys})
        for axis in "xyz":
            bounds = getattr(self, axis)
            if bounds is not None and not bounds[0] <= bounds[1]:
                raise PydanticCustomError(
                    "range", "{axis} must be [from, to] with from <= to", {"axis": axis}
                )
        for pair in self.together:
            given = [key for key in pair if getattr(self, key) is not None]
            if len(given) == 1:
                (missing,) = {*pair} - {*given}
                raise PydanticCustomError(
                    "pair", "{given} needs {missing}", {"given": given[0], "missing": missing}
                )
        return self

    def said(self) -> list[str]:
        """What the table says, in parts for people."""
        ranges = [(axis, getattr(self, axis)) for axis in "xyz"]
        said = [f"{axis} {r[0]:g} to {r[1]:g} mm" for axis, r in ranges if r]
        if self.near is not None:
            said.append(f"within {self.radius:g} mm of {_point(self.near)}")
        if self.set is not None:
            said.append(f"set {self.set}")
        return said


class Patch(Place):
    """Part of a body's boundary."""

    together: ClassVar = (("normal", "within"), *Place.together, ("close_to", "distance"))

    side: str | None = optional(
        "all sides", "side of a block or an extrusion, such as top or outer"
    )
    normal: Point | None = optional("all of it", "direction [x, y, z] of outward normals")
    within: Angle | None = optional(
        "needed with normal", "largest angle of outward normals to it, degrees"
    )
    close_to: str | None = optional(
        "all of it", "file of another surface (STL, OBJ, PLY), in the unit of the body's own"
    )
    distance: Length | None = optional(
        "needed with close_to", "largest distance from that surface, mm"
    )
    set: str | None = optional(
        "all of it", "named set of the body's file; of labels, one that the body borders on"
    )
    any: tuple["Patch", ...] | None = optional(
        "all of it", "list of such tables, one of which holds"
    )
    without: "Patch | None" = optional("nothing", "such a table, which does not hold")

    @model_validator(mode="after")
    def _can_be_found(self) -> Self:
        if self.normal is not None and not math.hypot(*self.normal) > 0:
            raise PydanticCustomError("normal", "normal must have a length")
        if self.any is not None and not self.any:
            raise PydanticCustomError("any", "any must list a table at least")
        return self

    def tables(self) -> Iterator["Patch"]:
        """The table itself and all within it."""
        yield self
        for other in (*(self.any or ()), *([self.without] if self.without else [])):
            yield from other.tables()

    def in_words(self) -> str:
        """What the table says, in a line for people."""
        said = self.said() if self.side is None else [f"side {self.side}", *self.said()]
        if self.normal is not None:
            said.append(f"normals within {self.within:g} degrees of {_point(self.normal)}")
        if self.close_to is not None:
            said.append(f"within {self.distance:g} mm of {self.close_to}")
        if self.any is not None:
            said.append(f"({' or '.join(other.in_words() for other in self.any)})")
        if self.without is not None:
            said.append(f"without ({self.without.in_words()})")
        return ", ".join(said)


def _point(coordinates: Point) -> str:
    return f"({', '.join(f'{x:g}' for x in coordinates)})"
