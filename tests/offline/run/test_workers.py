from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.workers import completed, open_artifact, resume, worker_pool
from palpate.shared.artifact import read_artifact


@pytest.fixture
def executor():
    with ThreadPoolExecutor(2) as executor:
        yield executor


@pytest.fixture
def calls():
    return []


@pytest.fixture
def tasks(calls):
    """Return tasks that square their number and remember that they did; number 3 fails once."""

    def square(_, number):
        calls.append(number)
        if number == 3 and calls.count(3) == 1:
            raise RuntimeError("the power went out")
        return number**2

    return {f"square-{i}": (square, i) for i in range(6)}


def test_results_come_with_their_names(executor, tasks):
    tasks.pop("square-3")
    assert dict(completed(executor, tasks)) == {f"square-{i}": i**2 for i in (0, 1, 2, 4, 5)}
    assert dict(completed(executor, tasks, ["square-5"])) == {"square-5": 25}


def test_a_run_that_broke_off_goes_on_where_it_stopped(executor, tasks, calls, tmp_path):
    checkpoint = Checkpoint(tmp_path / "run", "key")
    with pytest.raises(RuntimeError, match="power"):
        resume("squares", executor, checkpoint, tasks)
    kept = {name for name in tasks if name in checkpoint}
    assert "square-3" not in kept
    calls[:] = [3]
    results = resume("squares", executor, Checkpoint(tmp_path / "run", "key"), tasks)
    assert results == {f"square-{i}": i**2 for i in range(6)}
    assert len(calls) - 1 == len(tasks) - len(kept)


def test_results_of_another_key_are_not_used(executor, tasks, calls, tmp_path):
    tasks.pop("square-3")
    resume("squares", executor, Checkpoint(tmp_path / "run", "one"), tasks)
    resume("squares", executor, Checkpoint(tmp_path / "run", "two"), tasks)
    assert len(calls) == 2 * len(tasks)


def test_a_worker_has_the_mesh_of_its_artifact(artifact):
    expected = FullProblem.of_artifact(read_artifact(artifact)).mesh.nodes
    with worker_pool(open_artifact, artifact, count=1) as pool:
        found = dict(completed(pool, {"mesh": (getattr, "mesh")}))
    np.testing.assert_array_equal(found["mesh"].nodes, expected)
