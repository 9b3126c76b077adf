"""Bodies as trainers of surgery have them: tensor-mass models, and springs, on linear tetrahedra.

Each hexahedron of a mesh is cut into five tetrahedra, alternately one way and the other, so that
they fit together.  Linear tetrahedra are too stiff in bending, the more so the closer the tissue is
to incompressible; the elastic constants are the best that were found, and make up for it.

Tensor-mass (Cotin, Delingette & Ayache, The Visual Computer 16, 2000): the force on a point is
linear in its own displacement and in those of the points it shares an edge with, through one 3 x 3
tensor each.  That is the linear finite element method, organised by points; cutting a tetrahedron
out takes a few additions, which is what trainers want it for.  At rest it answers as its factorised
stiffness does.  Linear elasticity is good for small displacements only.

Springs join the corners of every cell along its edges and along both diagonals of each face, which
are the edges of its two cuts.  Their stiffnesses are identified after Lloyd, Szekely & Harders
(IEEE TVCG 13, 2007), who choose those whose linearised stiffness matrix is nearest to that of the
finite element model, ``min || K - sum_s k_s b_s b_s^T ||`` in the Frobenius norm with ``b_s`` (3
m,) the elongation of a spring by nodal displacements.  They do so for one element at a time, and
regular ones have closed forms: ``2 sqrt(2) / 25 E l`` for a tetrahedron of edge ``l``.  Here the
matrix is the assembled one, the mean of the two cuts, with ``k_s >= 0`` for stability: in elements
as flat as the turbinate's, stiffnesses added up from single elements are negative in places, and
cut off at zero they triple the error.

Trainers step a damped motion until it comes to rest.  The position at rest depends on neither mass
nor damping, so here they are left out: an implicit step of infinite length (Baraff & Witkin,
SIGGRAPH 1998) is a step of Newton's method.

A limit of any springs: a network of central forces obeys Cauchy's relation, ``lambda = mu``, so
that its Poisson's ratio is 1/4.  It is therefore identified from tissue of that ratio and cannot
represent tissue of .45.  Only the overall stiffness can be corrected, as that of tetrahedra: by the
factor with which small loads get the full model's answer in the mean.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import coo_matrix, csr_matrix

from palpate.offline.fem.linear_solver import sparse_solver
from palpate.offline.fem.model import KEEP_TANGENT, FullModel
from palpate.offline.fem.potential import Potential
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.terms import DeadLoad
from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Answer, Case
from palpate.offline.reduce.sampling import random_points
from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import PalpateError
from palpate.shared.local_models import Mesh
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.tissue import lame

Ints = NDArray[np.integer]

EVEN = ((0, 1, 2, 5), (0, 2, 3, 7), (0, 5, 7, 4), (2, 7, 5, 6), (0, 2, 7, 5))
"""Corners of the five tetrahedra of a hexahedron, by the right-hand rule; the last is central."""
ODD = ((1, 3, 0, 4), (1, 2, 3, 6), (1, 6, 4, 5), (3, 4, 6, 7), (1, 3, 4, 6))
"""The mirror image: its face diagonals are the other ones."""

POISSON = 0.25
"""Poisson's ratio with which linear tetrahedra come nearest to nearly incompressible tissue, and
that of every network of springs."""

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # of a tetrahedron
TOLERANCE = 3e-3
"""Residual relative to the load: on the turbinate, displacements are then within 1 % in the median,
2 % at the 95th percentile, of those at rest; the models themselves are off by ten times more."""

MAX_ITERATIONS = 100
LOADS = 24  # small loads by which a body's stiffness is fitted


def cut(mesh: Mesh, mirrored: Flags) -> Ints:
    """Tetrahedra (5 c, 4) of a mesh of hex8 elements, those that are mirrored (c,) cut as ``ODD``.

    Raises
    ------
    PalpateError
        If one is inside out or flat.
    """
    local = np.where(mirrored[:, None, None], np.array(ODD), np.array(EVEN))
    elements = np.take_along_axis(mesh.elements, local.reshape(len(mirrored), -1), axis=1)
    elements = elements.reshape(-1, 4)
    if not np.linalg.det(np.diff(mesh.nodes[elements], axis=1)).min() > 0.0:
        raise PalpateError("divisions: tetrahedra of this mesh are inside out or flat")
    return elements


def gradients(nodes: Array, elements: Ints) -> tuple[Array, Array]:
    """Gradients (t, 4, 3) 1/mm of the linear shape functions, and signed volumes (t,) mm^3."""
    corners = nodes[elements]
    edges = corners[:, 1:] - corners[:, :1]
    others = np.swapaxes(np.linalg.inv(edges), 1, 2)
    first = -others.sum(axis=1, keepdims=True)
    return np.concatenate([first, others], axis=1), np.linalg.det(edges) / 6.0


def stiffness(nodes: Array, elements: Ints, young: float, poisson: float) -> csr_matrix:
    """Stiffness matrix (3 m, 3 m) mN/mm of linear elastic tetrahedra.

    A pair of nodes has ``V (lambda g_a g_b^T + mu g_b g_a^T + mu (g_a . g_b) I)``, summed over the
    tetrahedra, with the gradients ``g_a`` of shape functions.
    """
    mu, lam = lame(young, poisson)
    g, volume = gradients(nodes, elements)
    outer = np.einsum("t,tai,tbj->taibj", volume, g, g)
    blocks = lam * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    blocks += mu * np.einsum("taibi,kl->takbl", outer, np.eye(3))
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 12)
    rows, columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    return coo_matrix((blocks.ravel(), (rows, columns)), (nodes.size, nodes.size)).tocsr()


class Fitted(Remeshed):
    """A body at the corners of another mesh that gets the full model's answer to small loads.

    It is stiffer than its own constants say by ``factor``.
    """

    factor = 1.0

    def __init__(self, problem: FullProblem, factor: float) -> None:
        super().__init__(problem, factor, "hex8")

    def load(self, case: Case) -> Array:
        """See ``Remeshed``: a stiffer body answers a load as a softer one does less of it."""
        return super().load(case) / self.factor

    def fit(self, linear: Callable[[Array], Array]) -> None:
        """Set the factor with which differences to the full model under loads all over are least.

        The sum of their squares is over loads and nodes.  ``linear`` gives the displacement (free
        dofs,) mm under small forces (free dofs,) mN, without the factor.
        """
        model, other = self.problem.model, self.other.model
        rng = np.random.default_rng(self.problem.scene.seed)
        both, square = 0.0, 0.0
        for point in random_points(self.problem.surface, LOADS, rng):
            x, normal, _ = self.problem.surface.project(point)
            case = Case.of(self.problem, Load(x, -normal, 1.0))
            wanted = model.solve_linear(case.load(len(self.problem.mesh.nodes)).ravel()[model.free])
            own = other.filled(linear(self.load(case).ravel()[other.free]))
            found = self.field(own.reshape(-1, 3)).ravel()
            both += float(found @ model.filled(wanted))
            square += float(found @ found)
        self.factor = square / both


class TensorMass(Fitted):
    """Tensor-mass model of a scene's body, five tetrahedra to a cell of the other mesh."""

    def __init__(self, problem: FullProblem, factor: float) -> None:
        super().__init__(problem, factor)
        mesh, free = self.other.mesh, self.other.model.free
        elements = cut(mesh, np.indices(self.cells).sum(axis=0).ravel() % 2 == 1)
        self.label = f"linear, {len(elements)} tetrahedra"
        K = stiffness(mesh.nodes, elements, problem.scene.tissue.young, POISSON)[free][:, free]
        self._solver = sparse_solver(K)
        self._solver.factorise(K.data)
        self.fit(self._solver.solve)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        model = self.other.model
        found = self._solver.solve(self.load(case).ravel()[model.free])
        return Answer(model.filled(found).reshape(-1, 3))


