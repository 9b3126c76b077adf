import os
import subprocess
import sys

# as in a server, whose answers must be the same to the last bit; before NumPy comes in
for library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture
def rng():
    """Return a random generator that every run seeds alike."""
    return np.random.default_rng(20260101)


def trained(scene, folder):
    """Train a scene in a process of its own."""
    path = folder / f"{scene}.h5"
    train = "from palpate.shared.cli import main; main()", "train", scene, "--out", str(path)
    subprocess.run([sys.executable, "-c", *train], check=True, capture_output=True)
    return path


@pytest.fixture(scope="session")
def artifact(tmp_path_factory):
    """Return the artifact of the quick scene, trained here and now."""
    return trained("quick", tmp_path_factory.mktemp("trained"))


@pytest.fixture(scope="session")
def visco_artifact(tmp_path_factory):
    """Return the artifact of the quick scene of visco-elastic tissue."""
    return trained("quick-visco", tmp_path_factory.mktemp("visco"))
