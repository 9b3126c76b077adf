"""Random numbers: every stage of training, validation and study draws from a stream of its own.

What validates must not share a stream with what shaped the model.
"""

from enum import IntEnum, unique

import numpy as np


@unique
class Stage(IntEnum):
    """What random numbers are drawn for."""

    LOAD_RANGE = 1
    LAYOUT = 2
    VALIDATION = 3
    TRIAL_PATCHES = 4
    TIP_VALIDATION = 6
    HISTORY_VALIDATION = 8
    TIP_HISTORY_VALIDATION = 9
    SLIPPING_OFF = 10
    GIVING_WAY = 11
    MESH_CHOICE = 12
    TRIAL_LOADS = 13
    BODY_MODES = 14
    MESH_PART = 15
    FOLDING = 16
    UNANSWERED = 17
    UNSEEN = 100
    SNAPSHOTS = 101
    HARD_CASES = 102
    STABILITY_SNAPSHOTS = 103
    HARD_CASES_IN_TIME = 104
    STABILITY_IN_TIME_SNAPSHOTS = 105


def stream(seed: int, stage: Stage, *numbers: int) -> np.random.Generator:
    """Random numbers of a stage; further ``numbers``, such as a user's seed, tell runs apart."""
    return np.random.default_rng([seed, stage, *numbers])
