"""A trained scene as the datasets of its artifact."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.problem import FullProblem
from palpate.shared.artifact import Dataset, datasets_of, write_artifact
from palpate.shared.local_models import ESTIMATORS, Estimator, LocalModels

Array = NDArray[np.float64]


def write_model(
    path: Path,
    problem: FullProblem,
    models: LocalModels,
    limits: Array,
    estimators: Mapping[str, Estimator],
    documents: Mapping[str, Any],
) -> None:
    """Write the artifact of a trained scene.

    Parameters
    ----------
    path : Path
    problem : FullProblem
    models : LocalModels
    limits : ndarray, shape (v, LIMIT_FIELDS)
        At the vertices of the surface.
    estimators : mapping of str to Estimator
        By their names in ``shared.local_models.Estimators``.
    documents : mapping of str to dict
        What else there is to tell of the training, by name.
    """
    surface = problem.surface
    datasets = datasets_of(problem.body) | datasets_of(models)
    datasets |= {
        "surface_vertices": Dataset(surface.vertices, "mm", "accessible surface"),
        "surface_triangles": Dataset(surface.triangles, "1", "triangles of it, outward"),
        "surface_normals": Dataset(surface.normals, "1", "outward unit normals at vertices"),
        "load_range": Dataset(
            limits,
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
    write_artifact(path, problem.scene.text, documents, datasets)
