"""What training finds out about a scene: body, local models, error estimates.

A ``Stored`` field is a dataset of the artifact, with its unit and a description that gives its
shape: n nodes, p local models of r modes (m under the tip) in a basis of M modes of their region.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from palpate.shared.artifact import Stored, values_of
from palpate.shared.geometry.quadrature import surface_quadrature, volume_quadrature
from palpate.shared.mechanics.footprint import SurfaceQuadrature
from palpate.shared.mechanics.laws import law_of
from palpate.shared.mechanics.sphere import Tip, TipSurface, tip_of, tip_surface
from palpate.shared.mechanics.tissue import Law
from palpate.shared.reduced.outcome import HISTORY_FEATURES, PRESS_FEATURES, TOUCH_FEATURES
from palpate.shared.scene import Scene

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Body:
    """Mesh and tissue of a scene, as both sides see them."""

    nodes: Annotated[Array, Stored("nodes", "mm", "nodes (n, 3), dof = 3 node + axis")]
    elements: Annotated[
        NDArray[np.int32],
        Stored("elements", "1", "nodes of each hexahedron (e, 8 or 20), VTK order"),
    ]
    faces: Annotated[
        NDArray[np.int32],
        Stored("faces", "1", "nodes of each boundary face (f, 4 or 8), VTK order, outward"),
    ]
    clamped: Annotated[NDArray[np.bool_], Stored("clamped", "1", "nodes held fixed (n,)")]
    accessible: Annotated[
        NDArray[np.bool_], Stored("accessible", "1", "faces an endoscope can touch (f,)")
    ]
    law: Law  # parameters of the elements (e,)
    tip: Tip

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], scene: Scene) -> Self:
        """Body of an artifact of this scene."""
        law = law_of(scene.tissue, len(arrays["elements"]))
        tip = tip_of(scene.endoscope.radius, scene.tissue.young)
        return cls(**values_of(cls, arrays), law=law, tip=tip)

    @cached_property
    def touchable(self) -> tuple[TipSurface, NDArray[np.int32]]:
        """Faces that the tip can touch, their nodes counted anew, and these nodes (s,)."""
        surface = tip_surface(self.nodes, self.faces, self.accessible, self.tip.radius)
        nodes, faces = np.unique(surface.faces, return_inverse=True)
        own = faces.reshape(surface.faces.shape).astype(np.int32)
        return surface._replace(nodes=self.nodes[nodes], faces=own), nodes

    @cached_property
    def gradients(self) -> Array:
        """Gradients of the shape functions (e, 8, n, 3) at the quadrature points, 1/mm."""
        return volume_quadrature(self.nodes, self.elements, 2)[0]

    @cached_property
    def boundary(self) -> SurfaceQuadrature:
        """Integration points of the whole boundary."""
        return surface_quadrature(self.nodes, self.faces)


@dataclass(frozen=True)
class ViscousModels:
    """What steps in time need beyond elastic local models; n pairs of neighbours."""

    deviatoric: Annotated[
        Field,
        Stored(
            "viscous_deviatoric",
            "1",
            "deviatoric part of the rest stiffness in the modes (p, r, r)",
        ),
    ]
    pairs: Annotated[
        NDArray[np.int32],
        Stored(
            "viscous_pairs", "1", "local models whose spaces meet (n, 2), the lower number first"
        ),
    ]
    overlap: Annotated[
        Field,
        Stored(
            "viscous_overlap", "1", "products of their modes in energy at rest (n, r, r)", half=True
        ),
    ]


@dataclass(frozen=True)
class LocalTips:
    """The same local models under the rigid tip."""

    modes: Annotated[
        Field,
        Stored(
            "tip_modes",
            "1",
            "modes under the tip, orthonormal, in the basis of the region (p, M, m)",
        ),
    ]
    point_from: Annotated[Ints, Stored("tip_from", "1", "first cubature point of each (p + 1,)")]
    points: Annotated[
        NDArray[np.int32], Stored("tip_points", "1", "quadrature point, by element (c,)")
    ]
    weights: Annotated[Array, Stored("tip_weights", "mm^3", "weight of each point (c,)")]
    guess: Annotated[
        Field,
        Stored(
            "tip_guess",
            "1",
            "answer as polynomials of place and depth (p, TIP_FEATURES, m)",
            half=True,
        ),
    ]
    pairs: Annotated[
        NDArray[np.int32],
        Stored("tip_pairs", "1", "local models next to one another (n, 2), the lower number first"),
    ]
    overlaps: Annotated[
        Field,
        Stored(
            "tip_overlaps", "1", "products of their modes in energy at rest (n, m, m)", half=True
        ),
    ]
    residuals: Annotated[
        Array,
        Stored(
            "tip_residuals",
            "1",
            "log of the residual in the full model, polynomials of normal and depth (p, k)",
        ),
    ]
    deviatoric: Annotated[
        Field | None,
        Stored(
            "tip_viscous_deviatoric",
            "1",
            "deviatoric part of the rest stiffness in the modes of the tip (p, m, m)",
        ),
    ] = None


@dataclass(frozen=True)
class LocalModels:
    """Local models under footprints, and the modes of the regions that they are made of."""

    basis: Annotated[
        NDArray[np.int16],
        Stored(
            "basis",
            "basis_steps",
            "modes of each region, orthonormal in energy at rest (regions, M, 3 n)",
            compress=True,
        ),
    ]
    steps: Annotated[Field, Stored("basis_steps", "mm", "value of one step of a mode (regions, M)")]
    region: Annotated[
        NDArray[np.int32], Stored("patch_region", "1", "region of each local model (p,)")
    ]
    centres: Annotated[Array, Stored("patch_centres", "mm", "centres of local models (p, 3)")]
    frames: Annotated[Array, Stored("patch_frames", "1", "rows: normal and two tangents (p, 3, 3)")]
    pressures: Annotated[Array, Stored("patch_pressures", "kPa", "load scale of local models (p,)")]
    whole: Annotated[
        NDArray[np.int16],
        Stored("patch_modes", "patch_mix", "modes in the basis of the region (p, M, r)"),
    ]
    mix: Annotated[
        Field,
        Stored(
            "patch_mix", "1", "makes orthonormal modes of them, triangular (p, r, r)", compress=True
        ),
    ]
    point_from: Annotated[
        Ints, Stored("cubature_from", "1", "first point of each local model (p + 1,)")
    ]
    points: Annotated[
        NDArray[np.int32], Stored("cubature_points", "1", "quadrature point, by element (c,)")
    ]
    weights: Annotated[Array, Stored("cubature_weights", "mm^3", "weight of each point (c,)")]
    defect: Annotated[
        Field,
        Stored(
            "patch_defect",
            "mN",
            "force that cubature misses, polynomials of the load (p, LOAD_FEATURES, r)",
            half=True,
        ),
    ]
    guess: Annotated[
        Field,
        Stored(
            "patch_guess",
            "1",
            "answer beyond the linear one, polynomials of the load (p, LOAD_FEATURES, r)",
            half=True,
        ),
    ]
    directions: Annotated[
        Field,
        Stored(
            "patch_directions",
            "1",
            "orthonormal, in which the tangent changes most (p, CHANGING, r)",
            half=True,
        ),
    ]
    change: Annotated[
        Field,
        Stored(
            "patch_change",
            "1",
            "change of the tangent there, lower triangle (p, TANGENT_FEATURES, CHANGES)",
            half=True,
        ),
    ]
    residuals: Annotated[
        Array,
        Stored("patch_residuals", "1", "log of the residual in the full model, polynomials (p, k)"),
    ]
    extent: Annotated[
        float, Stored("patch_extent", "mm", "largest distance of a contact that it answers")
    ]
    blend: Annotated[float, Stored("patch_blend", "mm", "width of blending")]
    tips: LocalTips | None = None
    viscous: ViscousModels | None = None

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], scene: Scene) -> Self:
        """Local models of an artifact of this scene."""
        return cls(
            **values_of(cls, arrays),
            tips=LocalTips(**values_of(LocalTips, arrays)) if scene.endoscope.tip else None,
            viscous=(
                ViscousModels(**values_of(ViscousModels, arrays)) if scene.tissue.prony else None
            ),
        )

    @property
    def viscous_tips(self) -> ViscousModels | None:
        """What steps in time need under the tip."""
        tips = self.tips
        if tips is None or tips.deviatoric is None:
            return None
        return ViscousModels(tips.deviatoric, tips.pairs, tips.overlaps)

    @cached_property
    def modes(self) -> Field:
        """Modes (p, M, r) of each local model in the basis of its region."""
        return self.whole.astype(np.float32) @ self.mix


@dataclass(frozen=True)
class Estimator:
    """Calibrated error estimate: ``log error = c . features``, one row per quantity.

    For the features see ``reduced.press``.
    """

    coefficients: Array  # (2, features): displacement, von Mises; under the tip also force

    def __call__(self, features: Array) -> list[float]:
        """Estimated relative errors, one for each row."""
        errors: list[float] = np.exp(self.coefficients @ features).tolist()
        return errors


@dataclass(frozen=True)
class Estimators:
    """Error estimates of loads and of the tip, at once and over histories; 1 if not calibrated."""

    loads: Estimator = Estimator(np.zeros((2, PRESS_FEATURES)))
    touches: Estimator = Estimator(np.zeros((3, TOUCH_FEATURES)))
    histories: Estimator = Estimator(np.zeros((2, HISTORY_FEATURES)))
    courses: Estimator = Estimator(np.zeros((3, HISTORY_FEATURES)))

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Estimators:
        """Read from an artifact, which holds those of its scene."""
        return cls(
            **{
                name: Estimator(arrays[dataset])
                for name, dataset in ESTIMATORS.items()
                if dataset in arrays
            }
        )


ESTIMATORS = {
    "loads": "error_coefficients",
    "touches": "tip_error_coefficients",
    "histories": "history_error_coefficients",
    "courses": "tip_history_error_coefficients",
}
"""Where an artifact keeps each."""
