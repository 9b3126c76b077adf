"""A scene before anything is trained: its body, what is held and touched, the endoscope to scale.

Needs the extra ``pictures`` (PyVista).
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.bodies.places import boundary_of_corners, box_of
from palpate.offline.bodies.report import in_words, report
from palpate.offline.choose.mesh import as_fine, candidates
from palpate.offline.doubts import doubts
from palpate.offline.fem.mesh import build_mesh, mesh_quality
from palpate.offline.info import labelled
from palpate.offline.pictures import INK, SHINE, STEEL, body, new_plotter, require_pyvista, save
from palpate.offline.scenes import opened_scene
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array, Flags
from palpate.shared.geometry.elements import face_kind_of
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Scene, SceneError

SIZE = (1600, 900)
HELD, TOUCHED, FREE, REGION = "#b4463c", "#4c8fc7", "#d9d4cc", "#e0a030"
THROUGH = 0.3  # opacity of a body with regions, seen from the other side
FACE_TYPES = {4: 9, 6: 22, 8: 23}  # VTK's quadrilateral and quadratic ones, by nodes per face
SUBDIVISIONS = 2  # of a quadratic face
FROM = np.array([0.6, -0.7, 0.4])  # whence a body is seen that is touched nowhere
TITLE = (0.02, 0.86)
ABOVE = 0.003  # of the size of the body, how far lines lie above its faces
ASIDE = 0.45  # of the way across, how far a view is turned from the way that is looked along


def look(scene: str | Path, out: Path | None = None) -> tuple[Path, list[str]]:
    """Draw a scene; return the picture's file and what there is to know of its body, in lines.

    Parameters
    ----------
    scene : str or Path
        Shipped name or TOML file.
    out : Path, optional
        ``artifacts/NAME/report/look.png`` if absent.

    Raises
    ------
    PalpateError
        If PyVista is missing, the scene is wrong, or its body cannot be meshed.  Where support or
        surface are wrong the body is drawn all the same, without them.
    """
    require_pyvista()
    with opened_scene(scene) as found:
        return _look(found, out)


def _look(found: Scene, out: Path | None) -> tuple[Path, list[str]]:
    """Draw a scene that is read; see ``look``."""
    if not isinstance(found.geometry, FileBody) and found.fineness_of_mesh is None:
        found = as_fine(found, candidates(found)[0])
    path = out or Path("artifacts") / found.name / "report" / "look.png"
    try:
        mesh = build_mesh(found)
    except SceneError as wrong:
        _draw(found, build_mesh(found, bare=True), path)
        raise SceneError(f"{wrong}; {path} shows it") from wrong
    _draw(found, mesh, path)
    slips = (f"is this meant? {doubt}" for doubt in doubts(found, mesh.nodes))
    return path, [*labelled(_said(found, mesh)), *slips]


def _held(mesh: Mesh) -> Flags:
    """Faces that are held (f,)."""
    return np.asarray(mesh.clamped[mesh.faces].all(axis=1))


def _corners(mesh: Mesh) -> Array:
    """Corners (f, 3 or 4, 3) mm of the boundary's faces."""
    return mesh.nodes[mesh.faces[:, : face_kind_of(mesh.faces).corners]]


def _said(scene: Scene, mesh: Mesh) -> Mapping[str, str]:
    """What there is to know of a body, by what it is about."""
    said = {
        "scene": f"{scene.name}: {scene.description}",
        "body": f"{box_of(mesh.nodes)}; {len(mesh.elements)} elements {scene.geometry.element}, "
        f"{mesh.nodes.size} DOFs",
        "held": f"{scene.support.in_words()}; {_area(mesh, _held(mesh)):.3g} mm²",
        "touchable": f"{scene.surface.in_words()}; {_area(mesh, mesh.accessible):.3g} mm²",
    }
    if scene.tissue.region:
        said["regions"] = "; ".join(_said_of_regions(scene, mesh))
    if not isinstance(scene.geometry, FileBody):
        return said | {"volume": f"{mesh_quality(mesh)['volume_mm3']:.4g} mm³"}
    return said | in_words(report(scene))


def _said_of_regions(scene: Scene, mesh: Mesh) -> Iterator[str]:
    for number, region in enumerate(scene.tissue.region, 1):
        part = replace(mesh, elements=mesh.elements[mesh.region == number])
        volume = mesh_quality(part)["volume_mm3"]
        yield f"{region.name} ({region.in_words()}) {len(part.elements)} elements, {volume:.3g} mm³"


def _area(mesh: Mesh, chosen: Flags) -> float:
    corners = _corners(mesh)[chosen]
    halves = [corners[:, [0, 1, 2]], corners[:, [0, 2, -1]]]
    cross = [np.cross(h[:, 1] - h[:, 0], h[:, 2] - h[:, 0]) for h in halves]
    return float(sum(np.linalg.norm(c, axis=1).sum() for c in cross)) / 2.0


