"""A cluster trains what this machine does; workers, the scheduler and the client may be killed."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.run.workers import MEMORY, Checkpoint, OnScene, content_key, run, versions
from palpate.offline.scenes import find_scene
from palpate.offline.train import train
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError
from palpate.shared.model import STORED
from palpate.shared.scene import SceneError, parse_scene

from ...conftest import PALPATE

pytest.importorskip("distributed", reason="needs the extra cluster: pip install 'palpate[cluster]'")

from palpate.offline.run import cluster
from palpate.offline.run.cluster import Cluster

ROOT = Path(__file__).parents[3]

TASKS = """
import os, time
from palpate.offline.run.workers import read_result

def work(problem, path, number):
    time.sleep(0.2)
    return problem.scene.name, read_result(path)[number], os.getpid()

def body(problem):
    return problem.scene.folder, problem.mesh.nodes

def die(problem):
    os._exit(1)
"""
"""Module of tasks, which workers must find as well."""


@pytest.fixture(scope="module")
def tasks(tmp_path_factory):
    """Return a module of tasks."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "cluster_tasks.py").write_text(TASKS)
    sys.path.insert(0, str(folder))
    yield __import__("cluster_tasks")
    sys.path.remove(str(folder))


def exported():
    """Return what the README lets a cluster have in its environment."""
    lines = re.findall(r"^export (.*)$", (ROOT / "offline" / "README.md").read_text(), re.M)
    return dict(pair.split("=", 1) for line in lines for pair in line.split())


@contextmanager
def processes(folder, path=(), workers=2):
    """Run a scheduler and workers of two processes; yield them and the scheduler's file."""
    found = [str(path), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, found)),
        # each death of a worker gives its tasks up
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
    }
    environment |= exported()
    assert environment["GLIBC_TUNABLES"] == MEMORY
    file = folder / "scheduler.json"
    options = ["--no-dashboard", "--scheduler-file", str(file)]
    commands = [
        ["scheduler", *options, "--host", "127.0.0.1", "--port", "0"],
        ["worker", *options, "--nthreads", "1", "--nworkers", str(workers),
         "--local-directory", str(folder / "workers")],
    ]  # fmt: skip
    started = []
    try:
        for kind, *rest in commands:
            command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *rest]
            with (folder / f"{kind}.log").open("w") as log:
                started.append(
                    subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=folder)
                )
            deadline = time.monotonic() + 60
            while not file.exists():
                assert started[0].poll() is None, (folder / "scheduler.log").read_text()
                assert time.monotonic() < deadline
                time.sleep(0.05)
        yield SimpleNamespace(scheduler=started[0], workers=started[1], file=str(file))
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(60)


@pytest.fixture(scope="module")
def running(tasks, tmp_path_factory):
    """Return a cluster of two workers."""
    folder = tmp_path_factory.mktemp("cluster")
    with processes(folder, Path(tasks.__file__).parent) as running:
        yield running


def kill_a_worker(running):
    """Kill one of the worker processes, which dask starts again."""
    (found, *_) = worker_processes(running.workers.pid)
    os.kill(found, signal.SIGKILL)


