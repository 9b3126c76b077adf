"""What a service works with: settings, counts, and the models that can be trusted."""

import asyncio
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError
from palpate.shared.files import printable
from palpate.shared.model import ReducedModel
from palpate.shared.progress import Progress, trainings

logger = logging.getLogger(__name__)


class ServedModel(NamedTuple):
    """A reduced model that is served, and what requests need beside it."""

    model: ReducedModel
    example: dict[str, Any]  # `position` (mm) and `pressure` (kPa) of a contact it can answer
    tip: list[float]  # mm, a position of the tip's centre at which it presses a little
    spare: list[Any]  # trackers for sessions to come, see `session.session`

    @classmethod
    def of(cls, model: ReducedModel) -> Self:
        """Give a model examples in its middle: half the pressure limit, a tip a tenth deep."""
        vertices, radius = model.surface.vertices, model.scene.endoscope.radius
        middle = int(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmin())
        tip = vertices[middle] + 0.9 * radius * model.surface.normals[middle]
        example = {
            "position": vertices[middle].round(3).tolist(),
            "pressure": round(0.5 * float(model.limits[middle, 0]), 3),
        }
        return cls(model, example, tip.round(3).tolist(), [])


Stamp = tuple[int, int, int]
"""When a file was written, its size and its number: another file has another one."""


class _File(NamedTuple):
    """A file as it was when it was last read."""

    stamp: Stamp | None  # None if it is to be read again
    name: str | None  # of the scene that is served from it
    refused: dict[str, str] | None


class Service:
    """What endpoints and sessions work with; without `metrics` this is the only worker.

    It has the models of another that it is forked from, if there is one.
    """

    def __init__(
        self, settings: Settings, metrics: Metrics | None = None, shared: Self | None = None
    ) -> None:
        self._shared = shared
        self._files: dict[Path, _File] = {}
        self.settings, self.metrics = settings, metrics or Metrics()
        self.models: dict[str, ServedModel] = {}  # replaced as a whole, never changed
        self.refused: list[dict[str, str]] = []  # `file` and `reason` of those that are not served
        self.trainings: list[Progress] = []  # whose artifacts will be served
        self.ready = asyncio.Event()
        self.working = asyncio.Lock()  # on a list of queries

    def open(self, warm: Callable[[ServedModel], Any]) -> None:
        """Load and warm what there is to serve."""
        if self._shared is not None:
            self.models, self._files = self._shared.models, dict(self._shared._files)
            for served in self.models.values():
                warm(served)
        self.look(warm)

    def look(self, warm: Callable[[ServedModel], Any]) -> None:
        """Load and warm the model of every ``*.h5`` that has been added or replaced.

        Those that fail are refused and the others served; instead of one that has been replaced
        the one before is.  What is gone is served no more, but for sessions under way.  Hidden
        files are none of them, so one that is being written can be.
        """
        directory = self.settings.artifacts
        try:
            found = artifacts_in(directory)
        except OSError:  # out of reach for a moment
            return
        for path in self._files.keys() - found.keys():
            self._forget(path)
        for path, stamp in found.items():
            if path not in self._files or self._files[path].stamp != stamp:
                self._take(path, stamp, warm)
        self.refused = [file.refused for file in self._files.values() if file.refused]
        self.trainings = trainings(directory)

    def _take(self, path: Path, stamp: Stamp, warm: Callable[[ServedModel], Any]) -> None:
        """Serve a file, or say why not."""
        before = self._files[path].name if path in self._files else None
        others = {file.name for other, file in self._files.items() if other != path}
        try:
            served = ServedModel.of(ReducedModel.load(path))
            name = served.model.name
            if name in others:
                raise PalpateError(f"{path}: another file already holds {name!r}")
            warm(served)
        except Exception as error:
            reason = str(error)
            if not isinstance(error, PalpateError):  # no reason to withhold the others
                logger.exception("failed on %s", printable(str(path)))
                reason = f"{path}: cannot be used: {type(error).__name__}"
            if before is not None:
                reason += f"; {before!r} is served as it was"
            logger.error("refused %s", printable(reason))
            # clients learn names of files and not where they are
            told = {"file": path.name, "reason": reason.replace(str(path), path.name)}
            told = {key: printable(text) for key, text in told.items()}
            self._files[path] = _File(stamp, before, told)
        else:
            kept = {own: model for own, model in self.models.items() if own != before}
            self.models = dict(sorted({**kept, name: served}.items()))
            self._files[path] = _File(stamp, name, None)
            logger.info("serving %s from %s", name, printable(str(path)))

    def _forget(self, path: Path) -> None:
        """Serve a file that is gone no more; others may have been refused since it was there."""
        name = self._files.pop(path).name
        for other, file in self._files.items():
            if file.refused:
                self._files[other] = file._replace(stamp=None)
        if name is not None:
            self.models = {own: model for own, model in self.models.items() if own != name}
            logger.info("serving %s no more: %s is gone", name, printable(str(path)))

    def require_ready(self) -> None:
        """Raise `Refusal` while models are being loaded."""
        if not self.ready.is_set():
            raise Refusal("not_ready", "", "The models are being loaded; try again in a moment")

    def model(self, name: str) -> ServedModel:
        """Return the model called `name`; raise `Refusal` if there is none (yet)."""
        self.require_ready()
        if name not in self.models:
            raise Refusal("unknown_scene", "name", "No such scene is served", sorted(self.models))
        return self.models[name]


def artifacts_in(directory: Path) -> dict[Path, Stamp]:
    """Files of a folder that are to be served, not hidden ones; `OSError` if it cannot be read."""
    names = (n for n in sorted(os.listdir(directory)) if n.endswith(".h5") and n[0] != ".")
    return {path: stamp for n in names if (stamp := _stamp(path := directory / n))}


def _stamp(path: Path) -> Stamp | None:
    """Stamp of a file; None if it has just gone."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino
