"""What a scene is: what is pressed, by what, how accurately and how fast it must be answered.

A scene is one TOML file. `load_scene` reads it, `parse_scene` reads its text (an artifact keeps the
text verbatim, and nothing else is needed to get the scene back). Numbers are in mm, kPa, s and
degrees. Whatever is wrong is refused with a `SceneError` that names the field.
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from palpate.shared.errors import PalpateError

ElementName = Literal["hex8", "hex8-mean-dilatation", "hex8-fbar", "hex20"]

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Divisions = tuple[
    Annotated[int, Field(ge=1, le=500)],
    Annotated[int, Field(ge=1, le=500)],
    Annotated[int, Field(ge=1, le=500)],
]
Point2 = tuple[float, float]
Range = tuple[float, float]


class SceneError(PalpateError):
    """A scene that cannot be used; the message names the file, the field and what is allowed."""


class _Part(BaseModel):
    """A table of the scene file: immutable, strict about types, closed to unknown keys."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        """Say which valid name an unknown key is nearest to, which `extra="forbid"` cannot."""
        valid = list(cls.model_fields)
        for key in data if isinstance(data, dict) else ():
            if key not in valid:
                near = difflib.get_close_matches(key, valid, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}?" if near else f"valid are {', '.join(valid)}"
                raise PydanticCustomError(
                    "unknown_key", "unknown key '{key}'; {hint}", {"key": key, "hint": hint}
                )
        return data


class Extrusion(_Part):
    """A cross-section in the x-z plane, extruded along y.

    The four corners split the outline into the sides `lip` (from the last corner to the first),
    `outer`, `tip` and `inner`, in this order round the section; the ends of the extrusion are
    `posterior` (y = 0) and `anterior` (y = length).
    """

    kind: Literal["extrusion"]
    section: str = Field(min_length=1, description="CSV file of the outline, beside the scene file")
    corners: tuple[Point2, Point2, Point2, Point2] = Field(
        description="(x, z) mm: lip-outer, outer-tip, tip-inner and inner-lip corner"
    )
    length: Positive = Field(description="mm, along y")
    element: ElementName
    divisions: Divisions | None = Field(
        None,
        description="elements [along the section, through it, along y]; chosen if absent",
    )
    grading: float = Field(
        1.0,
        ge=1,
        le=3,
        description="thins the elements towards the outer side: depth = (layer / layers)^grading",
    )

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of the sides: low and high end of each axis of the mesh's lattice."""
        return ("lip", "tip", "posterior", "anterior", "inner", "outer")


class Block(_Part):
    """A box with one corner at the origin; its sides are named as seen along +y."""

    kind: Literal["block"]
    size: tuple[Positive, Positive, Positive] = Field(description="[x, y, z] mm")
    element: ElementName
    divisions: Divisions | None = Field(
        None, description="elements along [x, y, z]; chosen if absent"
    )

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of the sides: low and high end of each axis of the mesh's lattice."""
        return ("left", "right", "front", "back", "bottom", "top")


def divisions_of(geometry: Extrusion | Block) -> Divisions:
    """Divisions of a mesh; raise `SceneError` where they have yet to be chosen."""
    if geometry.divisions is None:
        raise SceneError("geometry.divisions: not given; palpate train chooses them")
    return geometry.divisions


class Tissue(_Part):
    """What the body is made of."""

    law: Literal["neo-hookean"]
    young: Positive = Field(description="Young's modulus at rest, kPa")
    poisson: float = Field(ge=0, lt=0.5, description="Poisson's ratio at rest")
    prony: tuple[tuple[Fraction, Positive], ...] = Field(
        (),
        max_length=6,
        description="[[share, time constant in s], ...]: what the isochoric stress loses with time",
    )

    @model_validator(mode="after")
    def _some_stiffness_stays(self) -> Tissue:
        total = sum(share for share, _ in self.prony)
        if not total < 1.0:
            raise PydanticCustomError(
                "prony",
                "the shares of prony must sum to less than 1, not {total}",
                {"total": total},
            )
        return self


class Patch(_Part):
    """The part of one side of the body whose points lie within the given ranges."""

    side: str
    x: Range | None = Field(None, description="[from, to] mm")
    y: Range | None = Field(None, description="[from, to] mm")
    z: Range | None = Field(None, description="[from, to] mm")

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Patch:
        for axis in "xyz":
            bounds = getattr(self, axis)
            if bounds is not None and not bounds[0] <= bounds[1]:
                raise PydanticCustomError(
                    "range", "{axis} must be [from, to] with from <= to", {"axis": axis}
                )
        return self