def worker_processes(parent):
    """Return the processes that work for one that starts workers."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            owner = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_text()
        except OSError:  # it has just ended
            continue
        if owner == parent and "spawn_main" in command:
            found.append(int(entry.name))
    return found


def assert_same(one, other):
    """Two artifacts are the same to the last bit, when and how they were made apart."""
    found, expected = (read_artifact(path, *STORED).arrays for path in (one, other))
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name, strict=True)


def test_a_cluster_whose_worker_is_killed_trains_the_artifact_of_this_machine(
    artifact, tiny, running, tmp_path
):
    """To the last bit, once all kernels are compiled, as they are for the fixture ``artifact``.

    Not in this process, which may have compiled some itself.
    """
    here, there = tmp_path / "here.h5", tmp_path / "there.h5"
    command = [*PALPATE, "train", str(tiny), "--out", str(there), "--scheduler", running.file]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as training:
        folder = tmp_path / ".there.training"
        while not list(folder.glob("*/patch-*.pickle")):
            assert training.poll() is None, training.communicate()[1]
            time.sleep(0.02)
        assert json.loads((folder / "progress.json").read_text())["stage"] == "local models"
        kill_a_worker(running)
        log = training.communicate(timeout=900)[1]
    assert training.returncode == 0, log
    assert "on 2 free cores" in log
    assert "local models: 100%" in log
    alone = [*PALPATE, "train", str(tiny), "--out", str(here), "--workers", "1"]
    subprocess.run(alone, check=True, capture_output=True)
    assert_same(there, here)


def resumed(pool, tasks, folder, count):
    """Results of tasks that read a stored result."""
    checkpoint = Checkpoint(folder, "key")
    path = checkpoint.store("squares", [i * i for i in range(count)])
    named = {f"task-{i}": (tasks.work, path, i) for i in range(count)}
    found = checkpoint.resume("tasks", pool, named)
    checkpoint.leave()
    return list(found.values())


def opened(running):
    """Return the cluster for the quick scene."""
    scene = find_scene("quick")
    return Cluster(running.file, scene, content_key(scene))


def test_without_its_scheduler_training_goes_on_here(tasks, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cluster, "RETURNS", 2.0)
    with processes(tmp_path, Path(tasks.__file__).parent) as running, opened(running) as pool:
        first = pool.submit(os.getpid).result()
        assert first in worker_processes(running.workers.pid)
        with ThreadPoolExecutor() as killer:
            killer.submit(lambda: (time.sleep(1.0), running.scheduler.kill()))
            found = resumed(pool, tasks, tmp_path / "results", 20)
    assert [own[:2] for own in found] == [("quick", i * i) for i in range(20)]
    said = capsys.readouterr().err
    assert "the scheduler is gone; waiting 2 s for it to come back" in said
    assert "goes on on the cores of this machine" in said


def test_training_goes_on_when_the_scheduler_is_back(tasks, tmp_path, capsys):
    path = Path(tasks.__file__).parent
    with processes(tmp_path, path) as running, opened(running) as pool:

        def again():
            time.sleep(1.0)
            running.scheduler.kill()
            running.workers.wait(60)
            Path(running.file).unlink()
            with processes(tmp_path, path):
                done.wait(120)

        done = threading.Event()
        with ThreadPoolExecutor() as other:
            other.submit(again)
            found = resumed(pool, tasks, tmp_path / "results", 20)
            done.set()
    assert [own[:2] for own in found] == [("quick", i * i) for i in range(20)]
    assert "goes on with the scheduler, it is back" in capsys.readouterr().err


def test_a_task_that_ends_every_worker_is_told(running, tasks):
    with opened(running) as pool, pytest.raises(PalpateError, match="have they enough memory"):
        pool.submit(run, tasks.die).result()


def test_a_worker_with_other_code_is_refused(tmp_path):
    other = tmp_path / "other"
    for part in ("offline", "shared", ".package"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / part, other / part, symlinks=True, ignore=ignored)
    with (other / "offline" / "train.py").open("a") as source:
        source.write("# changed\n")
    with processes(tmp_path, other / ".package", workers=1) as running:
        command = [*PALPATE, "train", "quick", "--out", "quick.h5", "--scheduler", running.file]
        refused = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
    own = versions()["palpate"]
    assert "is refused: it has palpate " in refused.stderr
    assert f"and not {own}; install there what is here" in refused.stderr


def test_a_worker_of_several_threads_is_refused():
    worker = SimpleNamespace(state=SimpleNamespace(nthreads=2))
    assert "--nthreads 1" in cluster.refusal(versions(), worker)
    worker.state.nthreads = 1
    assert cluster.refusal(versions(), worker) is None


@pytest.mark.parametrize("scheduler", ["nowhere.json", "tcp://127.0.0.1:9"])
def test_where_no_scheduler_is_that_is_told(scheduler, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "ANSWERS", 0.5)
    with pytest.raises(PalpateError, match=f"{scheduler}: no scheduler answers there"):
        train("quick", tmp_path / "quick.h5", scheduler=scheduler)


def test_workers_and_a_scheduler_exclude_each_other(run):
    result = run("train", "quick", "--scheduler", "scheduler.json", "--workers", 2)
    assert result.exit_code == 2
    assert "'--workers' makes no sense beside --scheduler" in result.output


def named(section):
    """Text of a scene that names the file of its section so."""
    return find_scene("turbinate").text.replace("inferior_turbinate_section.csv", section)


def test_workers_get_the_files_that_the_scene_names(running, tasks, tmp_path):
    data, folder = tmp_path / "data", tmp_path / "scenes"
    data.mkdir()
    folder.mkdir()
    shutil.copy(ROOT / "offline" / "scenes" / "inferior_turbinate_section.csv", data / "own.csv")
    scene = parse_scene(named("../data/own.csv"), folder)
    with Cluster(running.file, scene, content_key(scene)) as pool:
        shutil.rmtree(data)
        there, nodes = pool.submit(run, tasks.body).result()
        assert (there / "../data/own.csv").exists()
        np.testing.assert_array_equal(nodes, FullProblem(find_scene("turbinate")).mesh.nodes)
    assert not there.exists()


def test_a_file_that_is_named_by_its_whole_path_is_refused():
    path = ROOT / "offline" / "scenes" / "inferior_turbinate_section.csv"
    with pytest.raises(SceneError, match=f"{path}: workers elsewhere need a name relative"):
        Cluster("tcp://127.0.0.1:9", parse_scene(named(str(path)), path.parent), "key")


def test_files_lie_as_the_scene_names_them(tmp_path):
    files = {"a.csv": b"a", "../data/b.csv": b"b", "below/c.csv": b"c"}
    start = cluster.write_files(files, tmp_path / "own")
    assert {name: (start / name).read_bytes() for name in files} == files
    assert [path.name for path in tmp_path.iterdir()] == ["own"]


def test_threads_of_one_process_are_refused(tiny, tmp_path):
    with (
        ThreadPoolExecutor(2) as threads,
        pytest.raises(PalpateError, match="processes of one thread each"),
    ):
        train(tiny, tmp_path / "tiny.h5", executor=threads)


def test_an_executor_opens_the_scene_with_its_first_task_and_is_not_shut_down(tasks, tmp_path):
    scene = find_scene("quick")
    with ThreadPoolExecutor(1) as executor:
        with OnScene(executor, scene, content_key(scene)) as pool:
            found = resumed(pool, tasks, tmp_path, 3)
        assert [own[:2] for own in found] == [("quick", i * i) for i in range(3)]
        assert executor.submit(os.getpid).result() == os.getpid()