class Springs(FullModel):
    """Springs between the nodes of a mesh of hex8 elements, in place of its tissue.

    They join the nodes ``ends`` (s, 2), each pair once, with stiffnesses ``springs`` (s,) mN/mm.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        every = np.ones(len(self.mesh.elements), dtype=bool)
        tetrahedra = np.concatenate([cut(self.mesh, every), cut(self.mesh, ~every)])
        self.ends = edges_of(tetrahedra)
        self.springs = identify(self.mesh.nodes, tetrahedra, self.ends, self.tissue.young)
        self._vectors = np.diff(self.mesh.nodes[self.ends], axis=1)[:, 0]
        self._lengths = np.linalg.norm(self._vectors, axis=1)
        slots = self.face_slots(self.ends.astype(np.int32))
        self._used = slots >= 0
        self._slots = slots[self._used]

    def _moved(self, displacement: Array) -> tuple[Array, Array, Array]:
        """What ends move apart (s, 3) mm, the springs as vectors (s, 3) mm, and their lengths."""
        apart = np.diff(displacement.reshape(-1, 3)[self.ends], axis=1)[:, 0]
        along = self._vectors + apart
        return apart, along, np.sqrt(np.einsum("si,si->s", along, along))

    def internal(self, displacement: Array, force: Array) -> tuple[float, float]:
        """See ``FullModel``; springs cannot turn inside out.

        The elongation is computed from ``|v + w|^2 - |v|^2 = w . (2 v + w)``, free of cancellation.
        """
        apart, along, length = self._moved(displacement)
        longer = np.einsum("si,si->s", apart, self._vectors + along) / (length + self._lengths)
        pull = (self.springs * longer / length)[:, None] * along
        nodal = force.reshape(-1, 3)
        nodal[:] = 0.0
        for end, sign in zip(self.ends.T, (-1.0, 1.0), strict=True):
            for axis in range(3):
                nodal[:, axis] += sign * np.bincount(end, pull[:, axis], len(nodal))
        return 0.5 * float(self.springs @ longer**2), 1.0

    def add_stiffness(self, displacement: Array, data: Array) -> None:
        """See ``FullModel``: ``k (n n^T + max(0, 1 - L / l) (I - n n^T))``.

        What a compressed spring takes from the stiffness across it is left out, which keeps the
        tangent definite (Choi & Ko, SIGGRAPH 2002).
        """
        _, along, length = self._moved(displacement)
        across = self.springs * np.maximum(0.0, 1.0 - self._lengths / length)
        outer = np.einsum("s,si,sj->sij", (self.springs - across) / length**2, along, along)
        blocks = outer + across[:, None, None] * np.eye(3)
        blocks = np.kron([[1.0, -1.0], [-1.0, 1.0]], blocks)
        data += np.bincount(self._slots, blocks[self._used], len(data))


class MassSpring(Fitted):
    """Mass-spring system in a scene's body, at large displacements."""

    def __init__(self, problem: FullProblem, factor: float) -> None:
        super().__init__(problem, factor)
        elastic = self.other.scene.tissue.model_copy(update={"prony": ()})
        self.network = Springs(self.other.mesh, elastic)
        self.label = f"{len(self.network.ends)} springs"
        self.fit(self.network.solve_linear)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        load, u = DeadLoad(self.load(case).ravel()), np.zeros(self.unknowns)
        potential, work = Potential(self.network, [load]), np.empty((4, len(u)))
        with np.errstate(all="ignore"):
            target = TOLERANCE * load.size
            status, *_ = newton.newton(
                potential, u, work, target, KEEP_TANGENT, MAX_ITERATIONS, False
            )
        converged = status == newton.CONVERGED and target < np.inf
        found = self.network.filled(u).reshape(-1, 3)
        return Answer(found if converged else state, converged)


