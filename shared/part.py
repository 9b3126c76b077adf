"""What every table of a scene file is: immutable, strict about types, closed to unknown keys."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(ge=1e-9, le=1e9)]
Length = Annotated[float, Field(ge=0.01, le=10_000.0)]  # mm
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Part(BaseModel):
    """A table of a scene file."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
