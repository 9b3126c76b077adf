"""Terms of a local model's potential: its past and its load; see ``reduced.problem``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.compiled import by_type
from palpate.shared.mechanics import sphere
from palpate.shared.reduced.points import (
    FAST,
    add_past_stress,
    back_substitute,
    multiply,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]

# --- the past ------------------------------------------------------------------------------------


class Elastic(NamedTuple):
    """Tissue without a past."""

    none: float = 0.0


class Viscous(NamedTuple):
    """What the past does at the end of a time step."""

    deviatoric: Field  # (r, r) D
    mean: Array  # (r,) h
    exerted: Array  # (r,) D h
    loss: Array  # (1,) l
    B: Field  # (6 c,) in tiles, what the past drives the points to
    S: Field  # (6 c,) in tiles, kPa, the linear part of it
    softer: Array  # (r,) D q of the last evaluation
    state: Field  # scratch of ``points.add_past_increments``


def recall(past, points, work):
    """Add what the past does beyond linear visco-elasticity to ``work.P``; return its energy."""


def _recall_nothing(past, points, work):
    return 0.0


def _recall(past, points, work):
    # the parts of the elastic energy have served; their room is that of the past's
    add_past_stress(
        work.H, points.weights, points.law.mu, work.J, past.B, past.S, past.loss[0], work.part,
        work.P,
    )  # fmt: skip
    return np.dot(points.weights, work.part)


def soften(past, q, residual):
    """Add linear visco-elasticity to the residual; return its energy."""


def _soften_nothing(past, q, residual):
    return 0.0


def _soften(past, q, residual):
    loss, softer, exerted, energy = past.loss[0], past.softer, past.exerted, 0.0
    multiply(past.deviatoric, q, softer)
    for i in range(len(q)):
        lost = loss * softer[i]
        residual[i] -= lost + exerted[i]
        energy -= (0.5 * lost + exerted[i]) * q[i]
    return energy


def soften_tangent(past, bulk, tangent):
    """``tangent = bulk - l D``."""


def _soften_tangent_nothing(past, bulk, tangent):
    tangent[:] = bulk


def _soften_tangent(past, bulk, tangent):
    _subtract(bulk, past.loss[0], past.deviatoric, tangent)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _subtract(A, factor, D, out):
    """``out = A - factor D``: A, out (r, r) float64, D (r, r) float32."""
    for i in range(len(A)):
        a, d, o = A[i], D[i], out[i]
        for j in range(len(a)):
            o[j] = a[j] - factor * d[j]


def has_moved(past, formed, size, lag):
    """Whether the past differs by more than ``lag`` from that at which a tangent was formed."""


def _has_not_moved(past, formed, size, lag):
    return False


def _has_moved(past, formed, size, lag):
    moved, r = 0.0, len(past.mean)
    for j in range(r):
        moved += (past.mean[j] - formed[j]) ** 2
    return not (moved <= lag * lag * size and abs(past.loss[0] - formed[r]) <= lag)


def note_past(past, formed):
    """Write the past at which a tangent is formed, (r + 1,)."""


def _note_nothing(past, formed):
    pass


def _note_past(past, formed):
    formed[:-1] = past.mean
    formed[-1] = past.loss[0]


# --- the load ------------------------------------------------------------------------------------


class Dead(NamedTuple):
    """A load that does not follow the tissue."""

    f: Array  # (r,) mN times mode


class Contact(NamedTuple):
    """The rigid tip on the nodes of the surface near a local model."""

    tip: sphere.Tip
    surface: sphere.TipSurface
    x: Array  # (3,) mm, centre of the tip
    nodes: NDArray[np.int32]  # (s,) of the surface
    modes: Field  # (s, 3, r) mm
    faces: NDArray[np.int32]  # (t,) of the surface
    corners: NDArray[np.int32]  # (t, k) their nodes, counted from the model's first
    moved: Array  # (n, 3) mm, of the surface's nodes; only those of the model are written
    own: Array  # (3 k f, r) modes at the nodes of touching faces
    folded: Array  # (3 k f, r) the faces' stiffnesses times these
    square: Array  # (3 k, 3 k) a face's stiffness
    product: Array  # (r, r)
    touching: sphere.Touching
    latest: Array  # (r,) state that ``touching`` is of


def push(load, q, residual):
    """Subtract the load from the residual; return its potential."""


def _push_dead(load, q, residual):
    energy = 0.0
    for i in range(len(q)):
        residual[i] -= load.f[i]
        energy -= load.f[i] * q[i]
    return energy


def _push_contact(load, q, residual):
    count, energy, _ = form_contact(load, q, sphere.STIFFNESS)
    for c in range(count):
        own, force = load.corners[load.touching.face[c]], load.touching.force[c]
        for k in range(len(own)):
            for i in range(3):
                row, f = load.modes[own[k], i], force[k, i]
                for j in range(len(q)):
                    residual[j] -= f * row[j]
    return energy


def stiffen(load, q, shift, tangent):
    """Add the load's stiffness at q to the tangent; its convex part where that is shifted."""