class Endoscope(_Part):
    """The instrument that presses."""

    radius: Positive = Field(description="of the pressed footprint, and of the tip, mm")
    max_tilt: float = Field(ge=0, lt=90, description="of the load from the inward normal, degrees")
    reach: Positive = Field(description="largest distance of a queried position from the body, mm")
    tip: bool = Field(False, description="whether to train it as a rigid spherical tip, too")


class Load(_Part):
    """How hard it presses."""

    max_indentation: Fraction = Field(
        description="largest displacement over local thickness; training finds the pressure that "
        "causes it at every contact point, pressed along the normal"
    )


class Tolerance(_Part):
    """The errors a query may have against the full model on the same mesh."""

    displacement: Fraction = Field(description="relative L2 error over all nodes")
    von_mises: Fraction = Field(description="relative L2 error over all unclamped nodes")

    @property
    def looseness(self) -> float:
        """How many times it is 1 % of displacement and 2 % of stress, at least 1.

        What training and the solver spend on more accuracy than asked for falls with it.
        """
        return max(1.0, min(self.displacement / 0.01, self.von_mises / 0.02))


class Budget(_Part):
    """The time a query may take."""

    query: Positive = Field(description="time for one cold query, s")


class Size(_Part):
    """How large a reduced model is."""

    patch_spacing: Positive = Field(description="of the centres of local models, mm")
    modes: int = Field(ge=20, le=400, multiple_of=4, description="of a local model's wide space")
    cubature_points: int = Field(ge=16, le=5000, multiple_of=16, description="of a local model")
    region_modes: int = Field(ge=4, le=2000, description="of a region")


class Training(_Part):
    """How the reduced model is trained."""

    limit_spacing: Positive = Field(description="of points where the largest pressure is found, mm")
    region_spacing: Positive = Field(description="of the regions that share a basis, mm")
    blend: Positive = Field(description="width over which neighbouring local models blend, mm")
    samples: int = Field(ge=60, description="full solutions that validate and calibrate, at most")
    size: Size | None = Field(
        None, description="of the reduced model; if absent, the smallest that meets the tolerance"
    )


class Scene(_Part):
    """A whole scene. `text` is the TOML it was read from, `folder` where its files lie."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", description="names the artifact and its URL")
    description: str
    seed: int = Field(ge=0)
    geometry: Annotated[Extrusion | Block, Field(discriminator="kind")]
    tissue: Tissue
    support: Patch = Field(description="what is held fixed")
    surface: Patch = Field(description="what the endoscope can touch")
    endoscope: Endoscope
    load: Load
    tolerance: Tolerance
    budget: Budget
    training: Training

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

    @model_validator(mode="after")
    def _sides_exist(self) -> Scene:
        for name in ("support", "surface"):
            side = getattr(self, name).side
            if side not in self.geometry.sides:
                raise PydanticCustomError(
                    "side",
                    "{name}.side is '{side}', but the sides of this body are {sides}",
                    {"name": name, "side": side, "sides": ", ".join(self.geometry.sides)},
                )
        return self


def load_scene(path: Path | str) -> Scene:
    """Read a scene file; raise `SceneError` if it is missing or wrong."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
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
        scene = Scene.model_validate(_tuples(tomllib.loads(text)))
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{source}: not TOML: {error}") from error
    except ValidationError as error:
        lines = "; ".join(_explain(dict(detail)) for detail in error.errors(include_url=False))
        raise SceneError(f"{source}: {lines}") from error
    scene._text = text
    scene._folder = folder
    return scene


def _tuples(value: Any) -> Any:
    """TOML arrays as tuples, the immutable kind strict models ask for."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    return value


def _explain(detail: dict[str, Any]) -> str:
    """One pydantic complaint as `field.path = value: what is wrong`."""
    # The tag of a discriminated union is in pydantic's path, but not in the file.
    parts = [str(part) for part in detail["loc"] if part not in ("extrusion", "block")]
    path = ".".join(parts) or "scene"
    value = detail["input"]
    shown = "" if isinstance(value, dict) else f" = {value!r}"
    return f"{path}{shown}: {detail['msg']}"
