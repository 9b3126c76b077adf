"""What training finds out about a scene: body, local models, error estimates.

A ``Stored`` field is a dataset of the artifact: its name, unit, shape and description.  There are n
nodes, e elements, f faces of the boundary, v vertices and t triangles of the accessible surface; p
local models of r modes in a basis of M modes of their region, R regions, N nodes of all their
windows, G modes of the whole body; c points of all cubatures.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.shared.arrays import Array, Field, Flags, Ints, Numbers
from palpate.shared.artifact import values_of
from palpate.shared.geometry.edges import sharp_points
from palpate.shared.geometry.elements import kind_of
from palpate.shared.geometry.quadrature import (
    LOAD_SPACING,
    WIDER,
    surface_quadrature,
    volume_quadrature,
)
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, SurfaceQuadrature
from palpate.shared.mechanics.laws import law_at_points, law_of
from palpate.shared.mechanics.tip import CURVED_WITHIN, Tip, tip_of
from palpate.shared.mechanics.tissue import Law, lame
from palpate.shared.reduced.features import (
    CHANGES,
    CHANGING,
    LOAD_FEATURES,
    RESIDUAL_FEATURES,
    TANGENT_FEATURES,
)
from palpate.shared.reduced.outcome import HISTORY_FEATURES, PRESS_FEATURES, TOUCH_FEATURES
from palpate.shared.scene import Scene

CLAMPED_LAYER = 1.5
"""Millimetres from the support within which stress is not compared: at its edges it has no limit,
and grows with every refinement of the mesh."""

NO_EDGE = 1e6
"""Millimetres from a sharp edge of a body that has none."""


@dataclass(frozen=True)
class Mesh:
    """A body of n nodes, e elements and f boundary faces, outward by the right-hand rule."""

    nodes: Annotated[Array, "nodes", "mm", "n, 3", "nodes; dof = 3 node + axis"]
    elements: Annotated[Numbers, "elements", "1", "e, k", "nodes of elements, VTK order", "< n"]
    faces: Annotated[Numbers, "faces", "1", "f, h", "nodes of boundary faces, VTK order", "< n"]
    clamped: Annotated[Flags, "clamped", "1", "n", "nodes held fixed"]
    accessible: Annotated[Flags, "accessible", "1", "f", "faces an endoscope can touch"]
    regions: Annotated[
        Numbers | None, "regions", "1", "e", "regions of elements, from 1 on; 0 is none", "< 21"
    ] = None

    @property
    def region(self) -> Numbers:
        """Regions (e,) of the elements, 0 where they are in none."""
        return np.zeros(len(self.elements), np.int32) if self.regions is None else self.regions


@dataclass(frozen=True, kw_only=True)
class Body(Mesh):
    """Mesh and tissue of a scene, as both sides see them."""

    law: Law  # parameters of the elements (e,)
    touched: tuple[float, float]  # kPa, mu and lam at rest of the tissue that can be touched
    tip: Tip

    @classmethod
    def of(cls, mesh: Mesh, scene: Scene) -> Self:
        """Body of a scene on a mesh."""
        tissue = scene.tissue
        return cls(
            **vars(mesh),
            law=law_of(tissue, mesh.region),
            touched=lame(tissue.young, tissue.poisson),
            tip=tip_of(scene.endoscope.radius, tissue),
        )

    @cached_property
    def point_law(self) -> Law:
        """Parameters (e, q) of the law at the quadrature points."""
        return law_at_points(self.law, kind_of(self.elements).integration[2])

    @cached_property
    def gradients(self) -> Array:
        """Gradients of the shape functions (e, q, n, 3) at the quadrature points, 1/mm."""
        return volume_quadrature(self.nodes, self.elements)[0]

    def beyond_clamped_layer(self, points: Array) -> Flags:
        """Which of points (k, 3) are farther from the support than ``CLAMPED_LAYER``, (k,).

        In a thinner body those farther than half of the farthest.
        """
        distance, _ = cKDTree(self.nodes[self.clamped]).query(points)
        return np.asarray(distance > min(CLAMPED_LAYER, 0.5 * distance.max()))

    def contact_fields(self, surface: Surface) -> Array:
        """What the law of a tip needs to know of the body at vertices, (v, CONTACT_FIELDS)."""
        other = self._points_on(self.faces[~self.accessible])
        beyond = np.hstack([other.points, other.normals])
        bent = surface.curvature(CURVED_WITHIN * self.tip.radius, beyond)
        points, sharpness = sharp_points(self.nodes, self.faces, self.clamped)
        away = np.full(len(bent), NO_EDGE)
        for share in np.unique(sharpness.round(2)):
            tree = cKDTree(points[sharpness.round(2) == share])
            image = self.tip.image_distance(tree.query(surface.vertices)[0], share)
            away = np.minimum(away, image)
        return np.column_stack([bent, away, surface.gradient(away)])

    @cached_property
    def boundary(self) -> SurfaceQuadrature:
        """Integration points of the whole boundary."""
        return self._points_on(self.faces)

    @cached_property
    def boundary_tree(self) -> cKDTree:
        """Finds these points near another."""
        return cKDTree(self.boundary.points)

    def _points_on(self, faces: Numbers) -> SurfaceQuadrature:
        return surface_quadrature(self.nodes, faces, max(LOAD_SPACING, WIDER * self.tip.radius))


@dataclass(frozen=True)
class LoadRange:
    """What an endoscope may do at the vertices of the accessible surface."""

    limits: Annotated[
        Array,
        "load_range",
        "kPa, mm/kPa, mm",
        f"v, {LIMIT_FIELDS}",
        "limit along the normal, compliance, depth of the tip",
    ]


@dataclass(frozen=True)
class ViscousModels:
    """What steps in time need beyond elastic local models; n pairs of neighbours."""

    deviatoric: Annotated[
        Field, "viscous_deviatoric", "1", "p, r, r", "deviatoric rest stiffness in the modes"
    ]
    pairs: Annotated[
        Numbers, "viscous_pairs", "1", "m, 2", "local models whose spaces meet, ascending", "< p"
    ]
    overlap: Annotated[
        Field, "viscous_overlap", "1", "m, r, r", "their modes' products at rest", "", "half"
    ]


@dataclass(frozen=True)
class LocalModels:
    """Local models, and the modes of the regions that they are made of.

    Modes of a region are ``far`` combinations of the modes of the body everywhere, and more in its
    window.
    """

    body: Annotated[
        NDArray[np.int16], "body_modes", "body_steps", "G, 3 n", "modes of the body", "", "compress"
    ]
    body_steps: Annotated[Field, "body_steps", "mm", "G", "value of one step of a mode"]
    shares: Annotated[
        NDArray[np.int16],
        "basis_far",
        "basis_far_steps",
        "R, M, G",
        "body modes in regions'",
        "",
        "compress",
    ]
    share_steps: Annotated[Field, "basis_far_steps", "1", "R, M", "value of one step of these"]
    node_from: Annotated[
        Ints, "window_from", "1", "R + 1", "first node of each window", "rising to N"
    ]
    nodes: Annotated[Numbers, "window_nodes", "1", "N", "nodes of all windows", "< n"]
    basis: Annotated[
        NDArray[Any], "basis", "basis_steps", "3 M N", "more modes there, by region", "", "compress"
    ]
    steps: Annotated[Field, "basis_steps", "mm", "R, M", "value of one step of a mode"]
    region: Annotated[Numbers, "patch_region", "1", "p", "region of each local model", "< R"]
    centres: Annotated[Array, "patch_centres", "mm", "p, 3", "centres of local models"]
    frames: Annotated[Array, "patch_frames", "1", "p, 3, 3", "rows: normal and two tangents"]
    pressures: Annotated[Array, "patch_pressures", "kPa", "p", "load scale of local models", "> 0"]
    whole: Annotated[NDArray[np.int16], "patch_modes", "patch_mix", "p, M, r", "modes in the basis"]
    mix: Annotated[Field, "patch_mix", "1", "p, r, r", "makes them orthonormal", "", "compress"]
    point_from: Annotated[
        Ints, "cubature_from", "1", "p + 1", "first point of each local model", "rising to c"
    ]
    points: Annotated[Numbers, "cubature_points", "1", "c", "quadrature point by element", "< 8 e"]
    weights: Annotated[Array, "cubature_weights", "mm^3", "c", "weight of each point"]
    defect: Annotated[
        Field,
        "patch_defect",
        "mN",
        f"p, {LOAD_FEATURES}, r",
        "force that cubature misses",
        "",
        "half",
    ]
    guess: Annotated[
        Field,
        "patch_guess",
        "1",
        f"p, {LOAD_FEATURES}, r",
        "answer beyond the linear one",
        "",
        "half",
    ]
    directions: Annotated[
        Field,
        "patch_directions",
        "1",
        f"p, {CHANGING}, r",
        "of most change of the tangent",
        "",
        "half",
    ]
    change: Annotated[
        Field,
        "patch_change",
        "1",
        f"p, {TANGENT_FEATURES}, {CHANGES}",
        "that change there",
        "",
        "half",
    ]
    residuals: Annotated[
        Array,
        "patch_residuals",
        "1",
        f"p, {RESIDUAL_FEATURES}",
        "log of the residual in the full model",
    ]
    cubature_errors: Annotated[
        Array,
        "patch_cubature_errors",
        "1",
        "p, s",
        "of displacement beside every point; nan: none",
        "nan",
    ]
    extent: Annotated[float, "patch_extent", "mm", "", "largest distance of a contact", "> 0"]
    blend: Annotated[float, "patch_blend", "mm", "", "width of blending", "> 0"]
    viscous: ViscousModels | None = None

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], scene: Scene) -> Self:
        """Local models of an artifact of this scene."""
        return cls(
            **values_of(cls, arrays),
            viscous=(
                ViscousModels(**values_of(ViscousModels, arrays)) if scene.tissue.prony else None
            ),
        )

    def window(self, region: int) -> tuple[Numbers, NDArray[Any]]:
        """Nodes (k,) of the window of a region, and what its modes (M, 3 k) have more there."""
        own, row = slice(*self.node_from[region : region + 2]), 3 * self.steps.shape[1]
        basis = self.basis[row * own.start : row * own.stop]
        return self.nodes[own], basis.reshape(self.steps.shape[1], -1)

    @cached_property
    def far(self) -> Field:
        """Body modes in those of regions (R, M, G)."""
        return self.shares * self.share_steps[:, :, None]

    @cached_property
    def modes(self) -> Field:
        """Modes (p, M, r) of each local model in the basis of its region."""
        return self.whole.astype(np.float32) @ self.mix


_FITTED = "log error = c . features; rows: displacement, von Mises, under the tip force"


@dataclass(frozen=True)
class Estimators:
    """Calibrated error estimates of loads and of the tip, at once and over histories."""

    loads: Annotated[Array | None, "error_coefficients", "1", f"2, {PRESS_FEATURES}", _FITTED] = (
        None
    )
    touches: Annotated[
        Array | None, "tip_error_coefficients", "1", f"3, {TOUCH_FEATURES}", _FITTED
    ] = None
    histories: Annotated[
        Array | None, "history_error_coefficients", "1", f"2, {HISTORY_FEATURES}", _FITTED
    ] = None
    courses: Annotated[
        Array | None, "tip_history_error_coefficients", "1", f"3, {HISTORY_FEATURES}", _FITTED
    ] = None
    mesh: Annotated[
        Array | None,
        "mesh_error_coefficients",
        "1",
        "3, 3",
        "same for the mesh; 1, load / limit, near the rim",
    ] = None
    mesh_tip: Annotated[
        Array | None,
        "tip_mesh_error_coefficients",
        "1",
        "3, 3",
        "same under the tip; 1, depth / limit, near the rim",
    ] = None

    def missing(self, scene: Scene) -> list[str]:
        """Names of those that answers of a scene need and that are not there."""
        needed = ["loads", "mesh"]
        needed += ["touches", "mesh_tip"] if scene.endoscope.tip else []
        needed += ["histories"] if scene.tissue.prony else []
        needed += ["courses"] if scene.endoscope.tip and scene.tissue.prony else []
        return [name for name in needed if getattr(self, name) is None]

    def coefficients(self, tip: bool, in_time: bool) -> Array:
        """Of answers to loads or under the tip, at once or in time; 0 if not calibrated."""
        loads, touches = (self.histories, self.courses) if in_time else (self.loads, self.touches)
        found = touches if tip else loads
        if found is not None:
            return found
        at_once = TOUCH_FEATURES if tip else PRESS_FEATURES
        return np.zeros((3 if tip else 2, HISTORY_FEATURES if in_time else at_once))
