"""The rigid tip on a bonded layer, for which there is a theory, as an artifact answers it."""

from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.run.tables import write_csv
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Block, SceneError

DEPTHS = 0.1, 0.2, 0.4
"""Of the tip, in mm."""


def layer(artifact: Path) -> dict[str, Any]:
    """Compare forces in the middle of a block's top; write ``layer.csv`` to the report beside it.

    Returns
    -------
    dict
        ``error``: relative error of the force (by theory) at each depth; ``exponent`` of force over
        depth, and that of the theory.
    """
    atlas = ReducedModel.load(artifact)
    geometry, tissue, radius = atlas.scene.geometry, atlas.scene.tissue, atlas.body.tip.radius
    if not isinstance(geometry, Block):
        raise SceneError("geometry.kind: the theory is that of a layer, so it must be a block")
    width, depth, height = geometry.size
    rows = []
    for deep in DEPTHS:
        centre = width / 2, depth / 2, height + radius - deep
        force = float(atlas.touch(centre).force[2])
        theory = ball_on_a_layer(deep, radius, height, tissue.young, tissue.poisson)
        rows.append({"depth_mm": deep, "force_mN": force, "theory_mN": theory})
    write_csv(artifact.parent / artifact.stem / "report" / "layer.csv", rows)
    table = np.array([list(row.values()) for row in rows])
    slopes = np.polyfit(np.log(table[:, 0]), np.log(table[:, 1:]), 1)[0]
    return {
        "force_mN": {str(row["depth_mm"]): row["force_mN"] for row in rows},
        "error": {str(row["depth_mm"]): row["force_mN"] / row["theory_mN"] - 1 for row in rows},
        "exponent": float(slopes[0]),
        "exponent_of_theory": float(slopes[1]),
    }


def ball_on_a_layer(
    depth: float, radius: float, height: float, young: float, poisson: float
) -> float:
    """Force (mN) of a rigid frictionless ball, depth, radius and height of a bonded layer in mm.

    Hertz's law with the layer's correction: Dimitriadis et al., Biophys. J. 82 (2002) 2798, eq. 12.
    """
    a = -(1.2876 - 1.4678 * poisson + 1.3442 * poisson**2) / (1 - poisson)
    b = (0.6387 - 1.0277 * poisson + 1.5164 * poisson**2) / (1 - poisson)
    chi, pi = np.sqrt(radius * depth) / height, np.pi
    factor = (
        1 - 2 * a / pi * chi + 4 * a**2 / pi**2 * chi**2
        - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        + 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    )  # fmt: skip
    return float(4 / 3 * young / (1 - poisson**2) * np.sqrt(radius) * depth**1.5 * factor)
