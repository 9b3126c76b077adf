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


@pytest.mark.parametrize("folder", ["shared", "offline", "online"])
def test_a_script_beside_a_folder_named_like_a_part_of_palpate_runs(folder, tmp_path):
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "__init__.py").write_text("raise ImportError('not Palpate')\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    run = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == [
        "palpate.shared.reduced.transfer",
        "palpate.online.client.http",
        "palpate.shared.model",
        "palpate.online.client.session",
        "palpate.shared.errors",
    ]


@pytest.mark.parametrize("name", ["shared", "offline", "online"])
def test_the_parts_are_not_importable_without_the_name_of_the_package(name, tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", f"import {name}"], cwd=tmp_path, capture_output=True, text=True
    )
    assert f"No module named '{name}'" in run.stderr


def test_an_unknown_name_is_an_attribute_error():
    import palpate

    with pytest.raises(AttributeError, match="no attribute 'Atlas'"):
        _ = palpate.Atlas
