"""The package has a name of its own: folders of other projects cannot hide its parts."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest

import palpate

SCRIPT = """
from palpate import REST, Client, ReducedModel, Session
from palpate.offline.train import train
from palpate.shared.errors import PalpateError
for name in (REST, Client, ReducedModel, Session, PalpateError):
    print(name.__module__)
"""


PARTS = "shared", "offline", "online"


def run(folder, *arguments):
    return subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True)


def test_a_script_beside_folders_named_like_parts_of_palpate_runs(tmp_path):
    for part in PARTS:
        (tmp_path / part).mkdir()
        (tmp_path / part / "__init__.py").write_text("raise ImportError('not Palpate')\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    assert run(tmp_path, "script.py").stdout.split() == [
        "palpate.shared.reduced.transfer",
        "palpate.online.client.http",
        "palpate.shared.model",
        "palpate.online.client.session",
        "palpate.shared.errors",
    ]


@pytest.mark.parametrize("part", PARTS)
def test_the_parts_are_not_importable_without_the_name_of_the_package(part, tmp_path):
    assert f"No module named '{part}'" in run(tmp_path, "-c", f"import {part}").stderr


def test_every_name_that_the_package_has_is_there():
    assert set(palpate.__all__) == palpate._WHERE.keys()
    for name in palpate.__all__:
        assert getattr(palpate, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Atlas'"):
        _ = palpate.Atlas


def distribution(requirement):
    """Name of what a requirement asks for."""
    return re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")


ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CORE = set(map(distribution, PROJECT["dependencies"]))


def test_the_core_has_no_library_for_training_pictures_or_tests():
    extras = PROJECT["optional-dependencies"]
    for needed in map(distribution, (name for extra in extras.values() for name in extra)):
        assert needed not in CORE
    assert not CORE & {"mkl", "matplotlib", "pyvista", "tqdm", "torch", "scikit-learn", "felupe"}


@pytest.mark.parametrize("part", ["shared", "online"])
def test_what_serves_imports_nothing_but_the_core(part):
    """Or what that brings along; where a function imports more, it is for another extra."""
    brought = {
        distribution(line) for name in CORE for line in requires(name) or () if ";" not in line
    }
    owners = packages_distributions()
    for source in (ROOT / part).rglob("*.py"):
        for node in ast.parse(source.read_text("utf-8")).body:
            names = [alias.name for alias in getattr(node, "names", ())]
            if isinstance(node, ast.ImportFrom):
                names = [node.module]
            for name in names if isinstance(node, ast.Import | ast.ImportFrom) else ():
                top = name.partition(".")[0]
                if top != "palpate" and top not in sys.stdlib_module_names:
                    owner = {distribution(found) for found in owners[top]}
                    assert owner & (CORE | brought), (source, name)
