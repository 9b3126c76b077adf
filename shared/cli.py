"""The ``palpate`` command.

Its subcommands are the entry points of the group ``palpate.commands``; each is imported when it is
asked for, so that this module needs neither side of the house.
"""

import math
import os
from importlib.metadata import entry_points
from typing import Any

import click

from palpate.shared.errors import PalpateError
from palpate.shared.files import printable

EXAMPLE = """\b
Example, from a scene to an answer:
  palpate scene pad                                     every key of the scene, explained
  palpate new own.toml                                  a first scene of your own
  palpate train pad                                     writes artifacts/pad.h5
  palpate info pad
  palpate solve pad --at 6 6 8 --pressure 1.5
  palpate serve --artifacts artifacts
"""


EXTRAS = {
    "tqdm": "train", "distributed": "cluster", "matplotlib": "loadtest", "pyvista": "pictures",
}  # fmt: skip
"""Extra that brings a package which not every installation has."""


class Finite(click.FloatRange):
    """A finite number in a range."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Read it."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number

    def _describe_range(self) -> str:
        """Nothing where all finite numbers are allowed."""
        return "" if self.min is None and self.max is None else super()._describe_range()


class _UserError(click.ClickException):
    """Shown without a traceback; the exit code is that of a wrong command line."""

    exit_code = 2


class _Commands(click.Group):
    """The group of installed commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(entry_points(group="palpate.commands").names)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for entry in entry_points(group="palpate.commands", name=cmd_name):
            command: click.Command = entry.load()
            return command
        return None

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            if error.name not in EXTRAS:
                raise
            extra = f"pip install 'palpate[{EXTRAS[error.name]}]'"
            raise _UserError(f"this needs {error.name}: {extra}") from error
        except (PalpateError, OSError) as error:
            said = error.strerror if isinstance(error, OSError) else str(error)
            ended = isinstance(error, BrokenPipeError)  # `head`, say: click knows what to do
            if said is None or ended or os.environ.get("PALPATE_DEBUG"):
                raise
            name = getattr(error, "filename", None)
            lines = (f"{name}: {said}" if name else said).split("\n")
            raise _UserError("\n".join(map(printable, lines))) from error


@click.group(
    "palpate",
    cls=_Commands,
    epilog=EXAMPLE,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="palpate", prog_name="palpate")
def main() -> None:
    """Press soft tissue in real time.

    A scene is a text file that says what is pressed, by what and how accurately. The command train
    makes an artifact of it, which solve, serve and the others answer from. ARTIFACT is its file, or
    the name of the scene. Units are mm, mN, kPa and s throughout.

    Set PALPATE_DEBUG=1 to see where an error came from.
    """
