"""Every method by name: ``build("pod", 40, training)``.

A training context holds what methods learn from, and makes what several of them share only once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from palpate.offline.fem.model import FullModel
from palpate.offline.methods.cubatures import PointForces, point_forces
from palpate.offline.methods.deim import Deim, force_modes, sample
from palpate.offline.methods.full import Full
from palpate.offline.methods.galerkin import Cubature, Galerkin, GalerkinAtHand, GalerkinModel
from palpate.offline.methods.method import Case, Method
from palpate.offline.methods.regression import Linear, Regression, compliance
from palpate.offline.methods.shipped import Shipped
from palpate.offline.methods.spaces import Inner, krylov, mass, modal, pod, static_derivatives
from palpate.offline.reduce.ritz import TANGENTIAL
from palpate.offline.reduce.sampling import spread_points, tangents
from palpate.offline.run.workshop import Load, Workshop
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

FOOTPRINTS = 128
"""Footprints over the surface; the first of them are spread as well."""

MOMENTS = 3
"""Blocks of a Krylov basis: a third of the loads that one of static responses (ritz) takes."""

POINTS_PER_MODE, ELEMENTS_PER_MODE = 6, 2
"""What an empirical cubature may cost."""

SAMPLES_PER_MODE = 3
"""Sampled dofs per force mode where the internal force is fitted instead of interpolated."""

CASES = 100
"""Snapshots whose loads teach a cubature, or an interpolation of the force."""


@dataclass(frozen=True)
class Snapshots:
    """Full solutions: loads, and displacements (k, 3 n) mm."""

    loads: Sequence[Load]
    displacements: Array


@dataclass(frozen=True)
class Training:
    """What methods learn from.

    Attributes
    ----------
    workshop : Workshop
    snapshots : Snapshots
    atlas : ReducedModel, optional
        The artifact of the same mesh, for the method that is it.
    seed : int
    """

    workshop: Workshop
    snapshots: Snapshots
    atlas: ReducedModel | None = None
    seed: int = 0

    @property
    def model(self) -> FullModel:
        """The full model, to train with."""
        return self.workshop.model

    def own_model(self) -> FullModel:
        """A full model that nobody else solves with, so that it keeps its factorisation."""
        return FullModel.of(self.workshop.scene, self.workshop.mesh)

    def rng(self, *stage: int) -> np.random.Generator:
        """Random numbers of a stage, the same whatever was built before."""
        return np.random.default_rng([self.seed, *stage])

    @cached_property
    def mass(self) -> csr_matrix:
        """Mass of the free dofs; see ``offline.methods.spaces.mass``."""
        return mass(self.model)

    @cached_property
    def cases(self) -> list[Case]:
        """Cases of the first snapshots."""
        return [Case.of(self.workshop, load) for load in self.snapshots.loads[:CASES]]

    @cached_property
    def _footprints(self) -> Array:
        return spread_points(self.workshop.surface, FOOTPRINTS, self.rng())

    def loads(self, footprints: int) -> Array:
        """Unit pressures (free dofs, 3 footprints) along each axis, spread over the surface."""
        points = self._footprints[:footprints]
        unit = [np.kron(self.workshop.unit_load(x)[0][:, None], np.eye(3)) for x in points]
        return np.hstack(unit)[self.model.free]

    def pod(self, size: int, inner: Inner = "energy") -> Array:
        """Basis (free dofs, <= size) of the snapshots."""
        return pod(self.model, self.snapshots.displacements, size, inner)

    @cached_property
    def compliance(self) -> Array:
        """All modes of the linear responses to what can load the surface."""
        nodes = np.unique(self.workshop.body.boundary.nodes[_within_reach(self.workshop)])
        return compliance(self.model, nodes)

    def point_forces(self, basis: Array) -> PointForces:
        """What a cubature of a basis is fitted to."""
        reduced = GalerkinModel(self.model, basis.shape[1], Cubature.full(self.model))
        reduced.adopt(basis)
        per_element = self.model.weights.shape[1]
        return point_forces(reduced, per_element, self.cases, self.rng(basis.shape[1]))


Builder = Callable[[int, Training], Method]
"""Makes a method of a size, its unknowns, where there is a choice; fewer if there are no more."""


def build(name: str, size: int, training: Training) -> Method:
    """Make the method of this name (``BUILDERS``) and size, its number of unknowns.

    The full model and the artifact come in one size only, and take no notice of it.
    """
    return BUILDERS[name](size, training)


# --- one basis for the whole surface -------------------------------------------------------------


def _galerkin(family: str, training: Training, basis: Array, cubature: Cubature) -> Galerkin:
    label = f"{basis.shape[1]} modes, {len(cubature.points)} points"
    return Galerkin(family, label, training.model, basis, cubature)


def _full(family: str, training: Training, basis: Array) -> Galerkin:
    return _galerkin(family, training, basis, Cubature.full(training.model))


def _modal(size: int, training: Training) -> Method:
    return _full("modal", training, modal(training.model, size))


def _ritz(size: int, training: Training) -> Method:
    loads = training.loads(-(-size // 3))
    return _full("ritz", training, krylov(training.model, training.mass, loads, size))


def _krylov(size: int, training: Training) -> Method:
    loads = training.loads(-(-size // (3 * MOMENTS)))
    return _full("krylov", training, krylov(training.model, training.mass, loads, size))


def _pod(size: int, training: Training) -> Method:
    return _full("pod", training, training.pod(size))


def _pod_euclidean(size: int, training: Training) -> Method:
    return _full("pod-euclidean", training, training.pod(size, "euclidean"))


def _pod_ecm(size: int, training: Training) -> Method:
    basis = training.pod(size)
    forces = training.point_forces(basis)
    cubature = forces.by_point(POINTS_PER_MODE * basis.shape[1], training.rng(size))
    return _galerkin("pod-ecm", training, basis, cubature)


def _pod_ecsw(size: int, training: Training) -> Method:
    basis = training.pod(size)
    forces = training.point_forces(basis)
    cubature = forces.by_element(ELEMENTS_PER_MODE * basis.shape[1], training.rng(size))
    return _galerkin("pod-ecsw", training, basis, cubature)


def _deim(size: int, training: Training) -> Method:
    return _interpolated("pod-deim", size, training, 1)


def _gappy(size: int, training: Training) -> Method:
    return _interpolated("pod-gappy", size, training, SAMPLES_PER_MODE)


def _interpolated(family: str, size: int, training: Training, per_mode: int) -> Method:
    model, basis = training.model, training.pod(size)
    known = training.snapshots.displacements[:, model.free].astype(float)
    modes = force_modes(model, known, basis.shape[1])
    samples = sample(modes, per_mode)
    label = f"{basis.shape[1]} modes, {len(samples.dofs)} sampled dofs"
    return Deim(family, label, model, basis, modes, samples)


# --- a basis for the load at hand ----------------------------------------------------------------


def _ritz_at_hand(size: int, training: Training) -> Method:
    model, M = training.own_model(), training.mass
    load = np.zeros((len(training.workshop.mesh.nodes), 3))

    def space(case: Case) -> Array:
        load[:] = 0.0
        load[case.nodes] = case.forces
        return krylov(model, M, load.reshape(-1, 1)[model.free], size)

    label = f"{size} vectors of the load at hand"
    return GalerkinAtHand("ritz-at-hand", label, model, size, space)


def _derivatives(size: int, training: Training) -> Method:
    model, workshop = training.own_model(), training.workshop

    def space(case: Case) -> Array:
        return static_derivatives(model, loads_about(workshop, case)[model.free], size)

    label = f"{size} vectors of the load at hand"
    return GalerkinAtHand("derivatives", label, model, size, space)


def loads_about(workshop: Workshop, case: Case) -> Array:
    """The load of a case and two across it, (3 n, 3) mN.

    Those across turn every contact's force to the side, as far as it is tilted in use.
    """
    total = np.zeros((len(workshop.mesh.nodes), 3, 3))
    for contact, share in zip(case.contacts, case.shares, strict=True):
        frame = np.array([contact.direction, *tangents(contact.direction)])
        frame[1:] *= TANGENTIAL
        total[case.nodes] += share[:, None, None] * frame.T
    return total.reshape(-1, 3)


# --- no reduced equilibrium ----------------------------------------------------------------------


def _linear(size: int, training: Training) -> Method:
    return Linear(training.model, training.compliance[:, :size])


def _within_reach(workshop: Workshop) -> NDArray[np.int64]:
    """Integration points of the boundary that some footprint can cover."""
    vertices = cKDTree(workshop.surface.vertices)
    # no point of a triangle is farther from a vertex than its longest edge
    corners = workshop.surface.vertices[workshop.surface.triangles]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    distance, _ = vertices.query(workshop.body.boundary.points)
    return np.flatnonzero(distance <= workshop.scene.endoscope.radius + edge)


def _rbf(size: int, training: Training) -> Method:
    known = training.snapshots
    basis = training.pod(size)
    return Regression(training.model, basis, known.loads, known.displacements)


def _whole(size: int, training: Training) -> Method:
    return Full(training.own_model())


def _shipped(size: int, training: Training) -> Method:
    if training.atlas is None:
        raise PalpateError("artifact: the training context has none")
    return Shipped(training.atlas)


BUILDERS: dict[str, Builder] = {
    "modal": _modal,
    "ritz": _ritz,
    "krylov": _krylov,
    "pod": _pod,
    "pod-euclidean": _pod_euclidean,
    "pod-ecm": _pod_ecm,
    "pod-ecsw": _pod_ecsw,
    "pod-deim": _deim,
    "pod-gappy": _gappy,
    "ritz-at-hand": _ritz_at_hand,
    "derivatives": _derivatives,
    "linear": _linear,
    "regression": _rbf,
    "full": _whole,
    "artifact": _shipped,
}
