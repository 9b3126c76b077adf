import os

import pytest

from palpate.offline.run import progress
from palpate.offline.run.progress import STAGES, Teller
from palpate.shared.progress import FILE, training_folder, trainings


@pytest.fixture
def clock(monkeypatch):
    """Return a clock that stands until it is set."""
    now = {"s": 0.0}
    monkeypatch.setattr(progress.time, "monotonic", lambda: now["s"])
    return now


def test_the_time_left_follows_from_the_speed_so_far(tmp_path, clock):
    folder = training_folder(tmp_path / "toy.h5")
    folder.mkdir()
    teller = Teller("toy", folder)
    shares = []
    for stage, percent in STAGES.items():
        for done in range(1, 11):
            clock["s"] += percent
            teller(stage, done, 10)
            (told,) = trainings(tmp_path)
            shares.append(told.share)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert told.seconds_left == pytest.approx(0.0, abs=1e-9)
    assert told[:4] == ("toy", list(STAGES)[-1], 10, 10)
    teller.end()
    assert trainings(tmp_path) == []


def test_what_is_no_file_tells_nothing(tmp_path):
    """A pipe would be waited for."""
    folder = training_folder(tmp_path / "toy.h5")
    folder.mkdir()
    os.mkfifo(folder / FILE)
    assert trainings(tmp_path) == []


def test_a_training_that_goes_on_counts_what_it_does_itself(tmp_path, clock):
    folder = training_folder(tmp_path / "toy.h5")
    folder.mkdir()
    teller = Teller("toy", folder)
    teller("local models", 0, 10)  # all before it was there
    (told,) = trainings(tmp_path)
    assert told.share > 0.2
    assert told.seconds_left is None
    clock["s"] = 100.0
    teller("local models", 10, 10)
    (told,) = trainings(tmp_path)
    first = sum(list(STAGES.values())[: list(STAGES).index("local models")])
    left = sum(STAGES.values()) - first - STAGES["local models"]
    assert told.seconds_left == pytest.approx(100.0 * left / STAGES["local models"])


def test_a_stage_that_takes_no_share_leaves_it(tmp_path):
    folder = training_folder(tmp_path / "toy.h5")
    folder.mkdir()
    teller = Teller("toy", folder)
    teller("load range", 5, 10)
    (before,) = trainings(tmp_path)
    teller("trying 64 modes", 5, 10)
    (told,) = trainings(tmp_path)
    assert told.share == before.share
    assert told.stage == "trying 64 modes"
