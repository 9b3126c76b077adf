"""What every table of a scene file is: immutable, strict about types, closed to unknown keys."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(ge=1e-9, le=1e9)]
Length = Annotated[float, Field(ge=0.01, le=10_000.0)]  # mm
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Part(BaseModel):
    """A table of a scene file."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


def optional(absent: str, description: str) -> Any:
    """Field that may be absent; what stands for it then is no value, but said in words."""
    return Field(None, description=description, json_schema_extra={"absent": absent})


def times(multiple: float, key: str, description: str) -> Any:
    """Field that is a multiple of another of its table, above it, unless it is given."""
    return Field(
        default_factory=lambda found: float(f"{multiple * found[key]:.6g}"),
        description=description,
        json_schema_extra={"absent": f"{multiple:g} times {key}"},
    )


def in_radii(multiple: float, description: str) -> Any:
    """Field of a length (mm) that is a multiple of the endoscope's radius unless it is given."""
    extra: Any = {"absent": f"{multiple:g} radii of the endoscope", "radii": multiple}
    return Field(description=description, json_schema_extra=extra)
