"""Following a tool: from one position of the tip to the next, whatever the next one is."""

from typing import Any, NamedTuple


class Step(NamedTuple):
    """The answer to a position of the tip.

    Parameters
    ----------
    touch : Touch
        What the atlas answered
    flags : int
        Bits of `online.frames.Flag`.
    steps : int
        Positions solved on the way.
    valid_radius : float, mm
        How far from the position force and tangent may serve.
    solve_seconds : float
    """

    touch: Any
    flags: int
    steps: int
    valid_radius: float
    solve_seconds: float
