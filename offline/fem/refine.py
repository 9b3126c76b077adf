"""Other meshes of a scene: a finer one to judge its own by, and one of the other element."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.scene import ElementName, Scene, divisions_of

Array = NDArray[np.float64]

MOST_DOFS = 15_000
"""Of a scene whose refinement training can afford."""

LINEAR_PER_QUADRATIC = 1.62
"""Linear elements per quadratic one along each axis, for as many degrees of freedom."""


def refined(scene: Scene) -> Scene:
    """Twice as many elements along every axis: more than six times the degrees of freedom."""
    return _meshed(scene, scene.geometry.element, 2.0)


def twin(scene: Scene) -> Scene:
    """About as many degrees of freedom in the other element that does not lock."""
    if scene.geometry.element == "hex20":
        return _meshed(scene, "hex8-mean-dilatation", LINEAR_PER_QUADRATIC)
    return _meshed(scene, "hex20", 1 / LINEAR_PER_QUADRATIC)


def _meshed(scene: Scene, element: ElementName, factor: float) -> Scene:
    divisions = tuple(max(1, round(factor * n)) for n in divisions_of(scene.geometry))
    geometry = scene.geometry.model_copy(update={"element": element, "divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


def mesh_error_document(scene: Scene, dofs: Array, moved: Array) -> dict[str, Any]:
    """Errors of the mean displacement under the footprint, as fractions of that on the finer mesh.

    Parameters
    ----------
    dofs : ndarray, shape (3,)
        Of the scene's mesh, its twin and the finer one.
    moved : ndarray, shape (loads, 3), mm
        Under the footprint, on those.
    """
    elements = scene.geometry.element, twin(scene).geometry.element
    errors = moved[:, :2] / moved[:, 2:] - 1
    return {
        "loads": len(moved),
        "reference_dofs": int(dofs[2]),
        "elements": {
            element: {
                "dofs": int(dofs[i]),
                "mean": float(errors[:, i].mean()),
                "least": float(errors[:, i].min()),
                "greatest": float(errors[:, i].max()),
            }
            for i, element in enumerate(elements)
        },
    }
