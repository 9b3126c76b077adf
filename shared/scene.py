"""What a scene is: what is pressed, by what, how accurately and how fast it must be answered.

A scene is one TOML file. `load_scene` reads it, `parse_scene` reads its text (an artifact keeps the
text verbatim, and nothing else is needed to get the scene back). Numbers are in mm, kPa, s and
degrees. Keys that are absent get defaults; lengths among them are multiples of the endoscope's
radius. Whatever is wrong is refused with one `SceneError` that names every field at fault.

The descriptions of the fields are the documentation of the keys: `palpate scene` prints them.
"""

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from palpate.shared.anatomy import CHOSEN, FileBody, LabelBody, MeshBody, SurfaceBody
from palpate.shared.errors import PalpateError
from palpate.shared.files import open_regular
from palpate.shared.mechanics.laws import AnyTissue
from palpate.shared.part import Fraction, Length, Part, Positive, in_radii, optional, times
from palpate.shared.place import Patch

ElementName = Literal["hex8", "hex20"]
Element = Annotated[ElementName, Field(description="hex20, or hex8, which locks")]

Division = Annotated[int, Field(ge=1, le=500)]
MOST_ELEMENTS = 200_000


def _not_too_many(divisions: tuple[int, int, int]) -> tuple[int, int, int]:
    if math.prod(divisions) > MOST_ELEMENTS:
        raise PydanticCustomError(
            "elements", "more than {most} elements in all", {"most": MOST_ELEMENTS}
        )
    return divisions


Divisions = Annotated[tuple[Division, Division, Division], AfterValidator(_not_too_many)]
Point2 = tuple[float, float]
WITHIN = ("any", "without", *range(100))
"""What in a path leads to a table within one of its own kind."""


class SceneError(PalpateError):
    """A scene that cannot be used; the message names the file, the field and what is allowed."""


class Extrusion(Part):
    """A cross-section in the x-z plane, extruded along y.

    The four corners split the outline into the sides `lip` (from the last corner to the first),
    `outer`, `tip` and `inner`, in this order round the section; the ends of the extrusion are
    `posterior` (y = 0) and `anterior` (y = length).
    """

    sides: ClassVar = "lip", "tip", "posterior", "anterior", "inner", "outer"
    """Low and high end of each axis of the mesh's lattice."""

    fineness: ClassVar = "divisions"

    kind: Literal["extrusion"] = Field(
        description="section along y; sides: lip, outer, tip, inner, posterior, anterior"
    )
    section: str = Field(
        min_length=1,
        description="CSV file beside the scene file: a line x,z, then 8 or more points around, mm, "
        "the first not repeated; a smooth curve runs through them, so sharp corners need many",
    )
    corners: tuple[Point2, Point2, Point2, Point2] = Field(
        description="points (x, z) of the outline, mm, clockwise (x right, z up); the side outer "
        "runs from the first to the second, then tip, inner, and lip back to the first; elements "
        "go across from each side to the opposite one, which should be about as long"
    )
    length: Length = Field(description="length along y, mm")
    element: Element = "hex20"
    divisions: Divisions | None = optional(
        CHOSEN, "elements [along the section, through it, along y]"
    )
    grading: float = Field(
        1.0,
        ge=1,
        le=3,
        description="depth over thickness = (layer / layers)^grading: thin layers outside",
    )
    lip_rows: int = Field(
        0,
        ge=0,
        le=6,
        description="more rows of ever shorter elements at the lip, its outermost layers thin: "
        "for one that is clamped",
    )


class Block(Part):
    """A box with one corner at the origin; its sides are named as seen along +y."""

    sides: ClassVar = "left", "right", "front", "back", "bottom", "top"
    """Low and high end of each axis of the mesh's lattice."""

    fineness: ClassVar = "divisions"

    kind: Literal["block"] = Field(description="box; sides: left, right, front, back, bottom, top")
    size: tuple[Length, Length, Length] = Field(description="lengths along [x, y, z], mm")
    element: Element = "hex20"
    divisions: Divisions | None = optional(CHOSEN, "elements along [x, y, z]")
    grading: float = Field(
        1.0,
        ge=1,
        le=3,
        description="depth below the top over height = (layer / layers)^grading: thin layers there",
    )


