import fcntl
import os
import subprocess
import sys
import threading
from dataclasses import replace

# as in a server, whose answers must be the same to the last bit; before NumPy comes in
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import pytest  # noqa: E402

from palpate.shared.artifact import Dataset, write_artifact  # noqa: E402
from palpate.shared.model import ReducedModel  # noqa: E402

from . import browser  # noqa: E402


@pytest.fixture
def rng():
    """Return a random generator that every run seeds alike."""
    return np.random.default_rng(20260101)


PALPATE = [sys.executable, "-c", "from palpate.shared.cli import main; main()"]


def sealed(path, whole, **changed):
    """Write an artifact with other contents, fields of `Artifact`, and seal it; return where."""
    whole = replace(whole, **changed)
    datasets = {name: Dataset(values, "1", "") for name, values in whole.arrays.items()}
    write_artifact(path, whole.scene, whole.documents, datasets)
    return path


def pytest_sessionstart(session):
    """Train what most tests need while other tests run, where many processes run them all."""
    if session.config.getoption("dist", "no") == "no" or session.config.args != ["tests"]:
        return
    folders = session.config._tmp_path_factory
    folders.getbasetemp()  # now: threads would make two
    for scene in ("quick", "quick-visco"):
        threading.Thread(target=trained, args=(scene, folders), daemon=True).start()


def trained(scene, tmp_path_factory):
    """Train a scene in a process of its own, once for all processes that run tests."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    path = folder / scene / f"{scene}.h5"
    with open(folder / f"{scene}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            command = [*PALPATE, "train", scene, "--out", str(path)]
            subprocess.run(command, check=True, capture_output=True)
    return path


@pytest.fixture(scope="session")
def artifact(tmp_path_factory):
    """Return the artifact of the quick scene, trained here and now."""
    return trained("quick", tmp_path_factory)


@pytest.fixture(scope="session")
def atlas(artifact):
    """Return the reduced model of the quick scene."""
    return ReducedModel.load(artifact)


@pytest.fixture(scope="session")
def visco_artifact(tmp_path_factory):
    """Return the artifact of the quick scene of visco-elastic tissue."""
    return trained("quick-visco", tmp_path_factory)


@pytest.fixture(scope="session")
def visco_atlas(visco_artifact):
    """Return the reduced model of the quick scene of visco-elastic tissue."""
    return ReducedModel.load(visco_artifact)


@pytest.fixture(scope="session")
def new_tab(tmp_path_factory):
    """Return a function that opens a tab of a browser; without a browser the test is skipped.

    Where the variable NEED_BROWSER is set it fails.
    """
    if browser.find() is None:
        said = "no Chromium on this machine: apt-get install chromium-headless-shell"
        pytest.fail(said) if os.environ.get("NEED_BROWSER") else pytest.skip(said)
    with browser.browsing(tmp_path_factory.mktemp("browser")) as new_tab:
        yield new_tab