def _stiffen_dead(load, q, shift, tangent):
    pass


def _stiffen_contact(load, q, shift, tangent):
    if shift > 0.0:
        form_contact(load, q, sphere.CONVEX)
        load.latest[:] = np.inf
    elif distance(q, load.latest) > 0.0:
        form_contact(load, q, sphere.STIFFNESS)
    add_contact(load, tangent)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _move(nodes, modes, q, moved):
    """Displacement of the nodes (s,) in the state q, into the rows of ``moved`` (n, 3) mm."""
    for a in range(len(nodes)):
        for i in range(3):
            row, total = modes[a, i], 0.0
            for j in range(len(q)):
                total += row[j] * q[j]
            moved[nodes[a], i] = total


@njit(cache=True, error_model="numpy", nogil=True)
def form_contact(load, q, wanted):
    """What the tip does to the state q: (faces touched, energy, largest penetration)."""
    _move(load.nodes, load.modes, q, load.moved)
    load.latest[:] = q
    return sphere.touch(
        load.tip, load.surface, load.faces, load.x, load.moved, load.touching, wanted
    )


@njit(cache=True, error_model="numpy", nogil=True)
def add_contact(load, tangent):
    """Add the stiffness of all touching faces; ``reaction`` uses what is left in ``folded``.

    It exceeds the tissue's by many orders of magnitude, so single precision would not do.
    """
    own, folded, square = load.own, load.folded, load.square
    rows = 3 * load.corners.shape[1]
    count = load.touching.touched[0]
    for c in range(count):
        _place_face(load, c, square, own[rows * c : rows * (c + 1)])
        np.dot(square, own[rows * c : rows * (c + 1)], folded[rows * c : rows * (c + 1)])
    if count > 0:
        np.dot(own[: rows * count].T, folded[: rows * count], load.product)
        tangent[:] += load.product


@njit(cache=True, error_model="numpy", nogil=True)
def _place_face(load, c, square, own):
    """A touching face's stiffness (3 k, 3 k), and the modes (3 k, r) at its nodes."""
    K, corners = load.touching.stiffness[c], load.corners[load.touching.face[c]]
    nodes = len(corners)
    for i in range(3):
        for a in range(nodes):
            row, target = load.modes[corners[a], i], own[nodes * i + a]
            for n in range(len(row)):
                target[n] = row[n]
            for j in range(3):
                low, high = min(i, j), max(i, j)
                for b in range(nodes):
                    square[nodes * i + a, nodes * j + b] = K[low, high, a, b]


@njit(cache=True, error_model="numpy", nogil=True)
def reaction(load, factor, coupling, step, force, tangent):
    """Force on the tool and its derivative in an equilibrium whose tangent is factorised.

    Parameters
    ----------
    load : Contact
    factor : ndarray, shape (r, r)
    coupling : ndarray, shape (3, r), out, mN/mm
        Minus the derivative of the residual in the tip's place: the answer moves by
        ``tangent^-1 coupling`` per millimetre.
    step : ndarray, shape (r,), scratch
    force : ndarray, shape (3,), out, mN
    tangent : ndarray, shape (3, 3), out, mN/mm
    """
    touching, folded = load.touching, load.folded
    count, nodes = touching.touched[0], load.corners.shape[1]
    sphere.reaction(touching, count, force)
    coupling[:] = 0.0
    # a tip that moves by dx does what nodes do that all move by -dx
    for c in range(count):
        for i in range(3):
            target = coupling[i]
            for a in range(nodes):
                row = folded[nodes * (3 * c + i) + a]
                for n in range(len(row)):
                    target[n] += row[n]
    for i in range(3):
        step[:] = coupling[i]
        back_substitute(factor, step)
        for j in range(3):
            tangent[j, i] = np.dot(coupling[j], step) - touching.own[j, i]


@njit(cache=True, error_model="numpy", nogil=True)
def distance(q, other):
    """Squared distance of a state from another, relative to its size."""
    size = total = 0.0
    for j in range(len(q)):
        size += q[j] * q[j]
        total += (q[j] - other[j]) ** 2
    return total / max(size, 1e-12)


by_type(recall, {Elastic: _recall_nothing, Viscous: _recall})
by_type(soften, {Elastic: _soften_nothing, Viscous: _soften})
by_type(soften_tangent, {Elastic: _soften_tangent_nothing, Viscous: _soften_tangent})
by_type(has_moved, {Elastic: _has_not_moved, Viscous: _has_moved})
by_type(note_past, {Elastic: _note_nothing, Viscous: _note_past})
by_type(push, {Dead: _push_dead, Contact: _push_contact})
by_type(stiffen, {Dead: _stiffen_dead, Contact: _stiffen_contact})
