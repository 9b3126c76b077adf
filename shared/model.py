"""An artifact in memory, ready to answer: locate, solve, recover fields, state the trust."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.shared.artifact import Artifact, ArtifactError, read_artifact
from palpate.shared.compiled import bind
from palpate.shared.errors import QueryError
from palpate.shared.geometry.quadrature import (
    stress_recovery,
    surface_quadrature,
    volume_quadrature,
)
from palpate.shared.geometry.surface import UPRIGHT, Surface, SurfaceIndex, boundary_triangles
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH, SurfaceQuadrature
from palpate.shared.mechanics.sphere import Tip, TipSurface, tip_of, tip_surface
from palpate.shared.mechanics.stress import (
    nodal_von_mises,
    nodal_von_mises_after,
    remember,
    remember_linearly,
)
from palpate.shared.mechanics.tissue import lame
from palpate.shared.mechanics.viscosity import Weights, step_weights
from palpate.shared.reduced import tip_history, touch
from palpate.shared.reduced.history import (
    HISTORY_FEATURES,
    History,
    HistoryTransfer,
    Moment,
    Remembered,
    TimeStepper,
    ViscousModels,
    judge,
)
from palpate.shared.reduced.press import (
    DEPARTURE,
    DISTANCE,
    ERROR_DISPLACEMENT,
    ERROR_FEATURES,
    ERROR_VON_MISES,
    FEATURES,
    ITERATIONS,
    LANES,
    LEADING,
    LIMIT,
    MAX_ACTIVE,
    NARROW,
    RESIDUAL,
    RESIDUAL_FEATURES,
    SCALARS,
    SMALLEST_J,
    STATE,
    STATUS,
    TILE,
    TILT,
    Memory,
    Outcome,
    Patches,
    Scratch,
    Solver,
    Terms,
    expand,
    query,
)
from palpate.shared.reduced.press_in_time import place
from palpate.shared.reduced.tip_history import TipTimeStepper
from palpate.shared.reduced.touch import (
    MAX_ITERATIONS,
    TIP_ERROR_FEATURES,
    LocalTips,
    Points,
    TipModels,
    TipState,
    Touch,
)
from palpate.shared.scene import Scene, SceneError, parse_scene

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Region = Literal["surface", "all"]

REACH = 0.8
"""Radius of a contact at most, in radii of the tip: nearer faces count."""

MIDDLE = 0.6
"""Height over a patch of a tip half as deep as may be, in radii of the tip."""

BESIDE = 0.1
"""Millimetres beyond the rim of the surface at which the answer is not to the question any more."""

_INWARD = np.zeros(3)
"""Direction that stands for the inward normal."""

_WEIGHT = slice(0, MAX_ACTIVE)
_POINT, _NORMAL, _DIRECTION, _FORCE, _DISPLACEMENT = (
    slice(_WEIGHT.stop + 3 * i, _WEIGHT.stop + 3 * i + 3) for i in range(5)
)
_RANGE = slice(_DISPLACEMENT.stop, _DISPLACEMENT.stop + LIMIT_FIELDS)
_FEATURES = slice(_RANGE.stop, _RANGE.stop + ERROR_FEATURES)
_SCALARS = slice(_FEATURES.stop, None)
"""Where the parts of an outcome lie in a state's record."""


@dataclass(frozen=True)
class Body:
    """Mesh and tissue of a scene, as both sides see them.

    Attributes
    ----------
    nodes : ndarray, shape (n, 3), mm
    elements : ndarray, shape (e, 8) or (e, 20), int32
    faces : ndarray, shape (f, 4) or (f, 8), int32
    clamped : ndarray, shape (n,), bool
    accessible : ndarray, shape (f,), bool
        Faces an endoscope can touch.
    mu, lam : ndarray, shape (e,), kPa
    tip : Tip
        That touches it.
    """

    nodes: Array
    elements: NDArray[np.int32]
    faces: NDArray[np.int32]
    clamped: NDArray[np.bool_]
    accessible: NDArray[np.bool_]
    mu: Array
    lam: Array
    tip: Tip

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
class LocalModels:
    """What training finds out about p patches of r wide modes each, from regions of M modes each.

    Attributes
    ----------
    basis : ndarray, shape (regions, M, 3 n), int16
        Modes of each region in steps of ``steps``; orthonormal in the energy of the rest state.
    steps : ndarray, shape (regions, M), float32, mm
    region : ndarray, shape (p,), int32
        Region of each patch.
    centres : ndarray, shape (p, 3), mm
    frames : ndarray, shape (p, 3, 3)
        Rows: outward normal and two tangents.
    pressures : ndarray, shape (p,), kPa
        Load scale.
    whole, mix : ndarray, shape (p, M, r), int16, and (p, r, r), float32
        Wide modes of each patch in the basis of its region are ``whole @ mix``: whole numbers, and
        the upper triangular matrix that makes orthonormal modes of them.
    point_from : ndarray, shape (p + 1,), int64
        Cubature points of patch k are rows ``point_from[k] : point_from[k + 1]``.
    points : ndarray, shape (c,), int32
        Quadrature point, counted element by element.
    weights : ndarray, shape (c,), mm^3
    path : ndarray, shape (p, PATH_FEATURES, r), float32
        Second and third derivative of the equilibrium along a load path, as polynomials.
    defect : ndarray, shape (p, PATH_FEATURES, r), float32, mN
        Force that the cubature misses in equilibrium, as polynomials of the load.
    guess : ndarray, shape (p, FEATURES, LEADING + PATH), float32
    residuals : ndarray, shape (p, RESIDUAL_FEATURES)
        Log of the residual that answers leave in the full model, relative to them in the energy
        norm at rest, by ``reduced.press.residual_features``.
    extent : float, mm
        Largest distance of a contact point from the centre of a patch that answers for it.
    blend : float, mm
    tips : LocalTips, optional
        The same patches under the rigid tip.
    viscous, viscous_tips : ViscousModels, optional
        Of tissue that remembers; of the same patches under the tip.
    """

    basis: NDArray[np.int16]
    steps: Field
    region: NDArray[np.int32]
    centres: Array
    frames: Array
    pressures: Array
    whole: NDArray[np.int16]
    mix: Field
    point_from: NDArray[np.int64]
    points: NDArray[np.int32]
    weights: Array
    path: Field
    defect: Field
    guess: Field
    residuals: Array
    extent: float
    blend: float
    tips: LocalTips | None
    viscous: ViscousModels | None = None
    viscous_tips: ViscousModels | None = None

    @cached_property
    def modes(self) -> Field:
        """Wide modes (p, M, r) of each patch in the basis of its region."""
        return self.whole.astype(np.float32) @ self.mix


