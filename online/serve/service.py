"""What a service works with: settings, counts, and the models that can be trusted."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, NamedTuple, Self

from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError
from palpate.shared.files import printable
from palpate.shared.model import ReducedModel

logger = logging.getLogger(__name__)


class ServedModel(NamedTuple):
    """A reduced model that is served, and what requests need beside it."""

    model: ReducedModel
    example: dict[str, Any]  # `position` (mm) and `pressure` (kPa) of a contact it can answer
    tip: list[float]  # mm, a position of the tip's centre at which it presses a little


class Service:
    """What endpoints and sessions work with; without `metrics` this is the only worker.

    It has the models of another that it is forked from, if there is one.
    """

    def __init__(
        self, settings: Settings, metrics: Metrics | None = None, shared: Self | None = None
    ) -> None:
        self._shared = shared
        self.settings, self.metrics = settings, metrics or Metrics()
        self.models: dict[str, ServedModel] = {}
        self.refused: list[dict[str, str]] = []  # `file` and `reason` of those that are not served
        self.ready = asyncio.Event()
        self.working = asyncio.Lock()  # on a list of queries

    def open(self, warm: Callable[[ServedModel], Any]) -> None:
        """Load and warm the model of every ``*.h5``; refuse those that fail, serve the others.

        Hidden files are none of them.  Clients learn names of files and not where they are.
        """
        if self._shared is not None:
            self.models, self.refused = self._shared.models, self._shared.refused
            for served in self.models.values():
                warm(served)
            return
        found = sorted(self.settings.artifacts.glob("*.h5"))
        for path in (path for path in found if not path.name.startswith(".")):
            try:
                served = _served(ReducedModel.load(path))
                name = served.model.name
                if name in self.models:
                    raise PalpateError(f"{path}: another file already holds {name!r}")
                warm(served)
            except Exception as error:
                reason = str(error)
                if not isinstance(error, PalpateError):  # no reason to withhold the others
                    logger.exception("failed on %s", printable(str(path)))
                    reason = f"{path}: cannot be used: {type(error).__name__}"
                logger.error("refused %s", printable(reason))
                told = {"file": path.name, "reason": reason.replace(str(path), path.name)}
                self.refused.append({key: printable(text) for key, text in told.items()})
            else:
                self.models[name] = served
                logger.info("serving %s from %s", name, printable(str(path)))

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


def _served(model: ReducedModel) -> ServedModel:
    """Make examples in the middle of the surface: half its pressure limit, a tip a tenth deep."""
    vertices, radius = model.surface.vertices, model.scene.endoscope.radius
    middle = int(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmin())
    tip = vertices[middle] + 0.9 * radius * model.surface.normals[middle]
    example = {
        "position": vertices[middle].round(3).tolist(),
        "pressure": round(0.5 * float(model.limits[middle, 0]), 3),
    }
    return ServedModel(model, example, tip.round(3).tolist())
