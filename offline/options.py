"""Arguments and options that several commands have, and how reports are printed."""

from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import Any

import click
import orjson

from palpate.shared.cli import Finite


class _Artifact(click.Path):
    """The file of an artifact, or the name of a scene whose artifact lies where training put it."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        named = Path("artifacts", f"{value}.h5")
        if Path(value).suffix == ".toml":
            self.fail(f"{value!r} is a scene; palpate train {value} makes its artifact")
        if Path(value).exists() or Path(value).suffix:
            return super().convert(value, param, ctx)
        if not named.exists():
            self.fail(f"there is neither a file {value!r} nor {named}, which palpate train writes")
        return super().convert(named, param, ctx)


class Output(click.Path):
    """A file to write, whose name ends as its kind does."""

    def __init__(self, suffix: str) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)
        self._suffix = suffix

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Refuse other endings."""
        if Path(value).suffix != self._suffix:
            self.fail(f"{value!r} must end in {self._suffix}", param, ctx)
        return super().convert(value, param, ctx)


ARTIFACT = _Artifact(exists=True, dir_okay=False, path_type=Path)
OUTPUT = click.Path(dir_okay=False, writable=True, path_type=Path)
TABLE = click.Path(exists=True, dir_okay=False, path_type=Path)
NUMBER = Finite()
VECTOR = (NUMBER, NUMBER, NUMBER)

Report = Mapping[str, object]
Option = Callable[[Callable[..., Any]], Callable[..., Any]]

artifact_argument = click.argument("artifact", type=ARTIFACT)
artifact_option = click.option(
    "--artifact", type=ARTIFACT, help="Of the scene.  [default: artifacts/NAME.h5]"
)


UNITS = {
    "force": "mN",
    "tangent": "mN/mm",
    "contact_displacement": "mm",
    "contact.position": "mm",
    "contact.distance": "mm",
    "contact.centre": "mm",
    "contact.radius": "mm",
    "contact.depth": "mm",
    "contact.depth_limit": "mm",
    "contact.pressure": "kPa",
    "contact.pressure_limit": "kPa",
    "peak.displacement": "mm",
    "peak.von_mises": "kPa",
    "peak.von_mises_p99": "kPa",
    "timing.solve_us": "µs",
    "timing.recover_us": "µs",
    "error.displacement": "relative",
    "error.von_mises": "relative",
    "error_estimate.displacement": "relative",
    "error_estimate.von_mises": "relative",
    "error_estimate.force": "relative",
}
"""Of what `palpate solve` reports, by its name and that of its table."""


def reporting(command: Callable[..., Report]) -> Callable[..., None]:
    """Command that prints what it returns: a ``name value`` line for each number, or JSON."""

    @click.option("--json", "as_json", is_flag=True, help="Print JSON.")
    @wraps(command)
    def show(as_json: bool, **parameters: Any) -> None:
        report = command(**parameters)
        if as_json:
            click.echo(json_text(report))
            return
        leaves = list(_leaves(report, ""))
        width = max(len(name) for name, _ in leaves)
        for name, value in leaves:
            unit = UNITS.get(".".join(name.split(".")[-2:]), "")
            click.echo(
                f"{name:<{width}}  {_text(value)} {unit if value is not None else ''}".rstrip()
            )

    return show


def _text(value: object) -> str:
    """A value in four digits, those of a list one after the other."""
    if isinstance(value, list | tuple):
        return ", ".join(f"({_text(v)})" if isinstance(v, list) else _text(v) for v in value) or "-"
    if value is None:
        return "-"
    return f"{value:z.4g}" if isinstance(value, float) else str(value)


def json_text(report: Report) -> str:
    """JSON with null for numbers that are not finite."""
    return orjson.dumps(report, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _leaves(report: Report, prefix: str) -> Iterator[tuple[str, object]]:
    for name, value in report.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def count_option(name: str, default: int | None, help: str, least: int = 1) -> Option:
    """Option of a whole number."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=True, help=help)


seed_option = count_option("--seed", 0, "Number that the random loads follow from.", least=0)


young_option = click.option(
    "--young", type=NUMBER, help="Young's modulus of the tissue, kPa.  [default: the scene's]"
)


def vector_option(*names: str, help: str, required: bool = False) -> Option:
    """Option of a point or a direction."""
    return click.option(*names, type=VECTOR, required=required, metavar="X Y Z", help=help)


def load_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of a command that presses the tissue once."""
    at = "Where to press, mm; moved to the nearest point that can be touched."
    pressure = "Pressure at the centre of the footprint, kPa."
    direction = "Direction of the load, of any length.  [default: the inward normal]"
    command = vector_option("--direction", help=direction)(command)
    command = click.option("--pressure", type=NUMBER, help=pressure)(command)
    return vector_option("--at", "--position", "position", help=at)(command)
