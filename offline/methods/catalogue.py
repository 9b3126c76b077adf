"""Every method by name: ``build("pod", 40, training)``.

A new method is a file in this folder and a line in ``BUILDERS``.  ``Training`` holds what methods
learn from, and computes what several of them share only once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods import hyper_reduction as hyper
from palpate.offline.methods.full import Full, Remeshed
from palpate.offline.methods.galerkin import Galerkin, GalerkinAtHand
from palpate.offline.methods.method import Case, Method, Snapshots
from palpate.offline.methods.regression import Linear, Regression, compliance
from palpate.offline.methods.shipped import Shipped, Way
from palpate.offline.methods.spaces import Inner, krylov, mass, modal, pod, static_derivatives
from palpate.offline.methods.tetrahedra import MassSpring, TensorMass
from palpate.offline.reduce.ritz import TANGENTIAL
from palpate.offline.reduce.sampling import spread_points, tangents
from palpate.shared.arrays import Array
from palpate.shared.model import ReducedModel

FOOTPRINTS = 128
"""Footprints whose loads make bases: spread over the surface, and so are the first few of them."""

MOMENTS = 3  # blocks of a Krylov basis, which therefore takes a third of the loads of a ritz basis
POINTS_PER_MODE, ELEMENTS_PER_MODE = 6, 2  # most points, or elements, of an empirical cubature
SAMPLES_PER_MODE = 3
"""Sampled dofs per force mode where the internal force is fitted instead of interpolated."""

CASES = 100  # snapshots whose loads train a cubature


@dataclass(frozen=True)
class Training:
    """What methods learn from."""

    problem: FullProblem  # with the scene's files, if there are to be methods on other meshes
    snapshots: Snapshots
    atlas: ReducedModel  # of the same mesh, for the methods that query it
    seed: int = 0
    in_time: bool = False  # whether the methods that can remember what happened before

    @property
    def model(self) -> FullModel:
        """The full model."""
        return self.problem.model

    def rng(self, *stage: int) -> np.random.Generator:
        """Random numbers of a stage, the same whatever was built before."""
        return np.random.default_rng([self.seed, *stage])

    @cached_property
    def mass(self) -> csr_matrix:
        """See ``offline.methods.spaces``."""
        return mass(self.model)

    @cached_property
    def _footprints(self) -> Array:
        return spread_points(self.problem.surface, FOOTPRINTS, self.rng())

    def loads(self, footprints: int) -> Array:
        """Unit pressures (free dofs, 3 footprints) along each axis, spread over the surface."""
        points = self._footprints[:footprints]
        unit = [np.kron(self.problem.unit_load(x)[0][:, None], np.eye(3)) for x in points]
        return np.hstack(unit)[self.model.free]

    def pod(self, size: int, inner: Inner = "energy") -> Array:
        """Basis (free dofs, <= size) of the snapshots."""
        return pod(self.model, self.snapshots.displacements, size, inner)

    @cached_property
    def compliance(self) -> Array:
        """All modes of the linear responses to what can load the surface."""
        return compliance(self.problem)


# --- one basis for the whole surface -------------------------------------------------------------


def _every_point(training: Training, basis: Array) -> Method:
    return Galerkin(training.problem, basis, in_time=training.in_time)


def _krylov(size: int, training: Training, moments: int = MOMENTS) -> Method:
    loads = training.loads(-(-size // (3 * moments)))
    return _every_point(training, krylov(training.model, training.mass, loads, size))


def _cubature(
    size: int, training: Training, most: int = POINTS_PER_MODE, by_element: bool = False
) -> Method:
    problem, basis, rng = training.problem, training.pod(size), training.rng(size)
    cases = (Case.of(problem, load) for load in training.snapshots.loads[:CASES])
    forces = hyper.contributions(Galerkin(problem, basis), cases, rng)
    cubature = hyper.fit_cubature(problem.model, forces, most * basis.shape[1], rng, by_element)
    return Galerkin(problem, basis, cubature)


def _deim(size: int, training: Training, per_mode: int = 1) -> Method:
    model, basis = training.model, training.pod(size)
    snapshots = training.snapshots.displacements[:, model.free].astype(float)
    modes = hyper.force_modes(model, snapshots, basis.shape[1])
    return hyper.Deim(training.problem, basis, modes, hyper.sample(modes, per_mode))


# --- a basis for the load at hand ----------------------------------------------------------------


def _ritz_at_hand(size: int, training: Training) -> Method:
    model, M, nodes = training.model, training.mass, len(training.problem.mesh.nodes)

    def space(case: Case) -> Array:
        return krylov(model, M, case.load(nodes).reshape(-1, 1)[model.free], size)

    return GalerkinAtHand(training.problem, size, space)


def _derivatives(size: int, training: Training) -> Method:
    model, problem = training.model, training.problem

    def space(case: Case) -> Array:
        return static_derivatives(model, loads_about(problem, case)[model.free], size)

    return GalerkinAtHand(problem, size, space)


def loads_about(problem: FullProblem, case: Case) -> Array:
    """The load of a case and two across it, (3 n, 3) mN.

    Those across turn every contact's force to the side, as far as it is tilted in use.
    """
    total = np.zeros((len(problem.mesh.nodes), 3, 3))
    for contact, foot in zip(case.contacts, case.feet, strict=True):
        frame = np.array([contact.direction, *tangents(contact.direction)])
        frame[1:] *= TANGENTIAL
        weights = contact.pressure * problem.unit_load_at(*foot, case.radius)
        total += weights[:, None, None] * frame.T
    return total.reshape(-1, 3)


# --- all of them ---------------------------------------------------------------------------------


def _shipped(size: int, training: Training, way: Way = "cold") -> Method:
    if way == "cold" and training.in_time:
        way = "in time"
    return Shipped(training.problem, training.atlas, way)


BUILDERS: dict[str, Callable[[Any, Training], Method]] = {
    "modal": lambda size, t: _every_point(t, modal(t.model, size)),
    "ritz": partial(_krylov, moments=1),
    "krylov": _krylov,
    "pod": lambda size, t: _every_point(t, t.pod(size)),
    "pod-euclidean": lambda size, t: _every_point(t, t.pod(size, "euclidean")),
    "pod, no line search": lambda size, t: hyper.PlainNewton(t.problem, t.pod(size)),
    "pod-ecm": _cubature,
    "pod-ecm, 1 point a mode": partial(_cubature, most=1),
    "pod-ecsw": partial(_cubature, most=ELEMENTS_PER_MODE, by_element=True),
    "pod-deim": _deim,
    "pod-gappy": partial(_deim, per_mode=SAMPLES_PER_MODE),
    "ritz-at-hand": _ritz_at_hand,
    "derivatives": _derivatives,
    "linear": lambda size, t: Linear(t.problem, t.compliance[:, :size]),
    "regression": lambda size, t: Regression(t.problem, t.pod(size), t.snapshots),
    "artifact": _shipped,
    "artifact, warm": partial(_shipped, way="warm"),
    "artifact, tip": partial(_shipped, way="tip"),
    "full": lambda factor, t: Full(t.problem) if factor == 1 else Remeshed(t.problem, factor),
    "mass-spring": lambda factor, t: MassSpring(t.problem, factor),
    "tensor-mass": lambda factor, t: TensorMass(t.problem, factor),
}
"""Methods by name, from their size: the number of unknowns, or fewer if there are no more; of the
last three, with a mesh of their own, the factor on the divisions of the scene's.  The artifact
comes in one size only."""


def build(name: str, size: float, training: Training) -> Method:
    """Make a method, see ``BUILDERS``."""
    return BUILDERS[name](size, training)
