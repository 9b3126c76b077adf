"""The full finite element model: finite strain, total Lagrangian, quasi-static.

Its unknowns are the free degrees of freedom (dof = 3 node + axis, clamped nodes left out).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from palpate.offline.fem import assembly
from palpate.offline.fem.linear_solver import SparseSolver, sparse_solver
from palpate.offline.fem.potential import Potential
from palpate.offline.fem.terms import (
    AppliedLoad,
    DeadLoad,
    Past,
    PastStress,
    Place,
    Term,
    advanced,
)
from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import POINTS, kind_of
from palpate.shared.geometry.quadrature import volume_quadrature
from palpate.shared.local_models import Mesh
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.laws import AnyTissue, law_at_points, law_of
from palpate.shared.mechanics.tensors import SYMMETRIC
from palpate.shared.mechanics.tissue import WHOLE
from palpate.shared.mechanics.viscosity import step_weights

TOLERANCE = 1e-9
"""Residual of an equilibrium relative to the load or to the force of the past, whichever is larger,
in the Euclidean norm of nodal forces."""

ROUND_OFF = 1e-13
"""Of forces, relative to those that deform the whole body: no residual need be smaller."""

NOISE = 1e-16
"""Of the energy, relative to that which deforms the whole body: it is a sum over all points."""

MAX_ITERATIONS = 40
KEEP_TANGENT = 0.5
"""A factorisation costs ten corrections here, so a tangent serves while it halves the residual."""

SMALLEST_STEP = 1 / 64
"""Fraction of a load below which a load step is given up."""


class NoEquilibrium(PalpateError):
    """A load under which no equilibrium was found, even in small steps."""


@dataclass(frozen=True)
class Equilibrium:
    """A converged state of the full model, what the tool feels there, and how it was found."""

    displacement: Array  # (nodes, 3) mm
    energy: float  # mN mm, potential energy of tissue and load
    past: Past  # to go on from
    iterations: int
    load_steps: int
    min_jacobian: float  # smallest det F at the quadrature points
    force: Array  # (3,) mN, on the tool; see ``Reaction`` for these
    tangent: Array
    penetration: float
    place: Place | None
    foot: Array | None = None  # (3,) mm, where a tip touches the surface at rest


@dataclass
class FullModel:
    """Full model of one mesh and tissue."""

    mesh: Mesh
    tissue: AnyTissue
    terms: tuple[Term, ...] = ()  # of the tissue beside its elasticity, whatever the load
    quadrature: int | None = None  # points along an axis of an element, see ``Kind.integration``

    def __post_init__(self) -> None:
        mesh = self.mesh
        self.free = np.flatnonzero(np.repeat(~mesh.clamped, 3))
        self.gradients, self.weights = volume_quadrature(mesh.nodes, mesh.elements, self.quadrature)
        self.connectivity = np.ascontiguousarray(mesh.elements, dtype=np.int32)
        self.law = law_of(self.tissue, mesh.region)
        kind, count = kind_of(mesh.elements), self.weights.shape[1]
        parts = np.full(count, WHOLE) if self.quadrature else kind.integration[2]
        self.point_law = law_at_points(self.law, parts)
        self._elements = self.connectivity, self.gradients, self.weights, self.point_law
        self.prony = self.tissue.prony
        self.slots, self.pattern = self._sparsity()
        self.solver = sparse_solver(self.pattern)

    @cached_property
    def volumes(self) -> Array:
        """Volumes (e,) mm^3 of the elements."""
        return volume_quadrature(self.mesh.nodes, self.mesh.elements, POINTS)[1].sum(axis=1)

    @cached_property
    def relaxed(self) -> FullModel:
        """The model of what the tissue is after an infinite time, elastic."""
        if not self.prony:
            return self
        lost = PastStress(self, self.at_rest, step_weights(self.prony, np.inf))
        elastic = self.tissue.model_copy(update={"prony": ()})
        return replace(self, tissue=elastic, terms=(*self.terms, lost))

    @cached_property
    def at_rest(self) -> Past:
        """Tissue that nothing has happened to."""
        return Past(
            np.zeros((len(self.mesh.nodes), 3)),
            np.zeros((len(self.prony) + 1, *self.weights.shape, SYMMETRIC)),
        )

    def _dofs(self, nodes: Numbers) -> Ints:
        """Places (p, 3 k) among the free dofs of those of nodes (p, k); -1 is clamped."""
        number = np.full(3 * len(self.mesh.nodes), -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))
        return number[(3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)]

    def _sparsity(self) -> tuple[Numbers, csr_matrix]:
        """CSR pattern of the free dofs and the slot in it of every element matrix entry.

        All dofs of a node are free or none, so that pairs of nodes are sorted, not of dofs.
        """
        count, axes = len(self.free) // 3, np.arange(3)
        nodes = self._dofs(self.mesh.elements)[:, ::3] // 3
        rows, cols = np.broadcast_arrays(nodes[:, :, None], nodes[:, None])
        used = (rows >= 0) & (cols >= 0)
        keys, pair = np.unique(rows[used] * count + cols[used], return_inverse=True)
        row, col = np.divmod(keys, count)
        first = np.searchsorted(row, np.arange(count + 1))  # pair of a node
        starts = 9 * first[:-1, None] + 3 * np.diff(first)[:, None] * axes
        at = starts[row][:, :, None] + 3 * (np.arange(len(keys)) - first[row])[:, None, None] + axes
        indices = np.empty(9 * len(keys), np.int32)
        indices[at] = 3 * col[:, None, None] + axes
        indptr = np.append(starts, indices.size).astype(np.int32)
        slots = np.full((*used.shape, 3, 3), -1, dtype=np.int32)
        slots[used] = at.astype(np.int32)[pair]
        pattern = csr_matrix((np.zeros(indices.size), indices, indptr), 2 * (3 * count,))
        size = 3 * nodes.shape[1]
        return np.swapaxes(slots, 2, 3).reshape(len(nodes), size, size), pattern

    def face_slots(self, faces: Numbers) -> Numbers:
        """Slots (f, 3 k, 3 k) in the pattern of the dofs of faces (f, k); -1 is clamped."""
        dofs = self._dofs(faces)
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
        energy, smallest = assembly.elastic_residual(*self._elements, displacement, force)
        if smallest > 0.0:
            energy += sum(term.add_force(displacement, force) for term in self.terms)
        return energy, smallest

    def internal_free(self, u: Array) -> Array:
        """Internal force (free dofs,) mN of a displacement (free dofs,) mm.

        Raises
        ------
        PalpateError
            If the displacement inverts an element.
        """
        displacement = self.filled(u)
        force = np.empty_like(displacement)
        _, smallest = self.internal(displacement, force)
        if not smallest > 0:
            raise PalpateError("displacement: it inverts an element")
        return force[self.free]

    def paired_forces(self, states: Array, one: Array, other: Array, sign: float) -> Array:
        """Internal forces (k, free dofs) mN of small displacements, ``f(one) + sign f(other)``.

        ``one`` and ``other`` (k, m) say how states (m, free dofs) mm are superposed.
        """
        u = np.zeros((3 * len(self.mesh.nodes), len(states)))
        u[self.free] = states.T
        combined = np.concatenate([one, other]).T
        forces = np.zeros((len(u), len(one)))
        assembly.paired_residuals(*self._elements, u, np.ascontiguousarray(combined), sign, forces)
        if self.terms:
            added = np.zeros((combined.shape[1], len(u)))
            for displacement, force in zip(combined.T @ u.T, added, strict=True):
                for term in self.terms:
                    term.add_force(displacement, force)
            forces += (added[: len(one)] + sign * added[len(one) :]).T
        return forces[self.free].T

    def filled(self, u: Array) -> Array:
        """Displacement (3 nodes,) mm from that of the free dofs."""
        displacement = np.zeros(3 * len(self.mesh.nodes))
        displacement[self.free] = u
        return displacement

    def stiffness(self, displacement: Array) -> csr_matrix:
        """Tangent stiffness (mN/mm) of the free dofs at a displacement (3 nodes,) mm."""
        data = np.zeros(self.pattern.nnz)
        self.add_stiffness(displacement, data)
        return self.matrix(data)

    def matrix(self, data: Array) -> csr_matrix:
        """Matrix of the free dofs that holds ``data`` (nnz,)."""
        return csr_matrix((data, self.pattern.indices, self.pattern.indptr), copy=False)

    def add_stiffness(self, displacement: Array, data: Array) -> None:
        """Add the tangent stiffness of the tissue; see ``terms.DeadLoad``."""
        assembly.elastic_tangent(*self._elements, displacement, self.slots, data)
        for term in self.terms:
            term.add_stiffness(displacement, data, False)

    @cached_property
    def body(self) -> Array:
        """Modes (free dofs, 0) that reach beyond the mesh: see ``reduce.window``."""
        return np.zeros((len(self.free), 0))

    @cached_property
    def rest_stiffness(self) -> csr_matrix:
        """Stiffness (mN/mm) of the free dofs at rest."""
        return self.stiffness(np.zeros(3 * len(self.mesh.nodes)))

    @cached_property
    def deviatoric_stiffness(self) -> csr_matrix:
        """Part of the rest stiffness that relaxes: nothing else does."""
        share = sum(g for g, _ in self.prony)
        return (self.rest_stiffness - self.relaxed.rest_stiffness) / share

    @cached_property
    def _rest_solver(self) -> SparseSolver:
        solver = sparse_solver(self.pattern)
        solver.factorise(self.rest_stiffness.data)
        return solver

    def solve_linear(self, loads: Array) -> Array:
        """Linear response (free dofs, k) mm to loads (free dofs, k) mN: rest stiffness."""
        return self._rest_solver.solve(loads)

    def solve(
        self,
        load: AppliedLoad | Array,
        past: Past | None = None,
        dt: float = 0.0,
        start: Array | None = None,
        smallest_step: float = SMALLEST_STEP,
        keep: bool = False,
        tolerance: float = TOLERANCE,
        max_iterations: int = MAX_ITERATIONS,
        largest_shift: float = newton.LARGEST_SHIFT,
    ) -> Equilibrium:
        """Equilibrium under a load, in one jump if that converges, else in load steps.

        Parameters
        ----------
        load : AppliedLoad or ndarray, shape (nodes, 3), mN
            Nodal forces are a dead load.
        past : Past, optional
            Of the tissue before it is loaded; rest if absent.
        dt : float, s
            Since the end of the past.  May be 0, for a sudden change, or infinite.
        start : ndarray, shape (nodes, 3), mm, optional
            First guess; the last displacement of the past if absent.
        smallest_step : float
            See ``SMALLEST_STEP``.
        keep : bool
            Whether the equilibrium solved for last is near: its factorised tangent serves to begin
            with, and for the tangent of the reaction, which then is about right.
        tolerance : float
            See ``TOLERANCE``.
        max_iterations : int
            Of each load step, beyond which it has failed.
        largest_shift : float
            Of its tangents, in multiples of the rest stiffness, beyond which it has failed.

        Raises
        ------
        NoEquilibrium
        """
        if isinstance(load, np.ndarray):
            load = DeadLoad(load.reshape(-1))
        before = self.at_rest if past is None else past
        weights = step_weights(self.prony, dt)
        tissue: list[Term] = []
        if self.prony and (past is not None or dt > 0.0):
            tissue = [PastStress(self, before, weights)]
        if start is None and past is not None:
            start = past.displacement
        volume = float(self.volumes.sum())
        young = self.tissue.young
        floor, noise = ROUND_OFF * young * volume ** (2 / 3), NOISE * young * volume
        target = max(tolerance * max(term.size for term in (load, *tissue)), floor)
        u, converged = np.zeros((2, len(self.free)))
        if start is not None:
            u[:] = start.reshape(-1)[self.free]
        iterations, load_steps, reached, step = 0, 0, 0.0, 1.0
        while reached < 1.0:
            fraction = reached + step
            potential = Potential(self, [load.at(fraction), *tissue])
            if keep:
                potential.keep(u)
            status, made, energy, smallest = newton.newton(
                potential, u, np.empty((4, len(u))), target, KEEP_TANGENT, max_iterations, keep,
                noise=noise, largest_shift=largest_shift,
            )  # fmt: skip
            iterations, load_steps = iterations + made, load_steps + 1
            if status == newton.CONVERGED:
                converged[:], reached = u, fraction
                step = min(2.0 * step, 1.0 - reached)
                continue
            step, keep = 0.5 * step, False
            if step < smallest_step:
                raise NoEquilibrium(
                    f"load: no equilibrium found beyond {100 * reached:.0f} % of it; "
                    f"lower the {load.lower}"
                )
            u[:] = converged
        displacement = self.filled(u).reshape(-1, 3)
        return Equilibrium(
            displacement=displacement,
            energy=energy,
            past=advanced(self, before, displacement, weights),
            iterations=iterations,
            load_steps=load_steps,
            min_jacobian=smallest,
            **load.reaction(potential, displacement.reshape(-1))._asdict(),
        )
