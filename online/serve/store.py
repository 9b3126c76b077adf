"""The models a service answers from: every artifact of a directory that can be trusted."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.online.serve.errors import Refusal
from palpate.online.session.follower import Follower
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

logger = logging.getLogger(__name__)


@dataclass
class Model:
    """An artifact in memory, warm.

    Parameters
    ----------
    atlas : ReducedModel
        What answers.
    example : dict
        ``position`` (mm) and ``pressure`` (kPa) of a contact that it can answer.
    tip : list of 3 floats, mm
        A position of the tip's centre at which it presses a little.
    meshes : dict from (region, media type) to bytes
        The mesh documents asked for so far.
    followers : list of Follower
        Spare ones for sessions to come: a new one takes longer than many a solve.
    """

    atlas: ReducedModel
    example: dict[str, Any]
    tip: list[float]
    meshes: dict[tuple[str, str], bytes] = field(default_factory=dict)
    followers: list[Follower] = field(default_factory=list)


@dataclass(frozen=True)
class RefusedFile:
    """An artifact that is not served, and why."""

    file: str
    reason: str


class Store:
    """All models of a directory.

    Parameters
    ----------
    directory : Path
        Searched for ``*.h5``, in order of name.
    load : callable, optional
        Makes an atlas of a file; raises `PalpateError` for a file it refuses.
    """

    def __init__(
        self, directory: Path, load: Callable[[Path], ReducedModel] = ReducedModel.load
    ) -> None:
        self.directory = directory
        self.models: dict[str, Model] = {}
        self.refused: list[RefusedFile] = []
        self.ready = False
        self._load = load

    def open(self, warm: Callable[[Model], Any]) -> None:
        """Load and warm every model; a file that fails is refused and the others still served."""
        for path in sorted(self.directory.glob("*.h5")):
            try:
                atlas = self._load(path)
                model = Model(atlas, _example(atlas), _tip(atlas))
                if model.atlas.name in self.models:
                    raise PalpateError(f"{path}: another file already holds {model.atlas.name!r}")
                warm(model)
            except PalpateError as error:
                self._refuse(path, str(error))
            except Exception as error:
                # A bug in reading one file is no reason to withhold the others.
                logger.exception("failed on %s", path)
                self._refuse(path, f"{path}: cannot be used: {type(error).__name__}")
            else:
                self.models[model.atlas.name] = model
                logger.info("serving %s from %s", model.atlas.name, path)

    def require_ready(self) -> None:
        """Raise `Refusal` while models are being loaded."""
        if not self.ready:
            raise Refusal("not_ready", "", "The models are being loaded; try again in a moment")

    def model(self, name: str) -> Model:
        """Find the model called `name`; raise `Refusal` if there is none (yet)."""
        self.require_ready()
        model = self.models.get(name)
        if model is None:
            raise Refusal("unknown_scene", "name", "No such scene is served", sorted(self.models))
        return model

    def _refuse(self, path: Path, reason: str) -> None:
        logger.error("refused %s", reason)
        self.refused.append(RefusedFile(path.name, reason))


def _middle(atlas: ReducedModel) -> int:
    """Vertex amid the accessible surface."""
    vertices = atlas.surface.vertices
    return int(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmin())


def _example(atlas: ReducedModel) -> dict[str, Any]:
    """Make a contact that `atlas` can answer: amid its surface, at half the pressure limit."""
    middle = _middle(atlas)
    return {
        "position": atlas.surface.vertices[middle].round(3).tolist(),
        "pressure": round(0.5 * float(atlas.limits[middle, 0]), 3),
    }


def _tip(atlas: ReducedModel) -> list[float]:
    """Make a position of the tip amid the surface, a tenth of its radius deep."""
    middle, radius = _middle(atlas), atlas.scene.endoscope.radius
    centre = atlas.surface.vertices[middle] + 0.9 * radius * atlas.surface.normals[middle]
    position: list[float] = centre.round(3).tolist()
    return position
