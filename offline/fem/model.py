"""The full finite element model: finite strain, total Lagrangian, quasi-static.

It gives ``mechanics.newton`` its potential, tangent and correction on the free degrees of freedom
(dof = 3 node + axis, clamped nodes left out) and answers loads on its surface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem import assembly
from palpate.offline.fem.linear_solver import NotPositiveDefinite, sparse_solver
from palpate.offline.fem.mesh import Mesh
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.quadrature import volume_quadrature
from palpate.shared.mechanics import newton, sphere, viscosity
from palpate.shared.mechanics.laws import AnyTissue, law_of
from palpate.shared.mechanics.sphere import Tip, TipSurface, Touching, room_for
from palpate.shared.mechanics.tensors import SYMMETRIC
from palpate.shared.scene import ElementName, Scene

Array = NDArray[np.float64]

POINTWISE: tuple[ElementName, ...] = ("hex8", "hex20")
"""Elements whose points stand alone. Where they share a dilatation, a cubature cannot sample them
one by one, so only the full model has those."""

TOLERANCE = 1e-9
"""Residual of an equilibrium relative to the load, both in the Euclidean norm of nodal forces."""

ROUND_OFF = 1e-13
"""Of forces, relative to those that deform the whole body."""

MAX_ITERATIONS = 40
KEEP_TANGENT = 0.05
"""A factorisation costs ten corrections here, so a tangent serves while it gains a digit."""


class NoEquilibrium(PalpateError):
    """A load under which no equilibrium was found, even in small steps."""


@dataclass(frozen=True)
class Equilibrium:
    """A converged state of the full model."""

    displacement: Array  # (nodes, 3) mm
    iterations: int
    load_steps: int
    min_jacobian: float


@dataclass(frozen=True)
class TipEquilibrium(Equilibrium):
    """A converged state under a rigid tip."""

    force: Array  # (3,) mN, on the tool
    tangent: Array  # (3, 3) mN/mm, derivative of the force in the tip's position
    penetration: float  # mm, largest
    energy: float  # mN mm, stored in tissue and penalty


@dataclass(frozen=True)
class History:
    """What tissue remembers; see ``mechanics.viscosity``."""

    displacement: Array  # (nodes, 3) mm, the last
    points: Array  # (terms + 1, e, q, 6), at quadrature points


def predicted(history: History, weights: viscosity.Weights) -> Array:
    """``B`` of ``mechanics.viscosity`` (e, q, 6) at the end of a step with these weights."""
    points = history.points
    B = np.empty(points.shape[1:])
    loss = viscosity.predict(points.reshape(len(points), -1), weights, B.reshape(-1))
    B[..., :3] -= loss
    return B


class TipContact:
    """A rigid tip, somewhere, against the full model's surface.

    Attributes
    ----------
    tip : Tip
    position : ndarray, shape (3,), mm
        Centre of the tip.
    """

    def __init__(self, model: FullModel, surface: TipSurface, tip: Tip) -> None:
        self.tip = tip
        self.surface = surface
        self.position = np.full(3, np.inf)
        self._near = np.arange(len(surface.faces), dtype=np.int32)
        self._touching: Touching = room_for(surface, len(surface.faces))
        self._slots = model.face_slots(surface.faces)

    def potential(self, displacement: Array, force: Array) -> float:
        """Energy of the penalty (mN mm); adds its gradient to ``force`` (3 nodes,) mN."""
        count, energy, self.deepest = self._touch(displacement, sphere.FORCE)
        faces = self.surface.faces[self._touching.face[:count]]
        np.subtract.at(force.reshape(-1, 3), faces, self._touching.force[:count])
        return energy

    def stiffen(self, displacement: Array, data: Array, convex: bool) -> None:
        """Add the contact's tangent at a displacement (3 nodes,), or its convex part."""
        count, _, _ = self._touch(displacement, sphere.CONVEX if convex else sphere.STIFFNESS)
        assembly.scatter_faces(
            self._touching.stiffness[:count], self._slots[self._touching.face[:count]], data
        )

    def reaction(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Force (3,) mN on the tool, and how it couples with the tissue.

        Returns
        -------
        force : ndarray, shape (3,)
        own : ndarray, shape (3, 3), mN/mm
            Second derivative of the potential in the tip's position.
        coupling : ndarray, shape (3 nodes, 3), mN/mm
            Minus the mixed one.
        """
        count, _, _ = self._touch(displacement, sphere.STIFFNESS)
        K = self._touching.stiffness[:count].copy()
        for i, j in ((1, 0), (2, 0), (2, 1)):
            K[:, i, j] = K[:, j, i]
        coupling = np.zeros((len(displacement) // 3, 3, 3))
        faces = self.surface.faces[self._touching.face[:count]]
        np.add.at(coupling, faces, np.einsum("fijab->faij", K))
        force = -self._touching.force[:count].sum(axis=(0, 1))
        return force, self._touching.own, coupling.reshape(len(displacement), 3)

    def _touch(self, displacement: Array, wanted: float) -> tuple[int, float, float]:
        found: tuple[int, float, float] = sphere.touch(
            self.tip, self.surface, self._near, self.position, displacement.reshape(-1, 3),
            self._touching, wanted,
        )  # fmt: skip
        return found


@dataclass
class FullModel:
    """Full model of one mesh and tissue.

    Parameters
    ----------
    mesh : Mesh
    element : {"hex8", "hex8-mean-dilatation", "hex8-fbar", "hex20"}
    tissue : AnyTissue
        Only ``step`` and ``touch_step`` know of its time: ``solve`` and ``touch`` answer instantly.
    """

    mesh: Mesh
    element: ElementName
    tissue: AnyTissue
    _load: Array = field(init=False, repr=False)

    @classmethod
    def of(cls, scene: Scene, mesh: Mesh) -> FullModel:
        """Full model of a scene on its mesh."""
        return cls(mesh, scene.geometry.element, scene.tissue)

    def __post_init__(self) -> None:
        mesh = self.mesh
        self.free = np.flatnonzero(np.repeat(~mesh.clamped, 3))
        self.gradients, self.weights = volume_quadrature(mesh.nodes, mesh.elements, 2)
        self.connectivity = np.ascontiguousarray(mesh.elements, dtype=np.int32)
        self.law = law_of(self.tissue, len(mesh.elements))
        self.prony = self.tissue.prony
        self._theta = self._theta_points()
        self._slots, self.pattern = self._sparsity()
        self._load = np.zeros(len(self.free))
        self._full = np.zeros(3 * len(mesh.nodes))
        self._force = np.zeros_like(self._full)
        self._data = np.zeros(self.pattern.nnz)
        self._work = np.zeros((4, len(self.free)))
        self._solver = sparse_solver(self.pattern)
        self._at_rest = False
        self._contact: TipContact | None = None
        self._past: Array | None = None

    @cached_property
    def relaxed(self) -> FullModel:
        """The model of what the tissue is after an infinite time, elastic."""
        if not self.prony:
            return self
        other = replace(self, tissue=self.tissue.model_copy(update={"prony": ()}))
        other._past = predicted(self.at_rest, viscosity.step_weights(self.prony, np.inf))
        return other

    @property
    def at_rest(self) -> History:
        """Tissue that nothing has happened to."""
        return History(
            np.zeros((len(self.mesh.nodes), 3)),
            np.zeros((len(self.prony) + 1, *self.weights.shape, SYMMETRIC)),
        )

    def _theta_points(self) -> tuple[Array, Array] | None:
        """Gradients and weights of the points whose J make up an element's dilatation."""
        if self.element == "hex8-mean-dilatation":
            return self.gradients, self.weights / self.weights.sum(axis=1, keepdims=True)
        if self.element == "hex8-fbar":
            weights = self.weights / self.weights.sum(axis=1, keepdims=True)
            mean = np.einsum("eq,eqai->eai", weights, self.gradients)
            return np.ascontiguousarray(mean[:, None]), np.ones((len(mean), 1))
        return None

    def _sparsity(self) -> tuple[NDArray[np.int32], csr_matrix]:
        """CSR pattern of the free dofs and the slot in it of every element matrix entry."""
        number = np.full(3 * len(self.mesh.nodes), -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))
        dofs = number[
            (3 * self.mesh.elements[:, :, None] + np.arange(3)).reshape(len(self.mesh.elements), -1)
        ]
        rows = np.repeat(dofs, dofs.shape[1], axis=1).ravel()
        cols = np.tile(dofs, (1, dofs.shape[1])).ravel()
        used = (rows >= 0) & (cols >= 0)
        keys, inverse = np.unique(rows[used] * len(self.free) + cols[used], return_inverse=True)
        slots = np.full(len(rows), -1, dtype=np.int32)
        slots[used] = inverse
        n = len(self.free)
        indptr = np.searchsorted(keys // n, np.arange(n + 1)).astype(np.int32)
        pattern = csr_matrix((np.zeros(len(keys)), (keys % n).astype(np.int32), indptr), (n, n))
        return slots.reshape(len(dofs), dofs.shape[1], -1), pattern

    def face_slots(self, faces: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (f, 3 k, 3 k) in the pattern of the dofs of faces (f, k); -1 is clamped."""
        number = np.full(3 * len(self.mesh.nodes), -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))
        dofs = number[(3 * faces[:, :, None] + np.arange(3)).reshape(len(faces), -1)]
        rows = np.broadcast_to(dofs[:, :, None], (*dofs.shape, dofs.shape[1]))
        cols = np.swapaxes(rows, 1, 2)
        n = len(self.free)
        filled = np.repeat(np.arange(n), np.diff(self.pattern.indptr)) * n + self.pattern.indices
        slots = np.searchsorted(filled, rows * n + cols)
        return np.where((rows >= 0) & (cols >= 0), slots, -1).astype(np.int32)

    def internal(self, displacement: Array, force: Array) -> tuple[float, float]:
        """Write the internal force (3 nodes,) mN of a displacement (3 nodes,) mm.

        Returns
        -------
        energy, smallest : float
            Stored energy (mN mm) and smallest det F.
        """
        force[:] = 0.0
        args = (self.connectivity, self.gradients, self.weights)
        if self._theta is None:
            energy, smallest = assembly.standard_residual(*args, self.law, displacement, force)
        else:
            energy, smallest = assembly.dilatation_residual(
                *args, *self._theta, self.law, displacement, force
            )
        if self._past is not None and smallest > 0.0:
            energy += assembly.viscous_residual(*args, self.law.mu, self._past, displacement, force)
        return energy, smallest

    def internal_free(self, u: Array) -> Array:
        """Internal force (free dofs,) mN of a displacement (free dofs,) mm.

        Raises
        ------
        PalpateError
            If the displacement inverts an element.
        """
        self._full[self.free] = u
        _, smallest = self.internal(self._full, self._force)
        if not smallest > 0:
            raise PalpateError("displacement: it inverts an element")
        return self._force[self.free]

    def solve_linear(self, loads: Array) -> Array:
        """Linear response (free dofs, k) mm to loads (free dofs, k) mN: rest stiffness."""
        if not self._at_rest:
            self.factorise(np.zeros(len(self.free)), 0.0)
            self._at_rest = True
        return self._solver.solve(loads)

    def relative_residuals(self, displacements: Array, loads: Array) -> Array:
        """What displacements (k, free dofs) mm leave of loads (k, free dofs) mN, relative to them.

        Both are measured as displacements in the energy of the rest state; infinite where the
        displacement inverts an element.
        """
        left, sound = np.zeros_like(loads), np.ones(len(loads), dtype=bool)
        for i, (u, load) in enumerate(zip(displacements, loads, strict=True)):
            try:
                left[i] = load - self.internal_free(u)
            except PalpateError:
                sound[i] = False
        energies = np.sum(left.T * self.solve_linear(left.T), axis=0)
        own = np.sum(displacements.T * (self.rest_stiffness @ displacements.T), axis=0)
        return np.where(sound, np.sqrt(energies / own), np.inf)

    def stiffness(self, displacement: Array) -> csr_matrix:
        """Tangent stiffness (mN/mm) of the free dofs; the next call overwrites the matrix."""
        self._data[:] = 0.0
        args = (self.connectivity, self.gradients, self.weights)
        rest = (self.law, displacement, self._slots, self._data)
        if self._theta is None:
            assembly.standard_tangent(*args, *rest)
        else:
            assembly.dilatation_tangent(*args, *self._theta, *rest)
        if self._past is not None:
            assembly.viscous_tangent(
                *args, self.law.mu, self._past, displacement, self._slots, self._data
            )
        return csr_matrix((self._data, self.pattern.indices, self.pattern.indptr), copy=False)

    @cached_property
    def rest_stiffness(self) -> csr_matrix:
        """Stiffness (mN/mm) of the free dofs at rest, where nothing has happened before."""
        data, past = self._data, self._past
        self._data = np.zeros_like(data)
        if self.prony:
            self._past = None
        try:
            return self.stiffness(np.zeros_like(self._full))
        finally:
            self._data, self._past = data, past

    # what mechanics.newton asks for ------------------------------------------------------------

    def potential(self, u: Array, residual: Array) -> tuple[float, float]:
        """Total potential energy (mN mm), its gradient (mN) and the smallest det F."""
        self._full[self.free] = u
        energy, smallest = self.internal(self._full, self._force)
        if self._contact is not None:
            energy += self._contact.potential(self._full, self._force)
        np.subtract(self._force[self.free], self._load, out=residual)
        return energy - float(self._load @ u), smallest

    def factorise(self, u: Array, shift: float) -> bool:
        """Factorise the tangent plus ``shift`` times the rest stiffness, if that is definite."""
        self._full[self.free] = u
        matrix = self.stiffness(self._full)
        if self._contact is not None:
            self._contact.stiffen(self._full, matrix.data, shift > 0)
        data = matrix.data + shift * self.rest_stiffness.data if shift else matrix.data
        self._at_rest = False
        try:
            self._solver.factorise(data)
        except NotPositiveDefinite:
            return False
        return True

    def correct(self, residual: Array, step: Array) -> None:
        """Newton's step for a residual, by the last factorisation."""
        np.negative(self._solver.solve(residual), out=step)

    # ---------------------------------------------------------------------------------------------

    def solve(
        self,
        load: Array,
        start: Array | None = None,
        reuse: float = KEEP_TANGENT,
        smallest_step: float = 1 / 64,
        least: float = 1e-12,
    ) -> Equilibrium:
        """Equilibrium under a dead load, in one jump if that converges, else in load steps.

        Parameters
        ----------
        load : ndarray, shape (nodes, 3), mN
        start : ndarray, shape (nodes, 3), mm, optional
            First guess; rest if absent.
        reuse : float
            See ``mechanics.newton.newton``.
        smallest_step : float
            Fraction of the load below which a step is given up.
        least : float, mN
            Residual that counts as equilibrium under any load, however small.

        Raises
        ------
        NoEquilibrium
        """
        full_load = load.reshape(-1)[self.free]

        def apply(fraction: float) -> None:
            np.multiply(full_load, fraction, out=self._load)

        target = max(TOLERANCE * float(np.linalg.norm(full_load)), least)
        return self._follow(apply, target, start, reuse, smallest_step, "pressure")[0]

    def step(
        self, history: History, load: Array, dt: float, start: Array | None = None
    ) -> tuple[Equilibrium, History]:
        """Equilibrium under a dead load ``dt`` after the end of a history, and the longer history.

        Parameters
        ----------
        history : History
        load : ndarray, shape (nodes, 3), mN
        dt : float, s
            May be 0, for a sudden change, or infinite.
        start : ndarray, shape (nodes, 3), mm, optional
            First guess; the history's last displacement if absent.

        Raises
        ------
        NoEquilibrium
        """
        if start is None:
            start = history.displacement
        with self._remembering(history, dt) as weights:
            found = self.solve(load, start, least=self._least_residual(history))
        return found, self.advanced(history, found.displacement, weights)

    def touch_step(
        self,
        history: History,
        contact: TipContact,
        position: Array,
        approach: Array,
        dt: float,
        start: Array | None = None,
    ) -> tuple[TipEquilibrium, History]:
        """Equilibrium under a rigid tip ``dt`` after the end of a history, and the longer history.

        For ``history``, ``dt`` (s) and ``start`` see ``step``, for the tip see ``touch``. Force and
        tangent are those of the end of the step, the energy is that of its potential.

        Raises
        ------
        NoEquilibrium
        """
        if start is None:
            start = history.displacement
        with self._remembering(history, dt) as weights:
            found = self.touch(contact, position, approach, start)
        return found, self.advanced(history, found.displacement, weights)

    @contextmanager
    def _remembering(self, history: History, dt: float) -> Iterator[viscosity.Weights]:
        """Solve with what a history exerts ``dt`` after its end; gives the weights of the step."""
        weights = viscosity.step_weights(self.prony, dt)
        self._past = predicted(history, weights)
        try:
            yield weights
        finally:
            self._past, self._at_rest = None, False

    def advanced(
        self, history: History, displacement: Array, weights: viscosity.Weights
    ) -> History:
        """History that has gone a step further, to a displacement (nodes, 3) mm."""
        points = history.points.copy()
        m = np.empty(points.shape[1:])
        assembly.drive(self.connectivity, self.gradients, displacement.reshape(-1), m)
        viscosity.advance(m.reshape(-1), weights, points.reshape(len(points), -1))
        return History(displacement, points)

    def _least_residual(self, history: History) -> float:
        """Residual (mN) that counts as equilibrium: small beside what the past exerts, or none."""
        force = np.zeros_like(self._full)
        assembly.viscous_residual(
            self.connectivity, self.gradients, self.weights, self.law.mu, self._past,
            history.displacement.reshape(-1), force,
        )  # fmt: skip
        none = ROUND_OFF * self.tissue.young * self.weights.sum() ** (2 / 3)
        return max(TOLERANCE * float(np.linalg.norm(force[self.free])), float(none))

    def touch(
        self,
        contact: TipContact,
        position: Array,
        approach: Array,
        start: Array | None = None,
        smallest_step: float = 1 / 64,
    ) -> TipEquilibrium:
        """Equilibrium under a rigid tip, in one jump if that converges, else in steps of its way.

        Parameters
        ----------
        contact : TipContact
            Made for this model; keeps where the tip is.
        position : ndarray, shape (3,), mm
            Centre of the tip.
        approach : ndarray, shape (3,), mm
            The way the tip has come: it began at ``position - approach``, without contact.
        start : ndarray, shape (nodes, 3), mm, optional
            First guess; rest if absent.
        smallest_step : float
            Fraction of the way below which a step is given up.

        Raises
        ------
        NoEquilibrium
        """

        def apply(fraction: float) -> None:
            contact.position[:] = position - (1.0 - fraction) * approach

        # the force is not known before; that which dents the tissue by the tip's radius is
        target = TOLERANCE * self.tissue.young * contact.tip.radius**2
        self._contact = contact
        self._load[:] = 0.0
        try:
            found, energy = self._follow(apply, target, start, KEEP_TANGENT, smallest_step, "depth")
            u = found.displacement.reshape(-1)
            self.factorise(u[self.free], 0.0)
            force, own, coupling = contact.reaction(u)
            coupling = coupling[self.free]
            tangent = coupling.T @ self._solver.solve(coupling) - own
        finally:
            self._contact = None
        return TipEquilibrium(
            **vars(found),
            force=force,
            tangent=tangent,
            penetration=contact.deepest,
            energy=energy,
        )

    def _follow(
        self,
        apply: Callable[[float], None],
        target: float,
        start: Array | None,
        reuse: float,
        smallest_step: float,
        field: str,
    ) -> tuple[Equilibrium, float]:
        """Equilibrium at the end of a path of loads, and its energy; ``apply`` sets a fraction."""
        u = np.zeros(len(self.free)) if start is None else start.reshape(-1)[self.free].copy()
        converged, reached, step = u.copy() if start is None else np.zeros_like(u), 0.0, 1.0
        total = steps = 0
        while reached < 1.0:
            fraction = min(1.0, reached + step)
            apply(fraction)
            status, iterations, energy, smallest = newton.newton(
                self, u, self._work, target, reuse, MAX_ITERATIONS, False
            )
            total += iterations
            steps += 1
            if status == newton.CONVERGED:
                converged[:], reached, step = u, fraction, 2.0 * step
                continue
            step *= 0.5
            if step < smallest_step:
                raise NoEquilibrium(
                    f"load: no equilibrium found beyond {100 * reached:.0f} % of it; "
                    f"lower the {field}"
                )
            u[:] = converged
        displacement = np.zeros(3 * len(self.mesh.nodes))
        displacement[self.free] = u
        return Equilibrium(displacement.reshape(-1, 3), total, steps, smallest), energy