def _draw(scene: Scene, mesh: Mesh, out: Path) -> None:
    held = _held(mesh)
    centres, normals = boundary_of_corners(_corners(mesh))
    shown = mesh.accessible if mesh.accessible.any() else normals @ FROM > 0.5
    towards, middle = normals[shown].mean(axis=0), centres[shown].mean(axis=0)
    at = np.flatnonzero(shown)[np.argmin(np.linalg.norm(centres[shown] - middle, axis=1))]
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    plotter = new_plotter((1, 2), SIZE)
    parts = {TOUCHED: mesh.accessible, HELD: held & ~mesh.accessible}
    parts[FREE] = ~(mesh.accessible | held)
    inner = mesh.elements[mesh.region > 0]
    for view, (way, words) in enumerate(zip((towards, -towards), _legends(scene), strict=True)):
        plotter.subplot(0, view)
        opacity = THROUGH if view and len(inner) else 1.0
        for colour, chosen in parts.items():
            if chosen.any():
                plotter.add_mesh(_faces(mesh, chosen), color=colour, opacity=opacity, **SHINE)
        if opacity < 1.0:
            plotter.add_mesh(body(mesh.nodes, inner, centres[at], {})[1], color=REGION, **SHINE)
        plotter.add_mesh(_edges(mesh), color=INK, line_width=1, opacity=0.35)
        for part in _endoscope(centres[at], normals[at], scene.endoscope.radius):
            plotter.add_mesh(part, color=STEEL, opacity=0.75, smooth_shading=True)
        plotter.add_text(words, position=TITLE, viewport=True, font_size=11, color=INK)
        plotter.show_bounds(
            xtitle="x, mm", ytitle="y, mm", ztitle="z, mm", color=INK, font_size=10, fmt="%.3g",
            bounds=np.column_stack([low, high]).ravel(), location="outer",
        )  # fmt: skip
        _turn(plotter, way, mesh.nodes)
    save(plotter, out)


def _legends(scene: Scene) -> tuple[str, str]:
    """What is written above either view."""
    inner = ", ".join(region.name for region in scene.tissue.region)
    radius = f"steel: the endoscope, radius {scene.endoscope.radius:g} mm"
    return (
        f"{scene.name}. From where it is touched\nblue: can be touched\nred: held\ngrey: free",
        f"{scene.name}. From the other side\n{radius}" + (f"\namber: {inner}" if inner else ""),
    )


def _faces(mesh: Mesh, chosen: Flags) -> Any:
    """The chosen faces, curved as they are."""
    pv = require_pyvista()
    faces = mesh.faces[chosen]
    grid = pv.UnstructuredGrid({FACE_TYPES[faces.shape[1]]: faces}, mesh.nodes)
    return grid.extract_surface(algorithm="dataset_surface", nonlinear_subdivision=SUBDIVISIONS)


def _edges(mesh: Mesh) -> Any:
    """The sides of all faces as lines, a little above the body."""
    pv = require_pyvista()
    corners = face_kind_of(mesh.faces).corners
    ways = [mesh.faces[:, :corners], np.roll(mesh.faces[:, :corners], -1, axis=1)]
    if mesh.faces.shape[1] > corners:
        ways.insert(1, mesh.faces[:, corners:])
    path = np.stack(ways, axis=-1).reshape(-1, len(ways))
    lines = np.column_stack([np.full(len(path), path.shape[1]), path])
    outward = np.zeros_like(mesh.nodes)
    np.add.at(outward, mesh.faces, boundary_of_corners(_corners(mesh))[1][:, None])
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    above = ABOVE * np.linalg.norm(np.ptp(mesh.nodes, axis=0))
    return pv.PolyData(mesh.nodes + above * outward, lines=lines.ravel())


def _endoscope(at: Array, normal: Array, radius: float) -> list[Any]:
    """A ball that touches a point of the surface, and the rim of the footprint there."""
    pv = require_pyvista()
    ball = pv.Sphere(radius=radius, center=at + radius * normal)
    rim = pv.Disc(center=at + 0.02 * radius * normal, normal=normal, inner=0.95 * radius,
                  outer=1.05 * radius, c_res=60)  # fmt: skip
    return [ball, rim]


def _turn(plotter: Any, towards: Array, nodes: Array) -> None:
    """Look from ``towards``, turned a little to the side, at all nodes."""
    towards = towards / np.linalg.norm(towards)
    z = np.array([0.0, 0.0, 1.0])
    up = z if abs(towards[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(up, towards)
    way = towards + ASIDE * (across / np.linalg.norm(across) + 0.6 * up)
    centre = (nodes.min(axis=0) + nodes.max(axis=0)) / 2.0
    size = np.linalg.norm(np.ptp(nodes, axis=0))
    plotter.camera_position = [centre + 3.0 * size * way / np.linalg.norm(way), centre, up]
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = 0.62 * size
    plotter.reset_camera_clipping_range()
