"""Documents: what they name is there, what they print works, what is generated is up to date."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest

from palpate.offline.scenes import shipped_scenes
from palpate.offline.studies.figures import (
    ANSWER,
    SAMPLE,
    TABLE,
    document,
    figures,
    sample,
    table,
)
from palpate.online.serve.answer import answer
from palpate.online.serve.errors import STATUS
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.schemas import SolveRequest, parse
from palpate.online.serve.wire import JSON
from palpate.online.session.session import ENDING, GOING_AWAY, IDLE
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "artifacts"
SIDES = ROOT / "shared", ROOT / "offline"
DOCUMENTS = [
    ROOT / name
    for name in (
        "README.md", "artifacts/README.md", "artifacts/FIGURES.md", "offline/README.md",
        "offline/scenes/README.md", "online/README.md", "shared/THEORY.md",
    )
]  # fmt: skip
TEXTS = {path: path.read_text("utf-8") for path in DOCUMENTS}
WANTED = tomllib.loads((FIGURES / "figures.toml").read_text("utf-8"))
FOUND = json.loads((FIGURES / "figures.json").read_text("utf-8"))

PRINTED = {
    " ".join(command.split())
    for text in TEXTS.values()
    for command in re.findall(r"(?m)`palpate ([^`]+)`|^palpate ([^#\n]+)", text)
    for command in command
    if command and "COMMAND" not in command
}
MEASURED = {command for section in WANTED["section"] for command in section["commands"]}


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Go where every scene seems to have been trained."""
    (tmp_path / "artifacts").mkdir()
    for name in shipped_scenes():
        (tmp_path / "artifacts" / f"{name}.h5").touch()
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("line", sorted(PRINTED | MEASURED))
def test_commands_parse(line, trained):
    words, command = shlex.split(line), main
    while isinstance(command, click.Group) and words:
        command = command.get_command(click.Context(command), words.pop(0))
        assert command is not None, line
    if "--help" not in words and not isinstance(command, click.Group):
        command.make_context(line, words)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    for link in re.findall(r"\]\(([^)]+)\)", TEXTS[path]):
        if not link.startswith("http"):
            name, _, heading = link.partition("#")
            target = path.parent / name if name else path
            assert target.exists(), link
            titles = re.findall(r"(?m)^#+ (.*)$", target.read_text("utf-8")) if heading else []
            slugs = {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
            assert not heading or heading in slugs, link


def test_the_theory_names_code_that_is_there():
    code = {path: path.read_text("utf-8") for side in SIDES for path in side.rglob("*.py")}
    for name in re.findall(r"`((?:\w+[./])*\w{4,})`", TEXTS[ROOT / "shared" / "THEORY.md"]):
        if "/" in name:
            assert any((side / f"{name}.py") in code for side in SIDES), name
            continue
        owner, _, last = name.rpartition(".")
        own = [text for path, text in code.items() if path.stem == owner] or code.values()
        assert any(re.search(rf"\b{last}\b", text) for text in own), name


def test_codes_that_documents_name_are_those_of_the_service():
    text = TEXTS[ROOT / "online" / "README.md"]
    named = re.findall(r"\b(4\d\d|5\d\d) `(\w+)`", text)
    assert named
    for status, code in named:
        assert STATUS[code] == int(status)
    for code in re.findall(r'"code": "(\w+)"', text):
        assert code in STATUS
    (ends,) = re.findall(r"(?s)\*\*It ends\*\*.*?Beyond", text)
    too_long = 1009  # of the WebSocket protocol itself
    codes = {GOING_AWAY, IDLE, *ENDING.values(), too_long}
    assert set(map(int, re.findall(r"\b[14]\d{3}\b", ends))) == codes


def test_the_readme_is_read_in_five_minutes():
    assert len(TEXTS[ROOT / "README.md"].encode()) <= 12_288


def test_its_python_runs(visco_artifact, capsys):
    example = re.search(
        r"```python\n(from palpate import REST, ReducedModel.*?)```", TEXTS[DOCUMENTS[0]], re.S
    )
    shown, names = "artifacts/quick-visco.h5", {}
    assert shown in example[1]
    exec(example[1].replace(shown, str(visco_artifact)), names)
    assert names["answer"].converged
    assert names["answer"].time == pytest.approx(1.0)
    assert np.linalg.norm(names["answer"].contact_displacement) > 0
    assert capsys.readouterr().out


def test_figures_are_what_the_command_writes():
    assert TEXTS[FIGURES / "FIGURES.md"] == document(WANTED, FOUND)
    assert TABLE.search(TEXTS[ROOT / "README.md"])[0] == table(WANTED, FOUND)
    assert SAMPLE.search(TEXTS[ROOT / "README.md"])[0] == sample(FOUND[ANSWER]["report"])
    assert set(FOUND) | {row["command"] for row in WANTED["readme"]} <= MEASURED


def shape(document):
    """The names in a document, whatever the values."""
    if not isinstance(document, dict):
        return None
    return {name: shape(part) for name, part in document.items()}


def test_its_answer_is_to_its_question_and_has_all_that_the_service_says(visco_artifact):
    text = TEXTS[ROOT / "README.md"]
    (asked,) = json.loads(re.search(r"solve -H .*\n +-d '(.*)'", text)[1])["contacts"]
    words = ["--at", *map(str, asked["position"]), "--pressure", f"{asked['pressure']:g}"]
    assert ANSWER.split()[2:] == words
    contact = {"position": [5.0, 5.0, 8.0], "pressure": 1.0}
    request = parse(SolveRequest, json.dumps({"contacts": [contact]}))
    said = answer(ReducedModel.load(visco_artifact), request, JSON, Metrics())
    assert shape(json.loads(SAMPLE.search(text)[0])) == shape(json.loads(said.body))


def test_what_has_not_been_measured_is_said():
    columns = {"cold": "{time/cold|warm:µs}", "share": "{share:%}", "n": "{n}"}
    section = {"title": "Time", "commands": ["a", "b"], "columns": columns}
    report = {"time": {"cold": 123.456, "warm": None}, "share": 0.00417}
    found = {"a": {"commit": "c0ffee", "date": "2026-01-01", "report": report}}
    written = document({"heading": "", "readme": [], "section": [section]}, found)
    assert written.splitlines()[-2:] == [
        "| `a` | 123 µs / – | 0.42 % | – | c0ffee, 2026-01-01 |",
        "| `b` | not measured | not measured | not measured |  |",
    ]


def test_a_report_is_measured_and_kept(visco_artifact, tmp_path, monkeypatch):
    folder = tmp_path / "artifacts"
    folder.mkdir()
    (folder / "quick-visco.h5").symlink_to(visco_artifact)
    (folder / "figures.json").write_text("{}")
    (folder / "figures.toml").write_text(
        'heading = ""\n'
        'readme = [{what = "size", figure = "{bytes:MB}", command = "info quick-visco"}]\n'
        '[[section]]\ntitle = "Size"\ncommands = ["info quick-visco", "bench quick-visco"]\n'
        'columns = {size = "{bytes:MB}"}\n'
    )
    (tmp_path / "README.md").write_text("<!-- figures -->\nold\n<!-- end of figures -->\n")
    monkeypatch.chdir(tmp_path)
    figures(Path("artifacts"), "info *")
    size = f"{visco_artifact.stat().st_size / 1e6:.3g} MB"
    written = (folder / "FIGURES.md").read_text("utf-8")
    assert f"| `info quick-visco` | {size} | " in written
    assert "| `bench quick-visco` | not measured |" in written
    readme = (tmp_path / "README.md").read_text("utf-8")
    assert f"| size | {size} | " in readme
    assert "old" not in readme