def divisions_of(geometry: Extrusion | Block) -> Divisions:
    """Divisions of a mesh; raise `SceneError` where they have yet to be chosen."""
    if geometry.divisions is None:
        raise SceneError("geometry.divisions: not given; palpate train chooses them")
    return geometry.divisions


class Endoscope(Part):
    """The instrument that presses."""

    radius: Length = Field(description="radius of the pressed footprint, and of the tip, mm")
    max_tilt: float = Field(
        ge=0, lt=90, description="largest angle of a load to the inward normal, degrees"
    )
    reach: Length = in_radii(1.5, "largest distance of a queried position from the body, mm")
    tip: bool = Field(
        False, description="whether a rigid spherical tip may press too, for sessions"
    )


class Load(Part):
    """How hard it presses."""

    max_indentation: Fraction = Field(
        description="largest displacement over local thickness; sets the range of pressures"
    )


class Errors(NamedTuple):
    """Relative errors of what is answered."""

    displacement: float
    von_mises: float
    force: float  # of the rigid tip


REDUCTION = Errors(3, 6, 3)
"""The tolerance over what the reduction may take of it; errors of mesh and reduction add up by
their squares, so that the mesh may take nearly all of it, too."""


class Tolerance(Part):
    """The errors an answer may have, those of mesh and reduction together."""

    displacement: Fraction = Field(0.03, description="relative L2 error over the volume")
    von_mises: Fraction = Field(0.12, description="relative L2 error over the unclamped volume")
    force: Fraction = Field(0.05, description="relative error of the force of a rigid tip")
    tip_displacement: Positive = times(2, "displacement", "error of displacement under a rigid tip")
    tip_von_mises: Positive = times(3, "von_mises", "error of stress under a rigid tip")

    def of(self, tip: bool) -> Self:
        """That of answers to loads, or under the tip, where all that moves is near the contact."""
        if not tip:
            return self
        own = {"displacement": self.tip_displacement, "von_mises": self.tip_von_mises}
        return self.model_copy(update=own)

    @property
    def total(self) -> Errors:
        """All of it."""
        return Errors(self.displacement, self.von_mises, self.force)

    @property
    def reduction(self) -> Errors:
        """What the reduced model may err by, beside the full model on the same mesh."""
        return Errors(*(most / parts for parts, most in zip(REDUCTION, self.total, strict=True)))

    @property
    def mesh(self) -> Errors:
        """What remains for the full model, beside an infinitely fine mesh."""
        pairs = zip(REDUCTION, self.total, strict=True)
        return Errors(*(math.sqrt(1 - parts**-2) * most for parts, most in pairs))

    @property
    def looseness(self) -> float:
        """How many times the reduction's is 1 % of displacement and 2 % of stress, at least 1.

        What training and the solver spend on more accuracy than asked for falls with it.
        """
        reduction = self.reduction
        return max(1.0, min(reduction.displacement / 0.01, reduction.von_mises / 0.02))

    def exceeded(self, errors: Iterable[float]) -> tuple[str, ...]:
        """Names of those of the total errors, in the order of ``Errors``, that are too large."""
        pairs = zip(Errors._fields, errors, self.total, strict=False)
        return tuple(name for name, error, most in pairs if not error <= most)


class Budget(Part):
    """The time a query may take."""

    query: Positive = Field(150e-6, description="time for one cold query, s")


class Size(Part):
    """How large a reduced model is."""

    patch_spacing: Length = Field(description="distance of the centres of local models, mm")
    modes: int = Field(ge=20, le=400, multiple_of=4, description="number of modes of a local model")
    cubature_points: int = Field(
        ge=16, le=5000, multiple_of=16, description="number of points of a local model"
    )
    region_modes: int = Field(ge=4, le=2000, description="number of modes of a region")

    @field_validator("region_modes")
    @classmethod
    def _hold_those_of_local_models(cls, region_modes: int, info: ValidationInfo) -> int:
        modes = info.data.get("modes", 0)
        if region_modes < modes:
            raise PydanticCustomError(
                "modes", "must be at least the {modes} of modes", {"modes": modes}
            )
        return region_modes


class Training(Part):
    """How the reduced model is trained."""

    limit_spacing: Length = in_radii(
        2.0, "distance of points where the largest pressure is found, mm"
    )
    region_spacing: Length = in_radii(3.75, "distance of the regions that share a basis, mm")
    blend: Positive = in_radii(0.1, "width over which neighbouring local models blend, mm")
    samples: int = Field(
        300,
        ge=60,
        description="full solutions to validate by, 60 or more; fewer are made for a looser "
        "tolerance",
    )
    size: Size | None = optional(
        "the smallest that meets the tolerance", "how large the reduced model is"
    )


