"""Pictures of pressed tissue, coloured by von Mises stress; needs the extra ``pictures`` (PyVista).

Two views side by side: the whole body, and a cut through the contact.  Faint lines are the body at
rest.  The endoscope is drawn as a ball of the footprint's radius on a shaft, as deep as the
deformed surface lets it: the model knows its pressure only.
"""

import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.solve import cautions
from palpate.shared.answer import Answer
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import kind_of
from palpate.shared.model import ReducedModel

Fields = Mapping[str, NDArray[np.floating[Any]]]

SIZE = (1500, 720)
SUBDIVISIONS = 3  # of a quadratic face, each halving the edges: curved faces then look curved
SHARP = 35.0  # angle between faces (degrees) that is drawn as an edge of the body at rest
SHAFT = 4.0  # length drawn of the endoscope, in radii
TITLE = (0.04, 0.9)  # where the words stand in a view, as fractions of its size
ROOM = (0.95, 0.72)  # shares of a view's width and height that the drawing may take
COLOURS = "YlOrRd"
INK, FAINT, STEEL = "#202428", "#8a949e", "#5b7c99"
SHINE = {"smooth_shading": True, "ambient": 0.65, "diffuse": 0.45}


def require_pyvista() -> Any:
    """Return the module, or say how to install it."""
    try:
        import pyvista
    except ImportError as error:
        raise PalpateError("pictures need PyVista: pip install 'palpate[pictures]'") from error
    return pyvista


def body(nodes: Array, elements: NDArray[np.integer[Any]], at: Array, fields: Fields) -> Any:
    """A body's grid and its surface, with nodal fields and the distance ``from_contact``."""
    pv = require_pyvista()
    grid = pv.UnstructuredGrid({kind_of(elements).vtk: elements}, nodes)
    for name, values in fields.items():
        grid[name] = values
    surface = grid.extract_surface(algorithm="dataset_surface", nonlinear_subdivision=SUBDIVISIONS)
    surface["from_contact"] = np.linalg.norm(surface.points - at, axis=1)
    return grid, surface


def ring(surface: Any, at: Array, radius: float, thickness: float) -> Any:
    """A tube along the rim of a footprint on a surface of ``body``."""
    rim = surface.contour([radius], scalars="from_contact")
    return rim.connectivity("closest", closest_point=at).tube(radius=thickness * radius)


def new_plotter(shape: tuple[int, int], size: tuple[int, int]) -> Any:
    """A white plotter without a window."""
    pv = require_pyvista()
    # VTK reports every way to a window that it tries in vain
    with pv.vtk_verbosity("off"):
        plotter = pv.Plotter(off_screen=True, shape=shape, window_size=size, border=False)
    plotter.set_background("white")
    return plotter


def save(plotter: Any, out: Path) -> None:
    """Write what is drawn as PNG."""
    out.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(str(out))
    plotter.close()


def picture(
    artifact: Path,
    position: Sequence[float],
    pressure: float,
    direction: Sequence[float] | None,
    out: Path,
) -> None:
    """Press the tissue of an artifact once, at a position (mm) with a pressure (kPa), and draw it.

    Raises
    ------
    PalpateError
        If PyVista is missing, the artifact is unusable or the load makes no sense.
    """
    require_pyvista()
    atlas = ReducedModel.load(artifact)
    solution = atlas.press(position, pressure, direction)
    for said in cautions(atlas, solution):
        print(f"Warning: {said}", file=sys.stderr)
    stress = atlas.von_mises(solution)
    fields = {"displacement": atlas.displacement(solution).astype(float), "von_mises": stress}
    grid, rest = body(atlas.nodes, atlas.body.elements, solution.contact_point, fields)
    pressed = rest.warp_by_vector("displacement")
    endoscope = _endoscope(_tip_centre(pressed.points, solution), solution)
    # at the edge of the support the stress is the mesh's, not the tissue's
    most = max(float(np.ceil(10 * np.percentile(stress, 99.5)) / 10), 0.1)
    paint = {"scalars": "von_mises", "cmap": COLOURS, "clim": (0.0, most), "show_scalar_bar": False}
    normal, across = solution.normal, _across(atlas.nodes, solution)
    cut = {"normal": across, "origin": solution.contact_point}
    words = {"position": TITLE, "viewport": True, "font_size": 11, "color": INK}
    edges = rest.extract_feature_edges(feature_angle=SHARP, boundary_edges=False)
    rim = ring(pressed, solution.contact_point, solution.radius, 0.03)

    plotter = new_plotter((1, 2), SIZE)
    plotter.subplot(0, 0)
    plotter.add_mesh(pressed, **paint, **SHINE)
    if edges.n_points:  # a smooth body has none
        plotter.add_mesh(edges, color=FAINT, line_width=1.5, opacity=0.5)
    plotter.add_mesh(rim, color=INK)
    for part in endoscope:
        plotter.add_mesh(part, color=STEEL, opacity=0.6, smooth_shading=True)
    plotter.add_axes(color=INK, line_width=2)
    plotter.add_text(_caption(solution), **words)
    _look(plotter, normal + 0.9 * across + 0.35 * _up(normal), _up(normal))

    plotter.subplot(0, 1)
    section = grid.warp_by_vector("displacement").tessellate(max_n_subdivide=SUBDIVISIONS)
    painted = plotter.add_mesh(section.slice(**cut), **paint, lighting=False)
    plotter.add_mesh(rest.slice(**cut), color=FAINT, line_width=2)
    plotter.add_mesh(pressed.slice(**cut), color=INK, line_width=2)
    for part in endoscope:
        plotter.add_mesh(part.slice(**cut), color=STEEL, lighting=False, line_width=6)
    plotter.add_text("Cut through the contact\ngrey: at rest", **words)
    plotter.add_scalar_bar(
        "von Mises stress, kPa\n", mapper=painted.mapper, color=INK, n_labels=3, fmt="%.2f",
        position_x=0.2, position_y=0.03, height=0.09, width=0.6, title_font_size=20,
        label_font_size=18,
    )  # fmt: skip
    _look(plotter, across, _up(normal))
    save(plotter, out)


