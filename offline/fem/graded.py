"""Meshes of a body graded towards one contact: what a scene's own mesh is measured by."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.bodies.base import base_mesh
from palpate.offline.bodies.mesh import stored_mesh, support_edges
from palpate.offline.bodies.refine import refined
from palpate.offline.bodies.tetrahedra import half_thickness
from palpate.offline.fem.body_mesh import BodyMesh, LatticeMesh, NestedMesh
from palpate.offline.fem.mesh import Ticks, accessible_surface
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.shapes import shape_of
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array
from palpate.shared.scene import Extrusion, Scene

STEPS = 400
"""Of a line through the contact, along which lengths are measured."""

CLOSER, GRID = 6, 24
"""Rounds in which a point's parameters are sought, and steps of the grid of each."""


class Grading(NamedTuple):
    """Edges of elements, in radii of the endoscope."""

    finest: float = 0.1  # at the contact
    even: float = 0.3  # distance from the contact up to which they stay so
    growth: float = 0.9  # of an edge over its distance from there
    coarsest: float = 2.0  # of a body from a file at least half of how thick it is
    support: float = 0.05  # at the edges of a clamped lip, on whose meshing all hangs
    held: float = 0.5  # where what is held of a body from a file ends, which is a long line


FIT_FOR_FOOTPRINTS = Grading(finest=0.2, even=0.8, growth=0.7, coarsest=1.2)
"""Some 92 000 to 118 000 degrees of freedom on the turbinate.  Beside 142 000 to 166 000, with
elements of .8 radii far away, displacement differs by .1 % and von Mises stress by 3 to 4 %; with
elements of 2 radii stress by 5 to 13."""

FIT_FOR_THE_TIP = Grading(finest=0.1, even=0.2, growth=1.0)
"""Some 35 000 to 48 000 degrees of freedom on the turbinate.  A tip as deep as a twentieth of its
radius touches four faces across; beside 47 000 with edges of .06 its force there is .2 % less, the
fields at the nodes of a scene's own mesh differ by .4 (displacement) and 8 % (von Mises)."""


class Graded:
    """The full model of a scene on a mesh fine where its surface is next to a ``contact`` (3,) mm.

    In a body many radii thick edges grow with the distance from there alone: on ``liver`` (159 000
    degrees of freedom, 28 radii long) displacement differs by .1 % and von Mises stress by 2 to 4 %
    from those of edges of 1.4 radii at most (364 000).  At the edges of a clamped lip, or of what
    else is held, it is fine too: displacement goes as the root of the distance from there.
    """

    def __init__(self, scene: Scene, contact: Array, how: Grading) -> None:
        self.mesh = own = _graded(scene, contact, how)
        self.problem, self.sites = FullProblem(scene, own.mesh, own.surface), own.sites

    def at(self, sites: Array, field: Array) -> Array:
        """A nodal field (n, ...) of this mesh at sites (k, ...) of another, see ``BodyMesh``."""
        return self.mesh.at(sites, field)


def _graded(scene: Scene, contact: Array, how: Grading) -> BodyMesh:
    if not isinstance(scene.geometry, FileBody):
        return LatticeMesh(scene, _ticks(scene, contact, how))
    base, radius, held = base_mesh(scene), scene.endoscope.radius, cKDTree(support_edges(scene))
    coarsest = max(how.coarsest, half_thickness(base.nodes, base.elements) / radius)
    place = accessible_surface(stored_mesh(scene)).project(contact)[0]

    def wanted(points: Array) -> Array:
        away = np.linalg.norm(points - place, axis=1) / radius
        edge = how.finest + how.growth * np.maximum(away - how.even, 0.0)
        from_held = np.asarray(held.query(points)[0]) / radius
        edge = np.minimum(edge, how.held + how.growth * from_held)
        return radius * np.minimum(edge, coarsest)

    return NestedMesh(scene, refined(base, wanted))


def _ticks(scene: Scene, contact: Array, how: Grading) -> Ticks:
    """Ticks of a mesh as fine as wanted along the three lines through a contact."""
    body, radius, at = shape_of(scene), scene.endoscope.radius, _nearest(scene, contact)
    hangs = isinstance(scene.geometry, Extrusion) and scene.support.side == "lip"
    line, ticks = np.linspace(0.0, 1.0, STEPS + 1), []
    for axis in range(3):
        along = [line if k == axis else at[k : k + 1] for k in range(3)]
        points = body.grid(*along).reshape(-1, 3)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))) / radius
        away = np.abs(arc - np.interp(at[axis], line, arc))
        edge = how.finest + how.growth * np.maximum(away - how.even, 0.0)
        if hangs and axis != 1:  # the lip is the first end of the section, its edges both sides
            end = arc if axis == 0 else np.minimum(arc, arc[-1] - arc)
            edge = np.minimum(edge, how.support + how.growth * end)
        density = 1.0 / np.minimum(edge, how.coarsest)
        count = np.append(0.0, np.cumsum(np.diff(arc) * (density[1:] + density[:-1]) / 2))
        ticks.append(
            np.interp(np.linspace(0.0, count[-1], int(np.ceil(count[-1])) + 1), count, line)
        )
    first, second, third = ticks
    return first, second, third


def _nearest(scene: Scene, point: Array) -> Array:
    """Parameters (3,) of the point of a body nearest to a point (3,) mm."""
    body, low, high = shape_of(scene), np.zeros(3), np.ones(3)
    for _ in range(CLOSER):
        lines = [np.linspace(a, b, GRID + 1) for a, b in zip(low, high, strict=True)]
        grid = body.grid(*lines)
        away = np.sum((grid - point) ** 2, axis=-1)
        found = np.unravel_index(np.argmin(away), away.shape)
        at = np.array([line[i] for line, i in zip(lines, found, strict=True)])
        reach = 2 * (high - low) / GRID
        low, high = np.maximum(at - reach, 0.0), np.minimum(at + reach, 1.0)
    return at
