"""What goes over the wire: requests are checked against these models.

Answers are written straight from arrays; their models below describe them to the reader of the
OpenAPI page. Beside an array of a document stand the type of its rows in JSON and its meaning.
"""

import json
import re
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import pydantic
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, field_validator
from pydantic_core import PydanticCustomError

from palpate.online.serve.errors import Refusal, invalid
from palpate.online.serve.layout import Accessible, Answers, Centres, Mesh, Modes

CONVENTIONS = "Units are mm, mN, kPa and s throughout; forces are those of the tissue on the tool."
"""Of every endpoint and of sessions."""

FieldName = Literal["displacement", "von_mises"]
Output = Literal["displacement", "von_mises", "peak"]
Region = Literal["none", "surface", "all"]
MeshRegion = Literal["surface", "all"]

_THREE = Field(min_length=3, max_length=3)
Position = Annotated[list[Annotated[float, Field(ge=-1e4, le=1e4)]], _THREE]
Direction = Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], _THREE]
Vector = Annotated[list[float], _THREE]
Triangle = Annotated[list[int], _THREE]

MOST_STEPS = 200
"""Largest number of steps of a history: so many keep others waiting for some 50 ms."""

MOST_MANY = 20_000
"""Largest number of loads, or positions of the tip, of one request."""

MOST_BYTES = 128 * MOST_MANY
"""Largest body of such a request."""

EXAMPLE_CONTACT: JsonValue = {
    "position": [5.0, 5.0, 5.0],
    "pressure": 4.0,
    "direction": [0.1, 0.0, -1.0],
}
EXAMPLE: JsonValue = {"contacts": [EXAMPLE_CONTACT], "region": "surface"}
EXAMPLE_HISTORY: JsonValue = {"steps": [{"time": 0.1, "contact": EXAMPLE_CONTACT}, {"time": 1.1}]}


class Strict(BaseModel):
    """Refuses unknown keys, NaN, infinities, and booleans or strings in place of numbers."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class Contact(Strict):
    """One endoscope pressing on the tissue."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE_CONTACT]})

    position: Position = Field(
        description="Where the endoscope presses, [x, y, z] mm in the undeformed body's frame. "
        "Off the surface it is projected, up to the scene's reach."
    )
    pressure: float = Field(
        ge=0,
        le=1e6,
        description="Peak of the pressure footprint, kPa. Above the scene's range the answer says "
        "in_range: false; above ten times its end it is refused.",
    )
    direction: Direction | None = Field(
        None,
        description="Where the endoscope pushes, [x, y, z] of any length; less than 90 degrees "
        "from the inward normal. Default: the inward normal.",
    )
    radius: float | None = Field(
        None, ge=1e-2, le=1e3, description="Radius of the footprint, mm. Default: the scene's."
    )


Young = Annotated[
    float | None,
    Field(
        ge=1e-6,
        le=1e6,
        description="Young's modulus of the tissue, kPa. Default: the scene's. Any other is as "
        "exact: tissue twice as stiff moves as far under twice the load, limits included.",
    ),
]


class _Asking(Strict):
    young: Young = None
    outputs: list[Output] = Field(
        ["displacement", "von_mises"],
        max_length=3,
        description="The fields to return; with peak also the largest values of the whole body, "
        "which need no region.",
    )
    region: Region = Field(
        "none",
        description="The nodes to return fields for, in the order of the mesh of that region; with "
        "none, the answer holds the contact, the force and the trust block. Of a history fields "
        "and peak are those of the last step. Who names fields and no region gets the surface's.",
    )

    def model_post_init(self, _: Any) -> None:
        """Give who names fields and no region those of the surface."""
        named = self.model_fields_set & {"outputs", "region"} == {"outputs"}
        if named and set(self.outputs) - {"peak"}:
            self.region = "surface"


class SolveRequest(_Asking):
    """A load, and what to answer about it."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE]})

    contacts: list[Contact] = Field(
        min_length=1, max_length=1, description="The endoscopes at work; one, for now."
    )


class Step(Strict):
    """What presses at a time."""

    time: float = Field(ge=0, le=1e6, description="Since rest, s; no less than the step before.")
    contact: Contact | None = Field(
        None, description="The load then; it changed evenly since the step before. None: released."
    )


class HistoryRequest(_Asking):
    """Loads over time on tissue at rest, and what to answer about their end."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE_HISTORY]})

    steps: list[Step] = Field(
        min_length=1,
        max_length=MOST_STEPS,
        description="In order of time. Steps should be short beside the time constants of the "
        "tissue while the load changes; two at one time are a sudden change.",
    )

    @field_validator("steps")
    @classmethod
    def _time_goes_on(cls, steps: list[Step]) -> list[Step]:
        times = [step.time for step in steps]
        if times != sorted(times):
            raise PydanticCustomError("time_order", "Times should not decrease", {"order": "time"})
        return steps


