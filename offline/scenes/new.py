"""A first scene of one's own: what a scene must say, with the meaning of each key."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from palpate.offline.scenes import given
from palpate.shared.errors import PalpateError
from palpate.shared.scene import parse_scene

COMMON = """
name = "{name}"
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
support.side = "{support}"
surface.side = "{surface}"
endoscope.radius = 2.0
endoscope.max_tilt = 30.0
endoscope.tip = true
load.max_indentation = 0.15
"""

SHAPES: Mapping[str, tuple[str, str, str]] = {
    "block": ('geometry.kind = "block"\ngeometry.size = [20.0, 20.0, 8.0]', "bottom", "top"),
    "section": (
        'geometry.kind = "extrusion"\n'
        'geometry.section = "{name}.csv"\n'
        "geometry.corners = [[2.3, 13.6], [2.3, 2.4], [-2.3, 2.4], [-2.3, 13.6]]\n"
        "geometry.length = 20.0",
        "lip",
        "outer",
    ),
}
"""Geometry, support and surface of bodies."""

POINTS = 48
"""Of an outline."""


def new_scene(path: Path, shape: str) -> list[Path]:
    """Write a scene, and the outline of a section; return their files.

    Raises
    ------
    PalpateError
        If one of them is there already, or the name is none for a scene.
    """
    geometry, support, surface = SHAPES[shape]
    text = geometry + COMMON.format(name=path.stem, support=support, surface=surface)
    scene = parse_scene(text.replace("{name}", path.stem), source=str(path))
    head = (
        "# A scene in mm, kPa, s and degrees; every key there is: palpate scene --keys.\n"
        f"# With all defaults: palpate scene {path.name}.  What would be wrong: palpate train "
        f"{path.name} --check.\n\n"
    )
    files = {path: head + given(scene)}
    if shape == "section":
        files[path.with_suffix(".csv")] = _outline()
    for file in files:
        if file.exists():
            raise PalpateError(f"{file} is there already")
    for file, content in files.items():
        file.write_text(content)
    return list(files)


def _outline() -> str:
    """An ellipse, 6 mm wide and 16 mm high, as a closed outline in CSV."""
    angle = 2.0 * np.pi * np.arange(POINTS) / POINTS
    rows = zip(3.0 * np.sin(angle), 8.0 + 8.0 * np.cos(angle), strict=True)
    return "x,z\n" + "".join(f"{x:.4f},{z:.4f}\n" for x, z in rows)
