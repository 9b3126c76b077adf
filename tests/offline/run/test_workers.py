"""Results on disk: whole ones only, of one process at a time."""

import platform
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import pytest

from palpate.offline.run.workers import Checkpoint, content_key, read_result
from palpate.offline.scenes import find_scene
from palpate.shared.errors import PalpateError
from palpate.shared.scene import SceneError, load_scene


def double(_problem, number):
    return 2 * number


TASKS = {f"task-{i}": (double, i) for i in range(4)}


DAMAGE = {
    "cut": lambda content: content[:-1],
    "altered": lambda content: content[:40] + b"x" + content[41:],
    "empty": lambda content: b"",
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_result_is_made_anew(tmp_path, capsys, damage):
    with ThreadPoolExecutor(1) as executor:
        first = Checkpoint(tmp_path / "folder", "key")
        expected = first.resume("tasks", executor, TASKS)
        first.leave()
        path = tmp_path / "folder" / "key" / "task-2.pickle"
        path.write_bytes(damage(path.read_bytes()))
        with pytest.raises(PalpateError, match="is damaged"):
            read_result(path)
        again = Checkpoint(tmp_path / "folder", "key").resume("tasks", executor, TASKS)
    assert again == expected == {f"task-{i}": 2 * i for i in range(4)}
    assert f"{path} is damaged; it is made anew" in capsys.readouterr().err


def killed(_problem, number):
    if number == 3:
        raise BrokenProcessPool("what a pool says when the system has killed a worker")


def test_a_worker_that_is_killed_is_told_and_what_is_done_is_kept(tmp_path):
    tasks = {f"task-{i}": (killed, i) for i in range(4)}
    checkpoint = Checkpoint(tmp_path / "folder", "key")
    with (
        ThreadPoolExecutor(1) as executor,
        pytest.raises(PalpateError, match=r"squares: a worker was killed, .* fewer --workers"),
    ):
        checkpoint.resume("squares", executor, tasks)
    assert "task-3" not in checkpoint


HOLD = """
import sys
from pathlib import Path
from palpate.offline.run.workers import Checkpoint
held = Checkpoint(Path(sys.argv[1]), "other")
print("held", flush=True)
sys.stdin.read()
"""


def test_a_folder_belongs_to_one_process_until_it_ends(tmp_path):
    folder = tmp_path / "folder"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, folder, "words"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout.readline() == "held\n"
        (folder / "other" / "a.pickle").write_bytes(b"")
        with pytest.raises(PalpateError) as refused:
            Checkpoint(folder, "key")
        assert f"process {other.pid}" in str(refused.value)
        assert "words" in str(refused.value)
        assert (folder / "other" / "a.pickle").exists()
        other.kill()
    (folder / "key").mkdir(exist_ok=True)
    (folder / "key" / ".left.pickle.part").touch()
    checkpoint = Checkpoint(folder, "key")
    assert sorted(path.name for path in folder.iterdir()) == ["key", "lock"]
    checkpoint.leave()
    assert not folder.exists()


HANDLERS = """
import os, signal, time
from palpate.offline.run.workers import worker_pool

def handler(_):
    time.sleep(0.5)  # so that the others get tasks, too
    return os.getpid(), signal.getsignal(signal.SIGINT)

if __name__ == "__main__":
    with worker_pool(os.getpid, count=3) as pool:
        found = dict(pool.map(handler, range(9)))
    print(len(found), *{str(how) for how in found.values()})
"""


def test_no_worker_hears_the_keyboard(tmp_path):
    (tmp_path / "handlers.py").write_text(HANDLERS)
    run = subprocess.run(
        [sys.executable, tmp_path / "handlers.py"], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["3", str(signal.SIG_IGN)]


FAULTS = """
import os, resource
import numpy as np
from palpate.offline.run.workers import worker_pool

def faults(count):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        np.ones(8_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

if __name__ == "__main__":
    with worker_pool(os.getpid, count=1) as pool:
        print([pool.submit(faults, count).result() for count in (2, 20)][1])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="others know no such setting")
def test_workers_use_memory_again(tmp_path):
    """Pages that the system had to give and clear for 20 arrays of 64 MB in turn, after two."""
    (tmp_path / "faults.py").write_text(FAULTS)
    run = subprocess.run(
        [sys.executable, tmp_path / "faults.py"], capture_output=True, text=True, check=True
    )
    assert int(run.stdout) < 100


def test_a_section_that_cannot_be_read_is_told(tmp_path):
    scene = tmp_path / "own.toml"
    scene.write_text(find_scene("turbinate").text)
    section = tmp_path / "inferior_turbinate_section.csv"
    for make in (lambda: None, section.mkdir):
        make()
        with pytest.raises(SceneError, match=rf"geometry\.section: {section} cannot be read"):
            content_key(load_scene(scene))
