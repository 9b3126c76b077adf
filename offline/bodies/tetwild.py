"""fTetWild (Hu et al., ACM Trans. Graph. 39, 2020) in a process of its own.

It fills triangles with tetrahedra whose boundary lies within an envelope of them.  Two runs give
two meshes, so a mesh is kept once it is made.  The process works in a folder of its own, since the
library leaves files where it works.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.offline.bodies.files import require
from palpate.shared.arrays import Array, Numbers
from palpate.shared.scene import SceneError

LONGEST = 1800.0
"""Seconds that a mesh may take."""


def filled(
    path: Path, closed: Sequence[tuple[Array, Numbers]], edge: float, deviation: float
) -> tuple[Array, Numbers]:
    """Points (n, 3) mm and tetrahedra (e, 4) inside the first of closed surfaces, of a file.

    Others, within it, are followed as well.  Surfaces are points (p, 3) mm and triangles (t, 3);
    ``edge`` (mm) is how long edges should be, ``deviation`` (mm) the width of the envelope.
    """
    require("pytetwild")
    points = np.concatenate([own for own, _ in closed])
    starts = np.cumsum([0] + [len(own) for own, _ in closed])
    triangles = np.concatenate([own + at for (_, own), at in zip(closed, starts, strict=False)])
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder, "surface.npz"), Path(folder, "tetrahedra.npz")
        share = deviation / np.linalg.norm(np.ptp(points, axis=0))
        np.savez(given, points=points, triangles=triangles, edge=edge, share=share)
        command = [sys.executable, "-m", __name__, str(given), str(found)]
        try:
            ended = subprocess.run(command, capture_output=True, timeout=LONGEST, check=False)
        except subprocess.TimeoutExpired as error:
            raise SceneError(
                f"{path}: no mesh of it within {LONGEST / 60:.0f} minutes; a larger "
                "geometry.deviation or geometry.edge makes a coarser one"
            ) from error
        if ended.returncode or not found.exists():
            raise SceneError(
                f"{path}: the surface cannot be filled with tetrahedra (fTetWild ended with status "
                f"{ended.returncode}); repair it, or change geometry.deviation"
            )
        with np.load(found) as mesh:
            points, tetrahedra = mesh["points"], mesh["tetrahedra"]
    if not len(tetrahedra):
        raise SceneError(
            f"{path}: nothing of the body remains: it is thinner than geometry.deviation = "
            f"{deviation:g} mm; state a smaller one"
        )
    return points, tetrahedra


def main(given: str, found: str) -> None:
    """Mesh the surface of one file into another."""
    os.chdir(Path(given).parent)
    from pytetwild import tetrahedralize

    with np.load(given) as surface:
        points, tetrahedra = tetrahedralize(
            surface["points"],
            surface["triangles"].astype(np.int32),
            edge_length_abs=float(surface["edge"]),
            epsilon=float(surface["share"]),
            vtk_ordering=True,
        )
    np.savez(found, points=points, tetrahedra=tetrahedra)


if __name__ == "__main__":
    main(*sys.argv[1:])