def edges_of(elements: Ints) -> Ints:
    """Pairs (e, 2) of nodes, ascending, that tetrahedra (t, 4) join, each once."""
    ends = elements[:, np.array(EDGES)].reshape(-1, 2)
    return np.unique(np.sort(ends, axis=1), axis=0)


def identify(points: Array, elements: Ints, ends: Ints, young: float) -> Array:
    """Spring stiffnesses nearest to the stiffness matrix of linear tetrahedra.

    The normal equations are ``sum_t (b_s . b_t)^2 k_t = b_s . K b_s``.

    Parameters
    ----------
    points : ndarray, shape (m, 3), mm
    elements : ndarray, shape (t, 4), int
        Two tetrahedra wherever there is tissue: each counts half.
    ends : ndarray, shape (s, 2), int
        Their edges.
    young : float, kPa

    Returns
    -------
    k : ndarray, shape (s,), mN/mm, not negative
    """
    along = np.diff(points[ends], axis=1)[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(ends)), 6)
    columns = (3 * ends[:, :, None] + np.arange(3)).ravel()
    values = np.stack([-along, along], axis=1).ravel()
    elongation = csr_matrix((values, (rows, columns)), (len(ends), points.size))
    normal = (elongation @ elongation.T).power(2).tocsr()
    K = 0.5 * stiffness(points, elements, young, POISSON)
    wanted = np.asarray((elongation @ K).multiply(elongation).sum(axis=1)).ravel()

    def distance(k: Array) -> tuple[float, Array]:
        """Half the squared norm but for a constant, and its gradient."""
        product = normal @ k
        return float(k @ (0.5 * product - wanted)), product - wanted

    found = minimize(
        distance, wanted / normal.diagonal(), jac=True, method="L-BFGS-B",
        bounds=[(0.0, None)] * len(ends), options={"ftol": 1e-13, "maxiter": 5000, "maxfun": 10000},
    )  # fmt: skip
    return np.asarray(found.x)
