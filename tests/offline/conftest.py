import csv
import json

import pytest
from click.testing import CliRunner

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.shared.cli import main

from .fem.bodies import in_tetrahedra


def table(path):
    """Rows of a CSV file."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def drawn(path):
    """Whether a file is a picture that shows something."""
    content = path.read_bytes()
    return content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) > 5_000


@pytest.fixture(scope="session")
def run():
    """Return a function that runs a command in this process."""

    def run(*arguments):
        return CliRunner().invoke(main, [str(argument) for argument in arguments])

    return run


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
