"""The first look: one scene served at once, another one trained beside it."""

import fcntl
import json
import re
import shutil
import subprocess
import time
import urllib.request

import pytest

from palpate.online.demo import TRAINED
from palpate.shared.progress import trainings

from ..conftest import PALPATE

pytestmark = pytest.mark.service


def test_a_slab_is_served_and_what_trains_beside_it_is_told_and_ends_with_it(artifact, tmp_path):
    shutil.copy(artifact, tmp_path / "quick.h5")
    command = [*PALPATE, "demo", "quick", "--artifacts", tmp_path, "--port", "0", "--no-browser"]
    demo = subprocess.Popen(
        [*command, "--beside", "quick-visco"], stdout=subprocess.PIPE, text=True, stderr=-3
    )
    said = ""
    while "Try:" not in said:
        line = demo.stdout.readline()
        assert line, said
        said += line
    assert f"goes into {tmp_path}/quick-visco.log" in said
    url = re.search(r"Open (http://[\d.]+:\d+)/", said)[1]
    end = time.monotonic() + 120
    training = []
    while not training:
        assert time.monotonic() < end, (tmp_path / "quick-visco.log").read_text()
        time.sleep(0.5)
        with urllib.request.urlopen(f"{url}/scenes") as answer:
            training = json.load(answer)["training"]
    assert [told["scene"] for told in training] == ["quick-visco"]
    demo.terminate()
    demo.communicate(timeout=20)
    assert demo.returncode == 0
    with open(tmp_path / ".quick-visco.training" / "lock") as lock:
        for _ in range(100):  # it ends its workers first
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.2)
        else:
            raise AssertionError("the training goes on")


def test_the_pad_comes_trained_and_is_not_trained_again(tmp_path):
    command = [*PALPATE, "demo", "--artifacts", tmp_path / "new", "--port", "0", "--no-browser"]
    for _ in range(2):
        demo = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stderr=-3)
        said = demo.stdout.readline()
        demo.terminate()
        demo.communicate(timeout=20)
        assert said.startswith("Open http")
    (artifact,) = (tmp_path / "new").iterdir()
    assert artifact.read_bytes() == (TRAINED / "pad.h5").read_bytes()


def test_a_scene_that_cannot_be_trained_is_told(tmp_path):
    (tmp_path / "file").touch()
    command = [*PALPATE, "demo", "--artifacts", tmp_path / "file", "--no-browser"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 2
    assert "Traceback" not in found.stderr
    assert "file" in found.stderr
    assert trainings(tmp_path) == []
