import os
import re
import subprocess
import sys

import pytest

from palpate import shared
from palpate.shared import PACKAGES, kernel_sources


@pytest.mark.parametrize(
    "first", ["palpate.shared.mechanics.laws", "palpate.offline.fem.model", "numba"]
)
def test_kernels_are_cached_by_the_state_of_the_sources_whatever_is_imported_first(first):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    script = f"""
import {first}
from palpate.shared.mechanics import laws
print(laws.tangent.stats.cache_path)
"""
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert "kernels-" in run.stdout


def test_sources_with_kernels_and_what_they_import_make_that_state_and_no_others():
    names = {source.relative_to(PACKAGES).as_posix() for source in kernel_sources()}
    for source in PACKAGES.glob("*/**/*.py"):
        if re.search(r"^@njit", source.read_text(), re.MULTILINE):
            assert source.relative_to(PACKAGES).as_posix() in names
    assert "shared/errors.py" in names  # imported by modules with kernels
    assert not names & {"online/serve/app.py", "offline/commands.py"}


READ_ONLY = """
import os, sys
os.access = lambda *_: False  # as in an image that is mounted to be read
import palpate.shared
from palpate.shared.mechanics import laws
print(os.environ["NUMBA_CACHE_DIR"])
"""


@pytest.mark.parametrize("home", [True, False])
def test_an_installation_that_cannot_be_written_has_its_kernels_elsewhere(tmp_path, home):
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "HOME")}
    if not home:
        (tmp_path / "file").touch()
    environment["XDG_CACHE_HOME"] = str(tmp_path / ("cache" if home else "file"))
    run = subprocess.run(
        [sys.executable, "-c", READ_ONLY], env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    folder = run.stdout.strip()
    if home:
        assert folder.startswith(str(tmp_path / "cache" / "palpate" / "kernels-"))
        assert run.stderr == ""
    else:
        assert not os.path.exists(folder)
        assert "set NUMBA_CACHE_DIR" in run.stderr


def test_who_has_no_home_has_the_kernels_of_the_installation_for_once(tmp_path, monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(shared.os, "access", lambda *_: False)
    monkeypatch.setattr(shared.Path, "home", home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    (tmp_path / "kernels-abc").mkdir()
    (tmp_path / "kernels-abc" / "laws.nbi").touch()
    folder = shared._writable(tmp_path, "abc")
    assert folder.parent != tmp_path
    assert [path.name for path in folder.iterdir()] == ["laws.nbi"]
