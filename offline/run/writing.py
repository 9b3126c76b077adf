"""A trained scene as its artifact."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from palpate.shared.artifact import Dataset, datasets_of, write_artifact
from palpate.shared.local_models import ESTIMATORS, Estimator
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

PACKAGES = ("numpy", "scipy", "numba", "h5py", "palpate")


def write_model(
    path: Path,
    model: ReducedModel,
    estimators: Mapping[str, Estimator],
    documents: Mapping[str, Any],
) -> None:
    """Write a model with its error estimates, by their names in ``ESTIMATORS``, and documents."""
    surface = model.surface
    datasets = datasets_of(model.body) | datasets_of(model.models)
    datasets |= {
        "surface_vertices": Dataset(surface.vertices, "mm", "accessible surface"),
        "surface_triangles": Dataset(surface.triangles, "1", "triangles of it, outward"),
        "surface_normals": Dataset(surface.normals, "1", "outward unit normals at vertices"),
        "load_range": Dataset(
            model.limits,
            "kPa, mm/kPa, mm",
            "at vertices: limit along the normal, compliance, depth of the tip",
        ),
    }
    datasets |= {
        ESTIMATORS[kind]: Dataset(
            estimator.coefficients,
            "1",
            "log error = c . features; rows: displacement, von Mises, under the tip force",
        )
        for kind, estimator in estimators.items()
    }
    write_artifact(path, model.scene.text, documents, datasets)


def provenance(scene: Scene, key: str) -> dict[str, Any]:
    """When, with what and by which code, of content ``key``, a scene is trained."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "packages": {name: metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "git_commit": commit,
        "seed": scene.seed,
        "content_key": key,
    }