class Scene(Part):
    """A whole scene. `text` is the TOML it was read from, `folder` where its files lie."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9-]*$",
        description="names the artifact and its URL: a to z, 0 to 9 and -",
    )
    description: str = Field(
        description="one line for people", json_schema_extra={"absent": "the name"}
    )
    seed: int = Field(1, ge=0, description="seed of all random numbers of training")
    geometry: Annotated[
        Extrusion | Block | SurfaceBody | MeshBody | LabelBody, Field(discriminator="kind")
    ] = Field(description="the shape of the body")
    tissue: Annotated[AnyTissue, Field(discriminator="law")] = Field(
        description="what the body is made of"
    )
    support: Patch = Field(description="what is held fixed")
    surface: Patch = Field(description="what the endoscope can touch")
    endoscope: Endoscope = Field(description="the instrument that presses")
    load: Load = Field(description="how hard it presses")
    tolerance: Tolerance = Field(
        description="errors of mesh and reduction together; a looser one is faster"
    )
    budget: Budget = Field(description="the time that a query may take")
    training: Training = Field(description="how the reduced model is trained")

    _text: str = PrivateAttr("")
    _folder: Path | None = PrivateAttr(None)

    @property
    def text(self) -> str:
        """The TOML text of the scene, verbatim."""
        return self._text

    @property
    def folder(self) -> Path | None:
        """Where the files named by the scene lie; None for a scene without files at hand."""
        return self._folder

    def of_tissue(self, **changes: Any) -> Self:
        """The same scene of tissue that differs in what is given; with ``young`` regions scale."""
        tissue = self.tissue
        if (young := changes.pop("young", None)) is not None:
            tissue = tissue.scaled(young / tissue.young)
        return self.model_copy(update={"tissue": tissue.model_copy(update=changes)})

    @property
    def lattice(self) -> Extrusion | Block:
        """Geometry of a body that is meshed by a lattice; raise `SceneError` for another."""
        if isinstance(self.geometry, FileBody):
            raise SceneError(
                f"geometry.kind = {self.geometry.kind!r}: this is for blocks and extrusions only"
            )
        return self.geometry

    @property
    def fineness_of_mesh(self) -> Divisions | float | None:
        """What the scene says of how fine its mesh is: `divisions`, or edges of `finest` mm."""
        said: Divisions | float | None = getattr(self.geometry, self.geometry.fineness)
        return said

    @field_validator("support", "surface")
    @classmethod
    def _body_has_such(cls, patch: Patch, info: ValidationInfo) -> Patch:
        body = info.context  # its kind, whatever else is wrong with it
        if body is None:
            return patch
        for table in patch.tables():
            if table.side is not None and table.side not in body.sides:
                raise PydanticCustomError(
                    "side",
                    "side is '{side}', but the sides of this body are {sides}",
                    {"side": table.side, "sides": ", ".join(body.sides) or "none"},
                )
            if table.set is not None and body not in (MeshBody, LabelBody):
                raise PydanticCustomError(
                    "set",
                    "set is '{set}', but only bodies of kind mesh or labels have sets",
                    {"set": table.set},
                )
        return patch


def _derived(data: dict[str, Any]) -> dict[str, Any]:
    """Fill in what follows from the name and the radius; an absent table is an empty one."""
    tables = {key: dict[str, Any]() for key, at in Scene.model_fields.items() if kinds_of(at)}
    data = {"description": str(data.get("name", ""))} | tables | data
    given = data["endoscope"]
    radius = given.get("radius") if isinstance(given, dict) else None
    # a wrong radius is an error by itself, and no reason for errors of what follows from it
    if not (isinstance(radius, int | float) and 0 < radius < 1e300):
        radius = 1.0
    for name, given in data.items():
        if part := _kind_of(name, given):
            lengths = {
                key: float(f"{said['radii'] * radius:.6g}")
                for key, field in part.model_fields.items()
                if "radii" in (said := _said(field))
            }
            data[name] = lengths | given
    return data


def _kind_of(name: str, given: Any) -> type[Part] | None:
    """Kind of a table of a scene; None if what is given is no table, or of no kind."""
    if not isinstance(given, dict):
        return None
    return _tables().get((name,)) or _tables().get((name, str(given.get("kind"))))


def _said(field: FieldInfo) -> dict[str, Any]:
    """What a field says of itself beyond pydantic's own attributes."""
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def absent(field: FieldInfo) -> str | None:
    """What stands for an absent key in words, None where it must not be absent or has a value."""
    return _said(field).get("absent")


