"""No two stages draw the same random numbers."""

import re
from itertools import combinations
from pathlib import Path

import palpate.offline
from palpate.offline.run.streams import Stage, stream

MAKERS = {"reduce/footprint_models.py", "run/streams.py"}
"""Sources that may make random numbers: of a scene's or a local model's seed alone."""

FOLDER = Path(palpate.offline.__file__).parent
SOURCES = {
    path.relative_to(FOLDER).as_posix(): path.read_text()
    for part in ("train.py", "choose/*.py", "fem/*.py", "reduce/*.py", "run/*.py", "validate/*.py")
    for path in FOLDER.glob(part)
}
"""Text of all that takes part in training."""


def test_no_two_stages_share_a_stream():
    drawn = {stage: stream(2015, stage).random(4).tolist() for stage in Stage}
    for one, other in combinations(Stage, 2):
        assert drawn[one] != drawn[other], f"{one.name} and {other.name}"


def test_training_takes_its_numbers_from_the_enumeration_and_each_stage_in_one_place():
    assert {name for name, text in SOURCES.items() if "default_rng(" in text} == MAKERS
    used = re.findall(r"Stage\.([A-Z_]+)", "".join(SOURCES.values()))
    assert len(used) > 10
    assert sorted(used) == sorted(set(used))