class TouchRequest(Strict):
    """Positions of the rigid tip, each from rest."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"positions": [[5.0, 5.0, 6.8]]}]})

    positions: list[Position] = Field(
        min_length=1, max_length=MOST_MANY, description="Of the tip's centre, mm."
    )
    young: Young = None


class ManyRequest(Strict):
    """Loads, each from rest and by itself."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"positions": [[5.0, 5.0, 5.0]], "pressures": [4.0]}]}
    )

    positions: list[Position] = Field(
        min_length=1, max_length=MOST_MANY, description="Where the endoscope presses, mm."
    )
    pressures: list[Annotated[float, Field(ge=0, le=1e6)]] = Field(
        min_length=1, max_length=MOST_MANY, description="At the footprints' centres, kPa."
    )
    directions: list[Direction] | None = Field(
        None, max_length=MOST_MANY, description="Default: the inward normals."
    )
    young: Young = None


_TABLES = {
    "contacts": list(Contact.model_fields),
    "steps": [*Step.model_fields, *Contact.model_fields],
}
"""Valid keys of the tables in a request."""

M = TypeVar("M", bound=Strict)


def parse(kind: type[M], text: bytes | str) -> M:
    """Read a message from its JSON text; raise `Refusal` with the field that is wrong."""
    try:
        message = kind.model_validate_json(text)
    except ValidationError as error:
        details = error.errors(include_url=False, include_input=False)
        raise invalid(details, {"": list(kind.model_fields), **_TABLES}) from None
    _refuse_repeated(text if isinstance(text, str) else text.decode())
    return message


_KEY = re.compile(r'"([^"]*)"\s*:')


def _refuse_repeated(text: str) -> None:
    """Refuse JSON in which a table has a key twice: readers differ in which one counts."""
    keys = _KEY.findall(text)
    if len(keys) > len(set(keys)) or "\\" in text:  # rare, but in histories
        json.loads(text, object_pairs_hook=_once)


def _once(pairs: list[tuple[str, Any]]) -> None:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise Refusal("invalid_value", key, "Given twice")


class ContactAnswer(BaseModel):
    """The load that was applied."""

    position: Vector = Field(description="The contact on the undeformed surface, mm.")
    normal: Vector = Field(description="Outward unit normal there.")
    distance: float = Field(description="How far the requested position was from there, mm.")
    direction: Vector = Field(description="Unit vector of the push.")
    pressure: float = Field(description="kPa")
    radius: float = Field(description="mm")
    pressure_limit: float = Field(description="Largest pressure trained for there, kPa.")
    depth_limit: float | None = Field(
        description="Largest depth of the tip trained for there, mm; null in a scene without a tip."
    )


class Trust(BaseModel):
    """Whether and how far to believe the answer."""

    converged: bool = Field(description="Always true: a load without equilibrium is refused.")
    iterations: int = Field(description="Newton steps taken.")
    in_range: bool = Field(
        description="Whether the load is in the range the model was trained for."
    )
    out_of_range: list[str] = Field(description="The contact's fields that are not.")
    error_estimate: dict[FieldName, float | None] = Field(
        description="Relative L2 errors of mesh and reduction together that 95 % of answers stay "
        "within, as fractions. Null outside the trained range. In a history: the largest error "
        "so far relative to the largest norm so far of the field."
    )
    min_jacobian: float = Field(
        description="Smallest volume ratio at the model's points; 1 at rest, 0 is collapse."
    )


class Fields(BaseModel):
    """The fields asked for, one entry per node of the region."""

    displacement: list[Vector] | None = Field(None, description="mm")
    von_mises: list[float] | None = Field(None, description="Cauchy stress, kPa")


Timing = Annotated[
    dict[Literal["solve_us", "recover_us"], float],
    Field(description="Where the server's time went, µs."),
]


class PeakStress(BaseModel):
    """The largest stresses of a part of the body."""

    von_mises: float = Field(description="kPa, outside the layer at the support.")
    von_mises_p99: float = Field(description="kPa, that 1 % of the volume is above.")


class Peak(PeakStress):
    """The largest values of the fields in the whole body; stress outside its regions."""

    displacement: float = Field(description="mm")
    regions: dict[str, PeakStress] | None = Field(
        None, description="Stress in the regions of the tissue, if the scene has any."
    )


