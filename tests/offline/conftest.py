import csv
import json

import pytest
from click.testing import CliRunner

from palpate.offline import commands
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.shared.cli import main

from .fem.bodies import in_tetrahedra


def table(path):
    """Rows of a CSV file."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


SMALLER = {
    '"quick"': '"tiny"', "[4, 4, 3]": "[3, 3, 2]", "tip = true": "tip = false",
    "samples = 120": "samples = 60", "spacing = 2.2": "spacing = 4.0",
    "region_modes = 200": "region_modes = 100",
}  # fmt: skip
"""What makes the quick scene quicker still, and not accurate."""


def drawn(path):
    """Whether a file is a picture that shows something."""
    content = path.read_bytes()
    return content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) > 5_000


@pytest.fixture(scope="session")
def run():
    """Return a function that runs a command in this process, which says nothing of waiting."""

    def run(*arguments):
        return CliRunner().invoke(main, [str(argument) for argument in arguments])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "PATIENCE", 1e6)
        yield run


@pytest.fixture(scope="session")
def answer(run):
    """Return a function that runs a command with --json and returns what it prints."""

    def refuse(number):
        raise AssertionError(f"{number} is not JSON")

    def answer(*arguments):
        result = run(*arguments, "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout, parse_constant=refuse)

    return answer


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """Return the file of a scene that trains in no time."""
    text = find_scene("quick").text
    for old, new in SMALLER.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("scene") / "tiny.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="session")
def problem():
    """Return the full problem of the quick scene, on the mesh that its artifact has too."""
    return FullProblem(find_scene("quick"))


@pytest.fixture(scope="session")
def tetrahedra():
    """Return the full problem of the quick scene on a mesh of tetrahedra."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"element": "hex8"})
    bricks = build_mesh(scene.model_copy(update={"geometry": geometry}))
    return FullProblem(scene, in_tetrahedra(bricks))


@pytest.fixture(scope="session")
def visco_problem():
    """Return the same of the quick scene of visco-elastic tissue."""
    return FullProblem(find_scene("quick-visco"))
