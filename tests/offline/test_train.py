"""Training as a process: killed and resumed, it makes the very artifact of an undisturbed run."""

import os
import re
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.footprint_models import compile_query
from palpate.offline.run.checkpoint import content_key
from palpate.offline.scenes import filled, find_scene
from palpate.offline.train import is_of, train
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel
from palpate.shared.reduced import press, touch
from palpate.shared.scene import SceneError

STAGES = ("load range", "Ritz vectors", "local models", "full solutions")


def start(path):
    """Start `palpate train quick` as a group of processes that can be killed together."""
    code = "from palpate.shared.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, "train", "quick", "--out", path],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finished(path):
    """Results on disk, by path; parts of a write that was cut off do not count."""
    return sorted((path.parent / f".{path.stem}.training").glob("*/*.pickle"))


def kill_after(process, path, name):
    """Kill a training as soon as a result of this name is on disk."""
    deadline = time.monotonic() + 300
    while not any(result.name.startswith(name) for result in finished(path)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """Return an artifact of a run that was killed, what was done by then, and the second's log."""
    path = tmp_path_factory.mktemp("killed") / "quick.h5"
    kill_after(start(path), path, "patch-")
    assert not path.exists()
    done = finished(path)
    stale = done[0].parents[1] / "0123456789abcdef" / done[0].name
    stale.parent.mkdir()
    stale.write_bytes(b"from other code")
    second = start(path)
    _, log = second.communicate(timeout=300)
    assert second.returncode == 0, log
    return path, done, log


def test_finished_tasks_are_kept(resumed):
    _, done, log = resumed
    # what the progress bars begin with
    kept = {title: re.search(rf"{title}: .*?\| (\d+)/(\d+) \[", log).groups() for title in STAGES}
    assert sum(int(begun) for begun, _ in kept.values()) == len(done)
    for title in ("load range", "Ritz vectors"):
        assert kept[title][0] == kept[title][1]
    assert 0 < int(kept["local models"][0]) < int(kept["local models"][1])
    assert kept["full solutions"][0] == "0"


def test_a_resumed_run_makes_the_artifact_of_an_undisturbed_one(resumed, artifact):
    with h5py.File(resumed[0]) as found, h5py.File(artifact) as expected:
        assert found.keys() == expected.keys()
        for name in ("nodes", "elements", "clamped", "patch_centres", "patch_region"):
            np.testing.assert_array_equal(found[name][()], expected[name][()], err_msg=name)
    # the sparse solver's last digit depends on where its memory lies, and picks other points
    found, expected = ReducedModel.load(resumed[0]), ReducedModel.load(artifact)
    for x in expected.models.centres[:5]:
        pressure = 0.8 * expected.press(x, 0.0).pressure_limit
        u = expected.displacement(expected.press(x, pressure))
        difference = found.displacement(found.press(x, pressure)) - u
        assert np.linalg.norm(difference) <= 0.01 * np.linalg.norm(u)


def test_the_log_says_beforehand_what_will_be_made(resumed):
    path, _, log = resumed
    made = ReducedModel.load(path).info["training"]["layout"]
    said = rf"quick: 4 x 4 x 3 elements hex20, {made['dofs']} DOFs; about {made['patches']} local"
    assert re.search(said, log)


def test_what_is_there_is_not_trained_again(resumed, capsys):
    path, before = resumed[0], resumed[0].stat().st_mtime_ns
    assert train("quick", path) == path
    assert "up to date" in capsys.readouterr().err
    assert path.stat().st_mtime_ns == before


def test_a_changed_scene_is_trained_again(resumed, tmp_path):
    path, scene = resumed[0], tmp_path / "quick.toml"
    scene.write_text(find_scene("quick").text.replace("samples = 120", "samples = 60"))
    assert not is_of(path, content_key(find_scene(scene)))
    assert is_of(path, content_key(find_scene("quick")))
    assert not is_of(tmp_path / "none.h5", content_key(find_scene("quick")))


def test_the_time_of_a_training_is_that_on_the_wall(resumed):
    info = ReducedModel.load(resumed[0]).info
    assert info["provenance"]["wall_seconds"] > sum(info["training"]["seconds"].values())


def test_nothing_is_left_beside_the_artifact(resumed):
    path = resumed[0]
    assert sorted(file.name for file in path.parent.iterdir()) == ["quick", "quick.h5"]


def test_one_compilation_serves_training_and_queries(artifact):
    atlas = ReducedModel.load(artifact)
    problem = FullProblem.of_artifact(read_artifact(artifact))
    compile_query(problem)
    atlas.press(atlas.surface.vertices[0], 0.1)
    queries = press.place, press.press, touch.place, touch.touch
    known = [len(query.signatures) for query in queries]
    by_columns = np.asfortranarray(atlas.limits)
    other = ReducedModel(
        atlas.name, atlas.scene, {}, atlas.body, atlas.surface, by_columns, atlas.models,
        atlas.estimators,
    )  # fmt: skip
    other.press(atlas.surface.vertices[0], 0.1)
    assert [len(query.signatures) for query in queries] == known


def test_the_mesh_error_is_that_of_other_meshes(artifact):
    report = ReducedModel.load(artifact).info["mesh_error"]
    own, other = report["elements"]["hex20"], report["elements"]["hex8-mean-dilatation"]
    assert report["reference_dofs"] >= 5 * own["dofs"]
    assert other["dofs"] == pytest.approx(own["dofs"], rel=0.3)
    for errors in (own, other):
        assert -0.2 < errors["least"] <= errors["mean"] <= errors["greatest"] < 0.2
    assert abs(own["mean"]) < abs(other["mean"])


def test_an_element_that_cannot_be_reduced_is_refused_at_once(tmp_path):
    scene = tmp_path / "locked.toml"
    scene.write_text(filled(find_scene("quick")).replace('"hex20"', '"hex8-mean-dilatation"'))
    with pytest.raises(SceneError, match=r"geometry\.element.*train with hex8 or hex20"):
        train(scene, tmp_path / "locked.h5")
    assert list(tmp_path.iterdir()) == [scene]
