"""No two stages draw the same random numbers."""

import re
from itertools import combinations
from pathlib import Path

import palpate.offline
from palpate.offline.run.streams import Stage, stream

OWN = {"footprint_models.py", "streams.py"}
"""Sources that may make random numbers: of a scene's or a local model's seed alone."""


def sources():
    """Text of all that takes part in training, by name."""
    folder = Path(palpate.offline.__file__).parent
    paths = [
        folder / "train.py",
        *(p for name in ("fem", "reduce", "run", "validate") for p in folder.glob(f"{name}/*.py")),
    ]
    return {path.name: path.read_text() for path in paths}


def test_no_two_stages_share_a_stream():
    drawn = {stage: stream(2015, stage).random(4).tolist() for stage in Stage}
    for one, other in combinations(Stage, 2):
        assert drawn[one] != drawn[other], f"{one.name} and {other.name}"


def test_stages_of_training_take_their_numbers_from_the_enumeration():
    makers = {name for name, text in sources().items() if "default_rng(" in text}
    assert makers == OWN


def test_no_stage_is_drawn_from_in_two_places_of_training():
    used = re.findall(r"Stage\.([A-Z_]+)", "".join(sources().values()))
    assert len(used) > 10
    assert sorted(used) == sorted(set(used))