def assemble_patches(body: Body, models: LocalModels, scene: Scene) -> Patches:
    """Everything the compiled query needs for footprints of up to the scene's radius."""
    gradients, surface = body.gradients, body.boundary
    per_element = gradients.shape[1]
    bases = models.basis.reshape(*models.steps.shape, len(body.nodes), 3)
    count, r = len(models.centres), models.modes.shape[2]
    most = -(-int(np.diff(models.point_from).max()) // LANES) * LANES
    point_gradients = np.zeros((count, r, 9 * most), np.int16)
    steps = np.empty((count, r), np.float32)
    weights, mu, lam = (np.zeros((count, most)) for _ in range(3))
    modes: list[Field] = [np.empty(0, np.float32)] * count
    rows: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = [(np.empty(0, int),) * 2] * count
    for region, steps_of_region in enumerate(models.steps):
        # one row of memory to a node, so that gathering nodes reads rows
        basis = np.ascontiguousarray(np.moveaxis(bases[region], 0, -1)).astype(np.float32)
        for k in np.flatnonzero(models.region == region):
            own = slice(models.point_from[k], models.point_from[k + 1])
            element, q = np.divmod(models.points[own], per_element)
            nodes, local = np.unique(body.elements[element], return_inverse=True)
            C = steps_of_region[:, None] * models.modes[k]
            V = _rows(basis, nodes, C)[local.reshape(len(element), -1)]
            G = _tiles(_mode_gradients(V, gradients[element, q]), most)
            steps[k] = np.maximum(np.abs(G).max(axis=1), 1e-30) / np.iinfo(np.int16).max
            point_gradients[k] = np.rint(G / steps[k, :, None])
            weights[k, : len(element)] = models.weights[own]
            mu[k, : len(element)], lam[k, : len(element)] = body.mu[element], body.lam[element]
            reach = models.extent + scene.endoscope.radius
            near = np.flatnonzero(np.sum((surface.points - models.centres[k]) ** 2, 1) < reach**2)
            nodes, local = np.unique(surface.nodes[near], return_inverse=True)
            modes[k] = _rows(basis, nodes, C)
            rows[k] = near, local.reshape(len(near), -1)
    near = np.concatenate([r[0] for r in rows])
    return Patches(
        centres=np.ascontiguousarray(models.centres.T),
        frames=models.frames,
        pressures=np.ascontiguousarray(models.pressures),
        gradients=point_gradients,
        steps=steps,
        weights=weights,
        mu=mu,
        lam=lam,
        node_from=_offsets(modes),
        modes=np.vstack(modes).reshape(-1, 3 * r),
        face_from=_offsets([r[0] for r in rows]),
        face_points=surface.points[near],
        face_normals=surface.normals[near],
        face_areas=surface.areas[near],
        face_nodes=np.vstack([r[1] for r in rows]).astype(np.int32),
        face_shape=surface.shape[near],
        path=models.path,
        defect=models.defect,
        guess=np.pad(models.guess, ((0, 0), (0, 0), (0, NARROW - models.guess.shape[2]))),
        blend=models.blend,
        slack=math.sqrt(scene.tolerance.looseness),
    )


def assemble_tips(
    body: Body, models: LocalModels, tips: LocalTips, tangent: LocalTips | None = None
) -> TipModels:
    """Everything the compiled query of the tip needs.

    The cubature of ``tangent``, which has the same modes, serves the tangent if given.
    """
    surface, surface_nodes = body.touchable
    reach = models.extent + REACH * body.tip.radius
    bases = models.basis.reshape(*models.steps.shape, len(body.nodes), 3)
    count = len(models.centres)
    points = _no_points(count, tips)
    tangent_points = points if tangent is None else _no_points(count, tangent)
    modes: list[Field] = [np.empty(0, np.float32)] * count
    near: list[NDArray[np.int32]] = [np.empty(0, np.int32)] * count
    own: list[tuple[NDArray[np.int32], NDArray[np.int64]]] = [(near[0], np.empty(0, int))] * count
    for region, steps in enumerate(models.steps):
        # one row of memory to a node, so that gathering nodes reads rows
        basis = np.ascontiguousarray(np.moveaxis(bases[region], 0, -1)).astype(np.float32)
        for k in np.flatnonzero(models.region == region):
            C = steps[:, None] * tips.modes[k]
            _place_points(body, basis, C, tips, int(k), points)
            if tangent is not None:
                _place_points(body, basis, C, tangent, int(k), tangent_points)
            away = np.linalg.norm(surface.nodes[surface.faces] - models.centres[k], axis=2)
            near[k] = np.flatnonzero((away < reach).any(axis=1)).astype(np.int32)
            own[k] = np.unique(surface.faces[near[k]], return_inverse=True)
            modes[k] = _rows(basis, surface_nodes[own[k][0]], C)
    normals = models.frames[:, 0]
    return TipModels(
        centres=np.ascontiguousarray((models.centres + MIDDLE * body.tip.radius * normals).T),
        frames=models.frames,
        blend=models.blend,
        points=points,
        tangent_points=tangent_points,
        guess=tips.guess,
        tip=body.tip,
        surface=surface,
        node_from=_offsets([nodes for nodes, _ in own]),
        nodes=np.concatenate([nodes for nodes, _ in own]).astype(np.int32),
        modes=np.vstack(modes),
        face_from=_offsets(near),
        faces=np.concatenate(near),
        corners=np.vstack(
            [local.reshape(len(f), -1) for f, (_, local) in zip(near, own, strict=True)]
        ).astype(np.int32),
        **_neighbours(count, tips),
        residuals=tips.residuals,
    )


def _neighbours(count: int, tips: LocalTips) -> dict[str, NDArray[Any]]:
    """From pairs of models to the neighbours of each."""
    own, other = np.vstack([tips.pairs, tips.pairs[:, ::-1]]).T
    overlaps = np.concatenate([tips.overlaps, tips.overlaps.swapaxes(1, 2)])
    order = np.argsort(own, kind="stable")
    return {
        "neighbour_from": np.searchsorted(own[order], np.arange(count + 1)).astype(np.int64),
        "neighbours": other[order].astype(np.int32),
        "overlaps": np.ascontiguousarray(overlaps[order]),
    }


def _no_points(count: int, tips: LocalTips) -> Points:
    """Room for the points of so many models."""
    most = -(-int(np.diff(tips.point_from).max()) // LANES) * LANES
    return Points(
        np.zeros((count, tips.modes.shape[2], 9 * most), np.float32),
        *(np.zeros((count, most)) for _ in range(3)),
    )


def _place_points(
    body: Body, basis: Field, C: Field, tips: LocalTips, k: int, points: Points
) -> None:
    """Fill in the points of model k, of modes ``basis @ C``; basis (n, 3, M), C (M, m)."""
    rows = slice(tips.point_from[k], tips.point_from[k + 1])
    element, q = np.divmod(tips.points[rows], body.gradients.shape[1])
    nodes, local = np.unique(body.elements[element], return_inverse=True)
    V = _rows(basis, nodes, C)[local.reshape(len(element), -1)]
    G = _mode_gradients(V, body.gradients[element, q])
    points.gradients[k] = _tiles(G, points.weights.shape[1])
    points.weights[k, : len(element)] = tips.weights[rows]
    points.mu[k, : len(element)] = body.mu[element]
    points.lam[k, : len(element)] = body.lam[element]


def _rows(basis: Field, nodes: NDArray[np.int32], C: Field) -> Field:
    """Rows (k, 3, m) of modes ``basis @ C`` at some nodes; basis (n, 3, M), C (M, m)."""
    return (basis[nodes].reshape(-1, len(C)) @ C).reshape(len(nodes), 3, -1)


def _mode_gradients(V: Field, gradients: Array) -> Field:
    """Gradients (c, 9, m) of modes V (c, n, 3, m), at points with shape gradients (c, n, 3)."""
    c, _, _, m = V.shape
    # (c, 1, J, n) @ (c, i, n, m) -> (c, i, J, m)
    G = np.matmul(np.swapaxes(gradients, 1, 2)[:, None].astype(V.dtype), np.swapaxes(V, 1, 2))
    return G.reshape(c, 9, m)


def _tiles(G: Field, points: int) -> Field:
    """Gradients (c, 9, m) as rows (m, 9 points) in tiles, filled up with zeros."""
    filled = np.zeros((points, *G.shape[1:]), G.dtype)
    filled[: len(G)] = G
    return filled.reshape(-1, LANES, *G.shape[1:]).transpose(3, 0, 2, 1).reshape(G.shape[2], -1)


def _offsets(parts: list[Any]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


class State:
    """Working memory and last answer of one caller; not to be shared between threads.

    Parameters
    ----------
    patches : Patches
    clusters : int
        Of the surface that is queried.
    """

    def __init__(self, patches: Patches, clusters: int = 0) -> None:
        _, r, entries = patches.gradients.shape
        points = LANES * (entries // TILE)
        self.memory = Memory(
            patch=np.full(MAX_ACTIVE, -1, np.int64),
            wide=np.zeros((MAX_ACTIVE, r)),
            guess=np.zeros((MAX_ACTIVE, r)),
            secants=np.zeros((MAX_ACTIVE, r, r)),
            origin=np.zeros((MAX_ACTIVE, 2, r)),
        )
        self.scratch = Scratch(
            gradients=np.zeros((NARROW, entries), np.float32),
            increments=np.zeros((NARROW, entries), np.float32),
            H=np.zeros(entries, np.float32),
            P=np.zeros(entries, np.float32),
            J=np.zeros(points),
            trace=np.zeros(points),
            linear=np.zeros(points),
            state=np.zeros(STATE * points, np.float32),
            vectors=np.zeros((NARROW - LEADING, r)),
            stepped=np.zeros((NARROW - LEADING, r), np.float32),
            tangent=np.zeros((NARROW, NARROW)),
            factor=np.zeros((NARROW, NARROW)),
            newton=np.zeros((4, NARROW)),
            wide_newton=np.zeros((4, r)),
            q=np.zeros(NARROW),
            guess=np.zeros(NARROW, np.float32),
            load=np.zeros(NARROW),
            scaled_load=np.zeros(3),
            unit_loads=np.zeros(3 * r, np.float32),
            wide_load=np.zeros(r),
            residual=np.zeros(r),
            start=np.zeros(r),
            stepped_state=np.zeros(r, np.float32),
            latest=np.zeros(r),
            features=np.zeros(FEATURES),
            residual_features=np.zeros(RESIDUAL_FEATURES),
            nodal=np.zeros(int(np.diff(patches.node_from).max())),
            distance=np.zeros(patches.centres.shape[1]),
            surface=np.zeros(clusters + 3),
        )
        # one array, so that an answer is kept by one copy
        self.record = np.zeros(_SCALARS.start + SCALARS)
        self.outcome = Outcome(
            weight=self.record[_WEIGHT],
            point=self.record[_POINT],
            normal=self.record[_NORMAL],
            direction=self.record[_DIRECTION],
            force=self.record[_FORCE],
            displacement=self.record[_DISPLACEMENT],
            range=self.record[_RANGE],
            features=self.record[_FEATURES],
            scalars=self.record[_SCALARS],
        )
        self.bound = bind(Solver(patches, self.memory, self.scratch, self.outcome))
        self.tip: TipState | None = None
        """Of ``ReducedModel.touch``, made when first needed."""

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        self.memory.patch[:] = -1
        if self.tip is not None:
            self.tip.forget()

    def go_on(self) -> None:
        """Start under the tip where the last search ended, which found no equilibrium."""
        if self.tip is not None:
            self.tip.go_on()


class Solution(NamedTuple):
    """Answer to one query.

    Attributes
    ----------
    contact_point : ndarray, shape (3,), mm
        Queried position moved to the surface.
    normal : ndarray, shape (3,)
        Outward unit normal there.
    distance : float, mm
        How far the position was moved.
    direction : ndarray, shape (3,)
        Unit direction of the load.
    tilt : float, degrees
        Of the direction from the inward normal.
    departure : float
        Of the answer from the linear response, relative to that, in the energy norm.
    residual : float
        That such answers leave in the full model, relative to them in the energy norm at rest, as
        the patches learnt it.
    pressure, radius : float
        kPa at the footprint's centre, mm.
    pressure_limit : float, kPa
        Largest trained pressure at this point in this direction.
    force : ndarray, shape (3,), mN
        Resultant of the load.
    contact_displacement : ndarray, shape (3,), mm
        Mean over the footprint, weighted with its pressure.
    converged : bool
    iterations : int
    in_range : bool
        Whether the load is of the kind the model was trained and validated for.
    out_of_range : tuple of str
        The fields that are not.
    error_displacement, error_von_mises : float
        Estimated relative L2 errors against the full model, calibrated to cover 95 % of cases.
    min_jacobian : float
        Smallest det F among the cubature points.
    features : ndarray, shape (ERROR_FEATURES,)
        What the error estimate is made of.
    patches : tuple of (int, float, ndarray)
        Active patches: number, weight, answer (r,) in the wide space.
    solve_seconds : float
    """

    contact_point: Array
    normal: Array
    distance: float
    direction: Array
    tilt: float
    departure: float
    residual: float
    pressure: float
    radius: float
    pressure_limit: float
    force: Array
    contact_displacement: Array
    converged: bool
    iterations: int
    in_range: bool
    out_of_range: tuple[str, ...]
    error_displacement: float
    error_von_mises: float
    min_jacobian: float
    features: Array
    patches: tuple[tuple[int, float, Array], ...]
    solve_seconds: float


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

    loads: Estimator = Estimator(np.zeros((2, ERROR_FEATURES)))
    touches: Estimator = Estimator(np.zeros((3, TIP_ERROR_FEATURES)))
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


class ReducedModel:
    """A trained scene that answers queries.

    Parameters
    ----------
    name : str
    scene : Scene
    info : dict
        JSON-able documents of the artifact.
    body : Body
    surface : Surface
        Accessible surface.
    limits : ndarray, shape (v, LIMIT_FIELDS)
        Load range at the surface's vertices; see ``mechanics.footprint.pressure_limit``.
    models : LocalModels
    estimators : Estimators
    """

    def __init__(
        self,
        name: str,
        scene: Scene,
        info: dict[str, Any],
        body: Body,
        surface: Surface,
        limits: Array,
        models: LocalModels,
        estimators: Estimators,
    ) -> None:
        self.name = name
        self.scene = scene
        self.info = info
        self.body = body
        self.surface = surface
        self.limits = limits
        self.models = models
        self.estimators = estimators
        self.patches = assemble_patches(body, models, scene)
        terms = Terms(
            ground=surface.ground(limits),
            reach=scene.endoscope.reach,
            max_tilt=scene.endoscope.max_tilt,
            residuals=models.residuals,
            coefficients=estimators.loads.coefficients,
        )
        self._terms = bind(terms)
        self.surface_nodes, self.surface_triangles = boundary_triangles(body.faces)
        self._recovery = stress_recovery(
            body.nodes, body.elements, body.mu, body.lam, precision=np.float32
        )
        self._stress = np.zeros(len(body.nodes))
        self._state = self.new_state()
        self._last_step: tuple[float, Weights] | None = None

    @classmethod
    def load(cls, path: str | Path) -> ReducedModel:
        """Load an artifact.

        Raises
        ------
        ArtifactError
        """
        path = Path(path)
        artifact = read_artifact(path)
        try:
            return cls.from_artifact(artifact)
        except (KeyError, SceneError, ValueError, IndexError) as error:
            raise ArtifactError(f"{path}: incomplete or inconsistent: {error}") from error

    @classmethod
    def from_artifact(cls, artifact: Artifact) -> ReducedModel:
        """Build from the contents of an artifact."""
        arrays = artifact.arrays
        scene = parse_scene(artifact.scene)
        mu, lam = lame(scene.tissue.young, scene.tissue.poisson)
        count = len(arrays["elements"])
        return cls(
            name=scene.name,
            scene=scene,
            info=artifact.documents,
            body=Body(
                arrays["nodes"],
                arrays["elements"],
                arrays["faces"],
                arrays["clamped"],
                arrays["accessible"],
                np.full(count, mu),
                np.full(count, lam),
                tip_of(scene.endoscope.radius, scene.tissue.young),
            ),
            surface=Surface(
                arrays["surface_vertices"], arrays["surface_triangles"], arrays["surface_normals"]
            ),
            limits=arrays["load_range"],
            models=LocalModels(
                basis=arrays["basis"],
                steps=arrays["basis_steps"],
                region=arrays["patch_region"],
                centres=arrays["patch_centres"],
                frames=arrays["patch_frames"],
                pressures=arrays["patch_pressures"],
                whole=arrays["patch_modes"],
                mix=arrays["patch_mix"],
                point_from=arrays["cubature_from"],
                points=arrays["cubature_points"],
                weights=arrays["cubature_weights"],
                path=arrays["patch_path"].astype(np.float32),
                defect=arrays["patch_defect"].astype(np.float32),
                guess=arrays["patch_guess"].astype(np.float32),
                residuals=arrays["patch_residuals"],
                extent=float(arrays["patch_extent"]),
                blend=float(arrays["patch_blend"]),
                tips=_local_tips(arrays) if scene.endoscope.tip else None,
                viscous=_viscous_models(arrays, "viscous") if scene.tissue.prony else None,
                viscous_tips=_viscous_models(arrays, "tip_viscous")
                if scene.tissue.prony and scene.endoscope.tip
                else None,
            ),
            estimators=Estimators.of(arrays),
        )

    @property
    def nodes(self) -> Array:
        """Nodes (n, 3) mm."""
        return self.body.nodes

    @property
    def clamped(self) -> NDArray[np.bool_]:
        """Nodes held fixed (n,)."""
        return self.body.clamped

    @cached_property
    def pressure_max(self) -> float:
        """Largest trained pressure anywhere on the surface, kPa."""
        return float(self.limits[:, 0].max())

    def new_state(self) -> State:
        """Working memory and warm start for one session or thread."""
        return State(self.patches, self.surface.clusters)

    def solve(
        self,
        position: ArrayLike,
        pressure: float,
        direction: ArrayLike | None = None,
        radius: float | None = None,
        state: State | None = None,
    ) -> Solution:
        """Answer one pressed footprint.

        Parameters
        ----------
        position : array_like, shape (3,), mm
            Contact point; projected onto the accessible surface if within the scene's reach of it.
        pressure : float, kPa
            At the footprint's centre.
        direction : array_like, shape (3,), optional
            Of the load; the inward normal if absent.
        radius : float, optional
            Of the footprint, mm; the scene's if absent.
        state : State, optional
            Where the last answer is remembered to start from; without it every answer is cold.

        Raises
        ------
        QueryError
            If a field is not finite, out of reach or makes no sense; see its message.
        """
        started = time.perf_counter()
        at, towards, radius = self._checked(position, pressure, direction, radius)
        if state is None:
            state = self._state
            state.forget()
        query(self._terms, state.bound, at, towards, pressure, radius)
        record = state.record.copy()
        scalars = record[_SCALARS].tolist()
        distance, tilt, limit = scalars[DISTANCE], scalars[TILT], scalars[LIMIT]
        self._check_place(distance, tilt)
        out_of_range = self._out_of_range(at, record, scalars, pressure, radius)
        memory, numbers = state.memory.wide, state.memory.patch.tolist()
        patches = tuple(
            [
                (_number(numbers[slot]), weight, memory[slot].copy())
                for slot, weight in enumerate(record[_WEIGHT].tolist())
                if weight > 0
            ]
        )
        return Solution(
            contact_point=record[_POINT],
            normal=record[_NORMAL],
            distance=distance,
            direction=record[_DIRECTION],
            tilt=tilt,
            departure=scalars[DEPARTURE],
            residual=scalars[RESIDUAL],
            pressure=pressure,
            radius=radius,
            pressure_limit=limit,
            force=record[_FORCE],
            contact_displacement=record[_DISPLACEMENT],
            converged=scalars[STATUS] == newton.CONVERGED,
            iterations=int(scalars[ITERATIONS]),
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=scalars[ERROR_DISPLACEMENT],
            error_von_mises=scalars[ERROR_VON_MISES],
            min_jacobian=scalars[SMALLEST_J],
            features=record[_FEATURES],
            patches=patches,
            solve_seconds=time.perf_counter() - started,
        )

    def _checked(
        self,
        position: ArrayLike,
        pressure: float,
        direction: ArrayLike | None,
        radius: float | None,
    ) -> tuple[Array, Array, float]:
        """Position, direction (zero for the inward normal) and radius of a well-formed load."""
        endoscope = self.scene.endoscope
        if not (math.isfinite(pressure) and pressure >= 0):
            raise QueryError("pressure", f"must be a finite number >= 0 kPa, not {pressure}")
        at = _vector("position", position)
        if radius is None:
            radius = endoscope.radius
        elif not endoscope.radius / 2 <= radius <= endoscope.radius:
            allowed = f"[{endoscope.radius / 2}, {endoscope.radius}] mm"
            raise QueryError("radius", f"must be in {allowed}, not {radius}")
        if direction is None:
            return at, _INWARD, radius
        towards = _vector("direction", direction)
        if not any(towards.tolist()):
            raise QueryError("direction", "must not be the zero vector")
        return at, towards, radius

    def _check_place(self, distance: float, tilt: float) -> None:
        """Raise ``QueryError`` if a load is out of reach or does not press."""
        reach = self.scene.endoscope.reach
        if distance > reach:
            raise QueryError(
                "position",
                f"{distance:.2f} mm from the accessible surface, at most {reach} mm allowed",
            )
        if not tilt < 90.0:
            raise QueryError("direction", "must point into the tissue")

    def _out_of_range(
        self, at: Array, record: Array, scalars: list[float], pressure: float, radius: float
    ) -> tuple[str, ...]:
        """Fields of a load that are not of the kind the model was trained for."""
        endoscope, distance = self.scene.endoscope, scalars[DISTANCE]
        fields: tuple[str, ...] = ()
        if distance > BESIDE and _beside(at, record[_POINT], record[_NORMAL], distance):
            fields += ("position",)
        if pressure > scalars[LIMIT] * (1 + 1e-9):
            fields += ("pressure",)
        if scalars[TILT] > endoscope.max_tilt + 1e-6:
            fields += ("direction",)
        if radius != endoscope.radius:
            fields += ("radius",)
        return fields

    def step(
        self,
        history: History,
        dt: float,
        position: ArrayLike | None = None,
        pressure: float = 0.0,
        direction: ArrayLike | None = None,
        radius: float | None = None,
    ) -> tuple[Moment, History]:
        """Press ``dt`` after the end of a history of visco-elastic tissue.

        Parameters
        ----------
        history : History
            ``History()`` is rest. It is not changed.
        dt : float, s
            May be 0, for a sudden change.
        position : array_like, shape (3,), mm, optional
            As in ``solve``; without it nothing presses.
        pressure, direction, radius
            As in ``solve``.

        Returns
        -------
        moment : Moment
        history : History
            To go on from; the old one if the answer did not converge.

        Raises
        ------
        QueryError
            As ``solve``, or if the tissue is elastic, or ``dt`` negative or not finite.
        """
        started = time.perf_counter()
        self._check_time(dt)
        if position is None:
            last = history.position
            position, pressure = self.surface.vertices[0] if last is None else last, 0.0
        at, towards, radius = self._checked(position, pressure, direction, radius)
        state = self._state
        place(self._terms, state.bound, at, towards)
        record = state.record.copy()
        scalars = record[_SCALARS].tolist()
        self._check_place(scalars[DISTANCE], scalars[TILT])
        numbers, shares = state.memory.patch.tolist(), record[_WEIGHT].tolist()
        active = [(-2 - k, share) for k, share in zip(numbers, shares, strict=True) if share > 0.0]
        found = self._stepper.press(history, active, pressure, radius, self._step_weights(dt))
        main = max(active, key=lambda pair: pair[1])[0]
        point, moved = record[_POINT], math.hypot(*found.displacement.tolist())
        before = point if history.position is None else history.position
        travelled = math.dist(point.tolist(), before.tolist())
        after = History(
            time=history.time + dt,
            locals=found.locals,
            main=main,
            position=point,
            share=max(history.share, pressure / scalars[LIMIT]),
            response=max(history.response, moved),
            travel=history.travel + travelled,
            smallest=min(history.smallest, found.min_jacobian),
        )
        features, estimates = judge(
            self.estimators.histories.coefficients, record[_NORMAL], after.share, after.response,
            after.travel, after.smallest,
        )  # fmt: skip
        errors = estimates.tolist()
        out_of_range = self._out_of_range(at, record, scalars, pressure, radius)
        moment = Moment(
            time=after.time,
            contact_point=point,
            normal=record[_NORMAL],
            distance=scalars[DISTANCE],
            direction=record[_DIRECTION],
            tilt=scalars[TILT],
            pressure=pressure,
            radius=radius,
            pressure_limit=scalars[LIMIT],
            force=pressure * found.area * record[_DIRECTION],
            contact_displacement=found.displacement,
            converged=found.converged,
            iterations=found.iterations,
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=errors[0],
            error_von_mises=errors[1],
            min_jacobian=found.min_jacobian,
            features=features,
            active=tuple((k, share, found.locals[k]) for k, share in active),
            solve_seconds=time.perf_counter() - started,
        )
        return moment, after if moment.converged else history

    def _check_time(self, dt: float) -> None:
        """Raise ``QueryError`` if tissue knows no time, or none like this."""
        if self.models.viscous is None:
            raise QueryError("time", f"scene {self.name!r} is elastic and knows none")
        if not 0.0 <= dt < math.inf:
            raise QueryError("time", f"steps must be >= 0 s and finite, not {dt}")

    def _step_weights(self, dt: float) -> Weights:
        """Weights of a time step, which is often the last one's."""
        if self._last_step is None or self._last_step[0] != dt:
            self._last_step = dt, step_weights(self.scene.tissue.prony, dt)
        return self._last_step[1]

    @cached_property
    def _stepper(self) -> TimeStepper:
        assert self.models.viscous is not None, "or there would be no history"
        points = self.patches.weights.shape[1]
        return TimeStepper(self._state.bound, self.models.viscous, self.scene.tissue.prony, points)

    @cached_property
    def tips(self) -> TipModels | None:
        """Local models of the rigid tip, if the artifact has any."""
        tips = self.models.tips
        return None if tips is None else assemble_tips(self.body, self.models, tips)

    def touch(
        self, position: ArrayLike, state: State | None = None, most: int = touch.MAX_ITERATIONS
    ) -> Touch:
        """Answer a position of the rigid tip.

        Parameters
        ----------
        position : array_like, shape (3,), mm
            Centre of the tip, outside the body.
        state : State, optional
            Where the last answer is remembered to start from; without it every answer is cold.
        most : int
            Iterations in one local model. With fewer than the default, a position that is hard to
            get to is given up early: for callers that come nearer step by step.

        Raises
        ------
        QueryError
            If the position is not finite, or the tip's centre lies below the surface.
        """
        started = time.perf_counter()
        at = _vector("position", position)
        if state is None:
            state = self._state
            state.forget()
        return touch.answer(self._tip_state(state), at, started, most)

    def touch_step(
        self,
        history: History,
        dt: float,
        position: ArrayLike,
        most: int = MAX_ITERATIONS,
        begun: Touch | None = None,
    ) -> tuple[Touch, History]:
        """Answer a position of the rigid tip on visco-elastic tissue.

        Parameters
        ----------
        history : History
            ``History()`` is rest. It is not changed.
        dt : float, s
            Since the end of the history; may be 0, for a sudden change. The tip moved evenly.
        position : array_like, shape (3,), mm
            Centre of the tip, outside the body.
        most : int
            As in ``touch``.
        begun : Touch, optional
            Without an answer, from the same history: the search goes on where that ended.

        Returns
        -------
        touch : Touch
            Its estimated errors are the largest until now of displacement, stress and force,
            relative to the largest of these until now.
        history : History
            To go on from; the old one if the answer did not converge.

        Raises
        ------
        QueryError
            As ``touch``, or if the tissue is elastic, or ``dt`` negative or not finite.
        """
        started = time.perf_counter()
        self._check_time(dt)
        at = _vector("position", position)
        return tip_history.step(
            self._tip_state(self._state), self._tip_stepper, history, dt, self._step_weights(dt),
            at, self.estimators.courses.coefficients, started, most, begun,
        )  # fmt: skip

    def _tip_state(self, state: State) -> TipState:
        """Working memory under the tip, made when first needed."""
        if state.tip is None:
            if self.tips is None:
                raise QueryError("position", f"scene {self.name!r} was trained without a tip")
            state.tip = TipState(self.tips, self._tip_ground, self.estimators.touches.coefficients)
        return state.tip

    @cached_property
    def _tip_stepper(self) -> TipTimeStepper:
        assert self.models.viscous_tips is not None, "or there would be no history"
        assert self.tips is not None
        return TipTimeStepper(
            self._tip_state(self._state).bound,
            self.models.viscous_tips,
            self.scene.tissue.prony,
            self.tips.points.weights.shape[1],
        )

    @cached_property
    def _tip_ground(self) -> SurfaceIndex:
        return self.surface.ground(self.limits[:, [TIP_DEPTH]])

    def coefficients(self, solution: Solution | Touch | Moment) -> dict[int, Field]:
        """Displacement as coefficients (M,) in the basis of each region that takes part."""
        modes, past = self._modes(solution), self._past(solution)
        if past is not None:
            carrier, moment = past
            return self._by_region(modes, carrier.answers(moment))
        assert not isinstance(solution, Moment)
        return self._by_region(modes, solution.patches)

    def _modes(self, solution: Solution | Touch | Moment) -> Field:
        """Modes (p, M, r) that an answer is given in."""
        if isinstance(solution, Touch):
            assert self.models.tips is not None, "or there would be no such answer"
            return self.models.tips.modes
        return self.models.modes

    def _past(
        self, solution: Solution | Touch | Moment
    ) -> tuple[HistoryTransfer, Remembered] | None:
        """What carries the past of an answer, if it has one."""
        if isinstance(solution, Moment):
            return self._stepper, solution
        if isinstance(solution, Touch) and solution.active:
            return self._tip_stepper, solution
        return None

    def _by_region(
        self, modes: Field, answers: Sequence[tuple[int, float, Array]]
    ) -> dict[int, Field]:
        total: dict[int, Field] = {}
        for k, weight, c in answers:
            region = int(self.models.region[k])
            share = modes[k] @ (weight * c).astype(np.float32)
            total[region] = total[region] + share if region in total else share
        return total

    def _field(self, coefficients: Mapping[int, Field]) -> Field:
        field = np.zeros(self.models.basis.shape[2], np.float32)
        for number, part in coefficients.items():
            expand(self.models.basis[number], self.models.steps[number] * part, field)
        return field.reshape(-1, 3)

    def displacement(self, solution: Solution | Touch | Moment, region: Region = "all") -> Field:
        """Nodal displacement (k, 3) mm, of all nodes or those of ``surface_nodes``."""
        displacement = self._field(self.coefficients(solution))
        return displacement if region == "all" else displacement[self.surface_nodes]

    def von_mises(
        self,
        solution: Solution | Touch | Moment,
        region: Region = "all",
        displacement: Field | None = None,
    ) -> Field:
        """Nodal von Mises stress (k,) kPa; ``displacement`` of all nodes saves its recovery."""
        if displacement is None:
            displacement = self.displacement(solution, "all")
        past = self._past(solution)
        if past is not None:
            B = self._remembered(self._modes(solution), *past)
            nodal_von_mises_after(self._recovery, displacement, B, self._stress)
        else:
            nodal_von_mises(self._recovery, displacement, self._stress)
        stress = self._stress if region == "all" else self._stress[self.surface_nodes]
        # an answer that did not converge may be beyond single precision
        with np.errstate(over="ignore"):
            return stress.astype(np.float32)

    def _remembered(self, modes: Field, carrier: HistoryTransfer, moment: Remembered) -> Array:
        """``B`` of ``mechanics.viscosity`` (e, 6, 8) at the points of all elements."""
        B = np.zeros((len(self.body.elements), 6, 8))
        for k, share, knot in carrier.knots(moment):
            u = self._field(self._by_region(modes, [(k, 1.0, knot)]))
            remember(self._recovery, u, share, B)
        lasting = carrier.lasting(moment)
        if lasting:
            remember_linearly(self._recovery, self._field(self._by_region(modes, lasting)), B)
        return B


def _local_tips(arrays: dict[str, NDArray[Any]]) -> LocalTips:
    return LocalTips(
        modes=arrays["tip_modes"],
        point_from=arrays["tip_from"],
        points=arrays["tip_points"],
        weights=arrays["tip_weights"],
        guess=arrays["tip_guess"].astype(np.float32),
        pairs=arrays["tip_pairs"],
        overlaps=arrays["tip_overlaps"].astype(np.float32),
        residuals=arrays["tip_residuals"],
    )


def _viscous_models(arrays: dict[str, NDArray[Any]], name: str) -> ViscousModels:
    return ViscousModels(
        arrays[f"{name}_deviatoric"],
        arrays["viscous_pairs"],
        arrays[f"{name}_overlap"].astype(np.float32),
    )


def _beside(position: Array, contact: Array, normal: Array, distance: float) -> bool:
    """Whether a position lies rather beside the surface, beyond its rim, than above or below it."""
    return abs(float(np.dot(position - contact, normal))) < UPRIGHT * distance


def _number(slot: int) -> int:
    """Patch in a memory slot, whether its answer converged or not (``reduced.press.answer``)."""
    return slot if slot >= 0 else -2 - slot


def _vector(field: str, value: ArrayLike) -> Array:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise QueryError(field, "must be three numbers") from error
    if vector.shape != (3,) or not all(map(math.isfinite, vector.tolist())):
        raise QueryError(field, "must be three finite numbers")
    return vector
