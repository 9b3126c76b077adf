"""How far a training is and how long it takes yet, told as its tasks are done."""

import time
from pathlib import Path

from palpate.shared.progress import FILE, Progress, tell

STAGES = {
    "load range": 9, "windows": 1, "Ritz vectors": 11, "local models": 26, "giving way": 1,
    "folding of the rim": 1, "slipping off": 3, "without an answer": 2, "errors of the mesh": 22,
    "full solutions": 8, "full solutions under the tip": 14,
}  # fmt: skip
"""Stages in their order and their shares of the time, in percent; measured on ``turbinate``."""

ENOUGH = 0.05
"""Share of a training after which its speed is known."""


class Teller:
    """Tells how far the training of a scene is in the folder that it works in."""

    def __init__(self, scene: str, folder: Path) -> None:
        self._scene, self._folder = scene, folder
        self._started = time.monotonic()
        self._first = self._share = 0.0

    def __call__(self, stage: str, done: int, of: int) -> None:
        """Tell that so many tasks of a stage are done."""
        if stage in STAGES:
            before = list(STAGES).index(stage)
            reached = sum(list(STAGES.values())[:before]) + STAGES[stage] * done / of
            self._share = max(self._share, reached / sum(STAGES.values()))
        self._first = self._first or self._share  # what was there when it went on
        made, left = self._share - self._first, None
        if made > ENOUGH:
            left = (time.monotonic() - self._started) * (1.0 - self._share) / made
        tell(self._folder, Progress(self._scene, stage, done, of, self._share, left))

    def end(self) -> None:
        """Tell nothing more."""
        (self._folder / FILE).unlink(missing_ok=True)