class _Answer(BaseModel):
    contact: ContactAnswer
    force: Vector = Field(description="mN")
    contact_displacement: Vector = Field(description="Displacement of the contact point, mm.")
    trust: Trust
    peak: Peak | None = Field(None, description="Only there if asked for.")


class Answer(_Answer):
    """How the tissue answers a load."""

    scene: str
    fields: Fields
    timing: Timing


class StepAnswer(_Answer):
    """How the tissue answers at the time of a step."""

    time: float = Field(description="s")


class HistoryAnswer(BaseModel):
    """How the tissue answers a history."""

    scene: str
    steps: list[StepAnswer]
    fields: Fields
    timing: Timing


_ROWS: dict[str, Any] = {
    "vector": list[Vector],
    "triangle": list[Triangle],
    "number": list[int],
    "value": list[float],
    "estimate": list[float | None],
    "bit": list[Literal[0, 1]],
    "steps": list[list[Annotated[list[int], _THREE]]],
}


def _document(arrays: Any, **head: Any) -> type[BaseModel]:
    """Describe the JSON of a document with these arrays: by rows, with their meanings."""
    fields: dict[str, Any] = {}
    for name, hint in get_type_hints(arrays, include_extras=True).items():
        row, meaning = hint.__metadata__
        default = arrays._field_defaults.get(name, ...)
        fields[name] = _ROWS[row], Field(default, description=meaning)
    name, told = arrays.__name__, arrays.__doc__
    described = pydantic.create_model(f"{name}Fields", __doc__=told, **fields)
    return pydantic.create_model(name, __doc__=told, scene=str, **head, fields=described)


AnswersDocument = _document(Answers)
MeshDocument = _document(Mesh, region=MeshRegion)
AccessibleDocument = _document(Accessible)
CentresDocument = _document(Centres, artifact=str)
ModesDocument = _document(Modes, model=int, artifact=str)


class Ticket(BaseModel):
    """What opens a session in place of the token."""

    ticket: str | None = Field(description="Null if the service asks for no token.")
    valid_s: float = Field(description="Seconds that it is valid.")


class SceneEntry(BaseModel):
    """A scene that is served."""

    name: str
    description: str


class Training(BaseModel):
    """A training whose artifact will be served when it is there."""

    scene: str
    stage: str
    done: int = Field(description="Tasks of the stage that are done.")
    of: int
    share: float = Field(description="Of the whole training that is done, about.")
    seconds_left: float | None = Field(description="Null while it is not known.")


class SceneList(BaseModel):
    """What is served, what could not be, and what is being trained."""

    scenes: list[SceneEntry]
    refused: list[dict[Literal["file", "reason"], str]]
    training: list[Training]


class Ranges(BaseModel):
    """The loads the model was trained for; outside, answers say in_range: false."""

    pressure: list[float] = Field(
        description="[from, to] kPa, where the limit is largest; see pressure_limit of /accessible"
    )
    depth: list[float] | None = Field(
        description="[from, to] mm of the tip in a session, where the limit is largest; see "
        "depth_limit of /accessible. Null if the scene was trained without a tip."
    )
    tilt: list[float] = Field(description="[from, to] degrees between push and inward normal")
    radius: float = Field(description="mm")
    reach: float = Field(description="Farthest a position may be from the surface, mm.")


class SceneSummary(SceneEntry):
    """One scene: what may be asked and how well it is answered."""

    ranges: Ranges
    serves: dict[Literal["sessions", "histories"], bool] = Field(
        description="Whether the tip has been trained, and whether the tissue knows time."
    )
    young: float = Field(description="Young's modulus of the training, kPa.")
    tolerance: dict[str, float] = Field(
        description="Largest relative errors of trusted answers, as fractions."
    )
    size: dict[Literal["nodes", "dofs", "surface_nodes", "triangles"], int] = Field(
        description="What the fields of this scene hold."
    )
    info: dict[str, Any] = Field(
        description="Validation and provenance; palpate info tells how it was trained, too."
    )
    artifact: str = Field(description="SHA-256 of the trained file that is served.")
    example: dict[str, Any] = Field(description="A request that this scene can answer.")


class Checked(BaseModel):
    """What can be said of a load without solving it."""

    in_range: bool = Field(description="Whether the model was trained for such a load.")
    out_of_range: list[str] = Field(description="The contact's fields that are not.")
    pressure_limit: float = Field(description="Largest pressure trained for there, kPa.")


class ErrorBody(BaseModel):
    """What is wrong."""

    code: str
    field: str = Field(description="Path of what is wrong in the request: contacts.0.pressure")
    message: str
    allowed: Any = Field(description="What would be right, where that is short.")


class Problem(BaseModel):
    """Why there is no answer."""

    error: ErrorBody
