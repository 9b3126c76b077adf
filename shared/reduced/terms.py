"""Loads of a local model as terms of its potential; see ``reduced.problem``."""

from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field, Numbers
from palpate.shared.compiled import methods
from palpate.shared.mechanics import sphere
from palpate.shared.reduced.points import FAST, back_substitute, distance


@methods()
class Dead(NamedTuple):
    """A load that does not follow the tissue."""

    f: Array  # (r,) mN times mode

    def push(self, q, residual):
        """Subtract the load from the residual; return its potential."""
        energy = 0.0
        for i in range(len(q)):
            residual[i] -= self.f[i]
            energy -= self.f[i] * q[i]
        return energy

    def stiffen(self, q, shift, tangent):
        """It has no stiffness."""


class ContactWork(NamedTuple):
    """Working memory of the contact of a tip with f faces of k nodes."""

    moved: Annotated[Array, "nodes, 3"]  # mm, of the surface; only the model's are written
    own: Annotated[Array, "3 k f, r"]  # modes at the nodes of touching faces
    folded: Annotated[Array, "3 k f, r"]  # the faces' stiffnesses times these
    square: Annotated[Array, "3 k, 3 k"]  # a face's stiffness
    product: Annotated[Array, "r, r"]
    touching: sphere.Touching
    latest: Annotated[Array, "r"]  # state that ``touching`` is of


@methods()
class Contact(NamedTuple):
    """The rigid tip on the nodes of the surface near a local model."""

    tip: sphere.Tip
    surface: sphere.TipSurface
    x: Array  # (3,) mm, centre of the tip
    nodes: Numbers  # (s,) of the surface
    modes: Field  # (s, 3, r) mm
    faces: Numbers  # (t,) of the surface
    corners: Numbers  # (t, k) their nodes, counted from the model's first
    work: ContactWork

    def push(self, q, residual):
        """Subtract the tip's force from the residual; return its potential."""
        count, energy, _ = form_contact(self, q, sphere.STIFFNESS)
        touching = self.work.touching
        for c in range(count):
            own, force = self.corners[touching.face[c]], touching.force[c]
            for k in range(len(own)):
                for i in range(3):
                    row, f = self.modes[own[k], i], force[k, i]
                    for j in range(len(q)):
                        residual[j] -= f * row[j]
        return energy

    def stiffen(self, q, shift, tangent):
        """Add the stiffness of all touching faces at q; its convex part where that is shifted.

        It exceeds the tissue's by many orders of magnitude, so single precision would not do.
        ``reaction`` uses what is left in ``folded``.
        """
        work, rows = self.work, 3 * self.corners.shape[1]
        if shift > 0.0:
            form_contact(self, q, sphere.CONVEX)
            work.latest[:] = np.inf
        elif distance(q, work.latest) > 0.0:
            form_contact(self, q, sphere.STIFFNESS)
        count = work.touching.touched[0]
        for c in range(count):
            own = work.own[rows * c : rows * (c + 1)]
            _place_face(self, c, own)
            np.dot(work.square, own, work.folded[rows * c : rows * (c + 1)])
        if count > 0:
            np.dot(work.own[: rows * count].T, work.folded[: rows * count], work.product)
            tangent[:] += work.product


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
    work = load.work
    _move(load.nodes, load.modes, q, work.moved)
    work.latest[:] = q
    return sphere.touch(
        load.tip, load.surface, load.faces, load.x, work.moved, work.touching, wanted
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _place_face(load, c, own):
    """A touching face's stiffness to ``work.square``, and the modes (3 k, r) at its nodes."""
    touching, square = load.work.touching, load.work.square
    K, corners = touching.stiffness[c], load.corners[touching.face[c]]
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
def reaction(load, factor, coupling, slope, force, tangent):
    """Force on the tool and its derivative in an equilibrium whose tangent is factorised.

    Parameters
    ----------
    load : Contact
    factor : ndarray, shape (r, r)
    coupling : ndarray, shape (3, r), out, mN/mm
        Minus the derivative of the residual in the tip's place.
    slope : ndarray, shape (3, r), out, 1/mm
        Of the answer in the tip's place: ``tangent^-1 coupling``.
    force : ndarray, shape (3,), out, mN
    tangent : ndarray, shape (3, 3), out, mN/mm
    """
    touching, folded, nodes = load.work.touching, load.work.folded, load.corners.shape[1]
    coupling[:] = force[:] = 0.0
    for c in range(touching.touched[0]):
        for i in range(3):
            # a tip that moves by dx does what nodes do that all move by -dx
            target = coupling[i]
            for a in range(nodes):
                force[i] -= touching.force[c, a, i]
                row = folded[nodes * (3 * c + i) + a]
                for n in range(len(row)):
                    target[n] += row[n]
    for i in range(3):
        slope[i] = coupling[i]
        back_substitute(factor, slope[i])
        for j in range(3):
            tangent[j, i] = np.dot(coupling[j], slope[i]) - touching.own[j, i]
