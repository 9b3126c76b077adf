"""The package has a name of its own: folders of other projects cannot hide its parts."""

import subprocess
import sys

import pytest

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


def test_an_unknown_name_is_an_attribute_error():
    import palpate

    with pytest.raises(AttributeError, match="no attribute 'Atlas'"):
        _ = palpate.Atlas
