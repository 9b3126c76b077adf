"""All figures with the commands that measure them: ``artifacts/FIGURES.md`` and README's few.

README shows an answer, too, that of ``ANSWER``.

``figures.toml`` says which commands there are and what of their reports is shown, ``figures.json``
holds the last report of each, with the commit and the day it was made at.  In a template,
``{displacement/mean|p95:%}`` stands for two entries of the report's ``displacement`` in percent.
"""

import json
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from datetime import UTC, datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from palpate.shared.errors import PalpateError

Found = dict[str, dict[str, Any]]
"""``report``, ``commit`` and ``date`` by command."""

RUN = "from palpate.shared.cli import main; main()"

UNITS = {"%": (100, 2), "s": (1, 3), "ms": (1e-3, 2), "µs": (1, 3), "MB": (1e-6, 3)}
"""Factor from what reports hold (1, s, µs, bytes), and digits shown."""

ENTRIES = re.compile(r"\{([^:}]*):?([^}]*)\}")
ANSWER = "solve turbinate --at 10 20 11 --pressure 3"
"""The load that README presses with."""

TABLE = re.compile(r"(?<=<!-- figures -->\n).*?(?=<!-- end of figures -->)", re.DOTALL)

SAMPLE = re.compile(r"(?<=```json\n)\{\"scene\".*?(?=```)", re.DOTALL)


def figures(folder: Path, pattern: str | None) -> None:
    """Write ``FIGURES.md`` and README's part, after running the commands that match a pattern."""
    wanted = tomllib.loads((folder / "figures.toml").read_text("utf-8"))
    for command in (c for section in wanted["section"] for c in section["commands"]):
        if pattern is not None and fnmatch(command, pattern):
            _measure(folder / "figures.json", command)
    found = json.loads((folder / "figures.json").read_text("utf-8"))
    (folder / "FIGURES.md").write_text(document(wanted, found), "utf-8")
    readme = folder.parent / "README.md"
    text = TABLE.sub(lambda _: table(wanted, found), readme.read_text("utf-8"))
    if ANSWER in found:
        text = SAMPLE.sub(lambda _: sample(found[ANSWER]["report"]), text)
    readme.write_text(text, "utf-8")


def _measure(path: Path, command: str) -> None:
    """Run a command and keep its report."""
    run = [sys.executable, "-c", RUN, *shlex.split(command), "--json"]
    done = subprocess.run(run, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise PalpateError(f"palpate {command}: failed")
    here = Path(__file__).parent
    head = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=here, text=True)
    code = ":/offline", ":/online", ":/shared"
    changed = subprocess.call(["git", "diff", "--quiet", "HEAD", "--", *code], cwd=here)
    found = json.loads(path.read_text("utf-8"))
    found[command] = {
        "commit": head.strip() + "+" * changed,
        "date": datetime.now(UTC).date().isoformat(),
        "report": json.loads(done.stdout),
    }
    # a line for each command
    lines = [f"{json.dumps(name)}: {json.dumps(own)}" for name, own in sorted(found.items())]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")


def document(wanted: dict[str, Any], found: Found) -> str:
    """All figures, a section for each kind of command and a row for each command."""
    lines = [wanted["heading"]]
    for section in wanted["section"]:
        commands, columns = section["commands"], section["columns"]
        rows = [[f"`{c}`", *_cells(found, c, list(columns.values()))] for c in commands]
        lines += [f"## {section['title']}\n", *section.get("notes", [])]
        lines += [*_rows(["command", *columns, "measured"], rows), ""]
    return "\n".join(lines)


def table(wanted: dict[str, Any], found: Found) -> str:
    """README's figures."""
    rows = [[r["what"], *_cells(found, r["command"], [r["figure"]])] for r in wanted["readme"]]
    return "\n".join(_rows(["what", "figure", "measured"], rows)) + "\n"


def sample(report: dict[str, Any]) -> str:
    """The answer that the service gives to what a command was asked, a line for each part or more.

    Digits are cut off, and what only the command tells is left out.
    """
    told = {name: report[name] for name in report if name not in ("peak", "timing")}
    timing = {"solve_us": round(report["timing"]["solve_us"]), "recover_us": 0}
    told |= {"fields": {}, "timing": timing}  # no fields are asked for
    lines = []
    for name, value in told.items():
        text = json.dumps({name: _rounded(value)})[1:-1]
        lines.append(textwrap.fill(text, 100, initial_indent=" ", subsequent_indent="  "))
    return "{" + ",\n".join(lines).removeprefix(" ") + "}\n"


def _rounded(value: Any) -> Any:
    """Numbers of a report with two digits behind the point, or three if they are small."""
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    if not isinstance(value, float):
        return value
    return round(value, 2 if abs(value) >= 0.1 else 3) + 0.0


def _rows(heading: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (heading, ["---"] * len(heading), *rows)]


def _cells(found: Found, command: str, templates: list[str]) -> list[str]:
    """What a command's report tells, and when it was made."""
    if command not in found:
        return ["not measured"] * len(templates) + [""]
    made = found[command]

    def told(entries: re.Match[str]) -> str:
        (*path, last), entry = entries[1].split("/"), made["report"]
        for key in path:
            entry = entry.get(key, {})
        return " / ".join(_text(entry.get(key), entries[2]) for key in last.split("|"))

    cells = [ENTRIES.sub(told, template) for template in templates]
    return [*cells, f"{made['commit']}, {made['date']}"]


def _text(value: Any, spec: str) -> str:
    """A number in its unit, a text as it is, a dash for what a report does not hold."""
    if value is None:
        return "–"
    if spec not in UNITS:
        return format(value, spec)
    if isinstance(value, str):
        return value
    factor, digits = UNITS[spec]
    return f"{float(f'{factor * value:.{digits}g}'):g} {spec}"
