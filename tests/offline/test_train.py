"""Training as a process: killed and resumed, it makes the very artifact of an undisturbed run."""

import os
import re
import signal
import subprocess
import time

import numpy as np
import pytest

from palpate.offline.reduce.kernels import KERNELS
from palpate.offline.run.workers import content_key
from palpate.offline.scenes import find_scene
from palpate.offline.train import is_of, train
from palpate.shared.artifact import read_artifact
from palpate.shared.mechanics.stress import nodal_von_mises, point_von_mises
from palpate.shared.model import STORED, ReducedModel
from palpate.shared.reduced import press
from palpate.shared.reduced.many import press_many

from ..conftest import PALPATE

STAGES = ("load range", "windows", "Ritz vectors", "local models", "full solutions")


def start(tiny, path):
    """Start `palpate train` as a group of processes that can be killed together."""
    command = [*PALPATE, "train", tiny, "--out", path]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def finished(path):
    """Results on disk, by path; parts of a write that was cut off do not count."""
    return sorted((path.parent / f".{path.stem}.training").glob("*/*.pickle"))


@pytest.fixture(scope="module")
def resumed(tiny, tmp_path_factory):
    """Return an artifact of a run that was killed, what was done by then, and the second's log."""
    path = tmp_path_factory.mktemp("killed") / "tiny.h5"
    first, deadline = start(tiny, path), time.monotonic() + 300
    while not any(result.name.startswith("patch-") for result in finished(path)):
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    assert not path.exists()
    done = finished(path)
    stale = done[0].parents[1] / "0123456789abcdef" / done[0].name
    stale.parent.mkdir()
    stale.write_bytes(b"from other code")
    second = start(tiny, path)
    _, log = second.communicate(timeout=300)
    assert second.returncode == 0, log
    return path, done, log


def test_finished_tasks_are_kept(resumed):
    _, done, log = resumed
    # what the progress bars begin with
    kept = {title: re.search(rf"{title}: .*?\| (\d+)/(\d+) \[", log).groups() for title in STAGES}
    tasks = [result for result in done if result.stem != "windows"]  # which all workers read
    assert sum(int(begun) for begun, _ in kept.values()) == len(tasks)
    for title in ("load range", "Ritz vectors"):
        assert kept[title][0] == kept[title][1]
    assert 0 < int(kept["local models"][0]) < int(kept["local models"][1])
    assert kept["full solutions"][0] == "0"


def test_a_resumed_run_makes_the_artifact_of_an_undisturbed_one(tiny, resumed, tmp_path):
    undisturbed = start(tiny, tmp_path / "tiny.h5")
    _, log = undisturbed.communicate(timeout=300)
    assert undisturbed.returncode == 0, log
    paths = resumed[0], tmp_path / "tiny.h5"
    found, expected = (read_artifact(path, *STORED).arrays for path in paths)
    assert found.keys() == expected.keys()
    for name in ("nodes", "elements", "clamped", "patch_centres", "patch_region"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    # the sparse solver's last digit depends on where its memory lies, and picks other points
    one, other = map(ReducedModel.load, paths)
    for x in one.models.centres[:5]:
        pressure = 0.8 * one.press(x, 0.0).pressure_limit
        u, v = (atlas.displacement(atlas.press(x, pressure)) for atlas in (one, other))
        assert np.linalg.norm(u - v) <= 0.01 * np.linalg.norm(v)


def test_the_log_says_beforehand_what_will_be_made_and_the_artifact_how_long_it_took(resumed):
    path, _, log = resumed
    info = ReducedModel.load(path).info
    made = info["training"]["layout"]
    said = rf"tiny: 18 elements hex20, {made['dofs']} DOFs; about {made['patches']} local"
    assert re.search(said, log)
    assert info["provenance"]["wall_seconds"] > sum(info["training"]["seconds"].values())


def test_what_is_there_is_not_trained_again_and_a_changed_scene_is(tiny, resumed, capsys, tmp_path):
    path, before = resumed[0], resumed[0].stat().st_mtime_ns
    assert train(tiny, path) == path
    assert "up to date" in capsys.readouterr().err
    assert path.stat().st_mtime_ns == before
    assert sorted(file.name for file in path.parent.iterdir()) == ["tiny", "tiny.h5"]
    changed = tmp_path / "tiny.toml"
    changed.write_text(tiny.read_text().replace("samples = 60", "samples = 61"))
    for wanted, found in ((changed, False), (tiny, True)):
        assert is_of(path, content_key(find_scene(wanted))) == found
        assert not is_of(tmp_path / "none.h5", content_key(find_scene(wanted)))


def test_one_compilation_serves_training_and_queries(atlas, problem):
    for kernels in KERNELS:
        kernels(problem)
    queries = press.place, press.press, press_many, nodal_von_mises, point_von_mises
    known = [len(query.signatures) for query in queries]
    by_columns = np.asfortranarray(atlas.limits)
    other = ReducedModel(
        atlas.name, atlas.scene, {}, atlas.body, atlas.surface, by_columns, atlas.models,
        atlas.estimators,
    )  # fmt: skip
    answer = other.press(atlas.surface.vertices[0], 0.1)
    other.peaks(answer, other.displacement(answer))
    other.von_mises(answer)
    other.solve_many(atlas.surface.vertices[:1], [0.1])
    assert [len(query.signatures) for query in queries] == known