def _tip_centre(surface: Array, solution: Answer) -> Array:
    """Centre of a ball that comes along the load's direction until it meets the surface (k, 3)."""
    d, R = solution.direction, solution.radius
    start = solution.contact_point + solution.contact_displacement
    offset = surface[np.linalg.norm(surface - start, axis=1) < 2 * R] - start
    depth = offset @ d
    beside = np.linalg.norm(offset - depth[:, None] * d, axis=1)
    hit = beside < R
    back = np.max(np.sqrt(R**2 - beside[hit] ** 2) - depth[hit])
    centre: Array = start - back * d
    return centre


def _endoscope(tip: Array, solution: Answer) -> list[Any]:
    """Surfaces of the half ball and of the shaft behind it."""
    pv, d, R = require_pyvista(), solution.direction, solution.radius
    ball = pv.Sphere(radius=R, center=tip, theta_resolution=60, phi_resolution=60)
    shaft = pv.Cylinder(
        center=tip - SHAFT / 2 * R * d, direction=d, radius=R, height=SHAFT * R,
        resolution=60, capping=False,
    )  # fmt: skip
    return [ball.clip(normal=-d, origin=tip), shaft]


def _across(nodes: Array, solution: Answer) -> Array:
    """The axis along which the body is cut: square to the load, or along a long body."""
    extent = np.ptp(nodes, axis=0)
    along_load = np.abs(solution.normal) + np.abs(solution.direction)
    return np.eye(3)[np.argmin(along_load - 0.5 * extent / extent.max())]


def _up(normal: Array) -> Array:
    """The z axis, or the normal where that is it already."""
    z = np.array([0.0, 0.0, 1.0])
    return z if abs(normal @ z) < 0.9 else np.sign(normal @ z) * normal


def _look(plotter: Any, towards: Array, up: Array) -> None:
    """Look from ``towards`` at all that is drawn, so that it leaves room for words and colours."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    bounds = np.reshape(plotter.renderer.bounds, (3, 2))
    centre = bounds.mean(axis=1)
    corners = np.array(list(itertools.product(*bounds))) - centre
    width, height = np.ptp(corners @ right), np.ptp(corners @ np.cross(towards, right))
    distance = 3 * np.linalg.norm(np.ptp(bounds, axis=1))
    plotter.camera_position = [centre + distance * towards, centre, up]
    plotter.camera.parallel_projection = True
    # half the height that is seen; a view is half the picture wide
    aspect = SIZE[0] / 2 / SIZE[1]
    plotter.camera.parallel_scale = max(width / ROOM[0] / aspect, height / ROOM[1]) / 2
    plotter.reset_camera_clipping_range()


def _caption(solution: Answer) -> str:
    moved = float(np.linalg.norm(solution.contact_displacement))
    force = float(np.linalg.norm(solution.force))
    return (
        f"Pressed with {solution.pressure:.1f} kPa ({force:.0f} mN)\n"
        f"the contact gives way by {moved:.1f} mm"
    )