def kinds_of(field: FieldInfo) -> list[type[Part]]:
    """Kinds of table that a field may hold, none if it holds a value."""
    kinds = get_args(field.annotation) or (field.annotation,)
    return [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Part)]


@cache
def _tables() -> dict[tuple[str, ...], type[Part]]:
    """Every kind of table of a scene by its path; where there are several, the last is the kind."""
    return dict(_walk(Scene, ()))


def _walk(part: type[Part], path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], type[Part]]]:
    yield path, part
    for name, field in part.model_fields.items():
        for kind in kinds_of(field):
            if kind is part:  # a table of its own kind within
                continue
            tag = field.discriminator
            own = get_args(kind.model_fields[tag].annotation) if isinstance(tag, str) else ()
            yield from _walk(kind, (*path, name, *own))


def load_scene(path: Path | str) -> Scene:
    """Read a scene file; raise `SceneError` if it is missing or wrong."""
    path = Path(path)
    try:
        with open_regular(path) as file:
            text = file.read().decode().replace("\r\n", "\n")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    return parse_scene(text, path.parent, source=str(path))


def parse_scene(text: str, folder: Path | None = None, source: str = "scene") -> Scene:
    """Make a scene of its TOML text.

    Parameters
    ----------
    text : str
        The TOML text.
    folder : Path, optional
        Where files named by the scene lie; only building the mesh needs it.
    source : str
        What error messages call the text.

    Raises
    ------
    SceneError
        With every field that is wrong, its value and what is allowed.
    """
    try:
        data = _derived(tomllib.loads(text))
        scene = Scene.model_validate_json(
            json.dumps(data, default=str), context=_kind_of("geometry", data["geometry"])
        )
    except ValidationError as error:
        faults = [
            _explain(dict(detail))
            for detail in error.errors(include_url=False)
            if detail["type"] != "default_factory_not_called"  # what follows from a wrong value
        ]
        between = "\n  " if len(faults) > 1 else " "
        raise SceneError(between.join([f"{source}:", *faults])) from error
    except (ValueError, RecursionError) as error:  # of integers without an end as well
        raise SceneError(f"{source}: not TOML: {error}") from error
    scene._text = text
    scene._folder = folder
    return scene


def _explain(detail: dict[str, Any]) -> str:
    """One pydantic complaint as `field.path = value: what is wrong`."""
    tables, loc, kind = _tables(), detail["loc"], detail["type"]
    # The tag of a discriminated union is in pydantic's path, but not in the file.
    steps = [loc[i] for i in range(len(loc)) if loc[:i] in tables or loc[: i + 1] not in tables]
    path = ".".join(map(str, steps)) or "scene"
    table = tables.get(tuple(step for step in loc[:-1] if step not in WITHIN))
    if table and kind == "extra_forbidden":
        near = difflib.get_close_matches(loc[-1], table.model_fields, n=1, cutoff=0.5)
        known = (
            f"did you mean {near[0]!r}?" if near else f"known are {', '.join(table.model_fields)}"
        )
        return f"{path}: unknown key; {known}"
    if table and kind == "missing":
        return f"{path}: missing ({table.model_fields[loc[-1]].description})"
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        key, given = detail["ctx"]["discriminator"].strip("'"), detail["ctx"].get("tag")
        kinds = (
            f"{own[-1]}, which needs {', '.join(_needed(part, key))}"
            for own, part in tables.items()
            if own and own[:-1] == loc
        )
        wrong = ": missing" if given is None else f" = {given!r}: not known"
        return f"{path}.{key}{wrong} (one of {'; '.join(kinds)})"
    shown = "" if isinstance(detail["input"], dict) else f" = {detail['input']!r}"
    return f"{path}{shown}: {detail['msg']}"


def _needed(part: type[Part], tag: str) -> list[str]:
    """Keys that a kind of table must have beside the ``tag`` that names it."""
    fields = part.model_fields.items()
    needed = (name for name, field in fields if field.is_required() and absent(field) is None)
    return [name for name in needed if name != tag]
