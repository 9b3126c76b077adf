"""Fields of an answer at all nodes: displacement and von Mises stress."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.shared.answer import Answer
from palpate.shared.arrays import Array, Field, Ints, Numbers
from palpate.shared.geometry.elements import kind_of
from palpate.shared.local_models import Body, LocalModels
from palpate.shared.mechanics.tensors import SYMMETRIC
from palpate.shared.reduced.points import expand
from palpate.shared.reduced.transfer import Transfer
from palpate.shared.stress_field import Peaks, StressField


class Composition(NamedTuple):
    """What a displacement is made of at some nodes: states of local models and the tip's dent."""

    models: Ints  # (m,) numbers of local models
    states: Field  # (m, r) in their modes, times weights
    dented: Ints  # (d,) nodes, by their places among those asked for
    dent: Field  # (d, 3) mm, what no mode holds


class FieldRecovery:
    """Recovers fields from the states of local models; not to be shared between threads.

    Parameters
    ----------
    body : Body
    models : LocalModels
    transfer : callable
        Gives what knows the past.
    """

    def __init__(self, body: Body, models: LocalModels, transfer: Callable[[], Transfer]) -> None:
        self._body = body
        self._models = models
        self._transfer = transfer
        self._stress = StressField(body, np.float32)

    def coefficients(self, answer: Answer) -> dict[int, Field]:
        """Displacement as coefficients (M,) in the basis of each region that takes part."""
        return self._by_region(self._parts(answer))

    def _parts(self, answer: Answer) -> Sequence[tuple[int, float, Array]]:
        """Local models, weights and states that the displacement is the sum of."""
        if answer.past is None:
            return answer.parts
        return self._transfer().displacements(answer.time, answer.active)

    def _by_region(self, parts: Sequence[tuple[int, float, Array]]) -> dict[int, Field]:
        """Coefficients of states of local models."""
        modes = self._models.modes
        total: dict[int, Field] = {}
        for k, weight, q in parts:
            region = int(self._models.region[k])
            share = modes[k] @ (weight * q).astype(np.float32)
            total[region] = total[region] + share if region in total else share
        return total

    def _field(self, coefficients: Mapping[int, Field]) -> Field:
        models, field = self._models, np.zeros((len(self._body.nodes), 3), np.float32)
        far = np.zeros(len(models.body_steps), np.float32)
        for number, part in coefficients.items():
            nodes, basis = models.window(number)
            near = np.zeros(basis.shape[1], np.float32)
            expand(basis, models.steps[number] * part, near)
            field[nodes] += near.reshape(-1, 3)
            far += part @ models.far[number]
        expand(models.body, models.body_steps * far, field.reshape(-1))
        return field

    def modes(self, number: int, nodes: Numbers) -> Field:
        """Modes (k, r, 3) mm of a local model at nodes (k,)."""
        models, region = self._models, int(self._models.region[number])
        part, r = models.modes[number], models.modes.shape[2]
        window, basis = models.window(region)
        where = np.full(len(self._body.nodes), -1)
        where[window] = np.arange(len(window))
        inside = where[nodes] >= 0
        found = _at(models.body, nodes).T @ (
            models.body_steps[:, None] * (models.far[region].T @ part)
        )
        near = _at(basis, where[nodes][inside]).T @ (models.steps[region][:, None] * part)
        found = found.reshape(len(nodes), 3, r)
        found[inside] += near.reshape(inside.sum(), 3, r)
        return np.ascontiguousarray(found.transpose(0, 2, 1))

    def composition(self, answer: Answer, nodes: Numbers) -> Composition:
        """What the displacement of an answer is made of at nodes (k,)."""
        states: dict[int, Array] = {}
        for k, weight, q in self._parts(answer):
            states[k] = states.get(k, 0.0) + weight * q
        dent = self._stress.dent(self._body.nodes[nodes], answer.footprint)
        modes = self._models.modes.shape[2]
        return Composition(
            np.array([*states], np.int32),
            np.array([*states.values()], np.float32).reshape(-1, modes),
            dent.points.astype(np.int32),
            dent.displacement.astype(np.float32),
        )

    def of_mesh(self, answer: Answer) -> Field:
        """Nodal displacement (n, 3) mm without the dent of a tip."""
        return self._field(self.coefficients(answer))

    def displacement(self, answer: Answer) -> Field:
        """Nodal displacement (n, 3) mm."""
        displacement = self.of_mesh(answer)
        self._stress.add_dent(displacement, answer.footprint)
        return displacement

    def von_mises(self, answer: Answer, displacement: Field) -> Field:
        """Nodal von Mises stress (n,) kPa of an answer with this displacement of all nodes."""
        stress = self._stress.von_mises(displacement, self._remembered(answer), answer.footprint)
        # an answer that did not converge may be beyond single precision
        with np.errstate(over="ignore"):
            return (answer.stiffness * stress).astype(np.float32)

    def peaks_by_region(self, answer: Answer, displacement: Field) -> list[Peaks]:
        """Of an answer, kPa; see ``StressField``."""
        past, contact = self._remembered(answer), answer.footprint
        found = self._stress.peaks_by_region(displacement, past, contact)
        return [(answer.stiffness * most, answer.stiffness * high) for most, high in found]

    def _remembered(self, answer: Answer) -> Array | None:
        """``B`` of ``mechanics.viscosity`` (e, 6, q) at the points of all elements, of a past."""
        if answer.past is None:
            return None
        transfer = self._transfer()
        B = np.zeros((len(self._body.elements), SYMMETRIC, kind_of(self._body.elements).points))
        for k, share, knot in transfer.knots(answer.active):
            u = self._field(self._by_region([(k, 1.0, knot)]))
            self._stress.remember(u, share, B)
        lasting = transfer.lasting(answer.time, answer.active)
        if lasting:
            self._stress.remember(self._field(self._by_region(lasting)), None, B)
        return B


def _at(modes: NDArray[Any], nodes: NDArray[Any]) -> Field:
    """Columns (M, 3 k) of modes (M, 3 n) that belong to nodes (k,)."""
    at = modes.reshape(len(modes), modes.shape[1] // 3, 3)[:, nodes]
    return at.reshape(len(modes), 3 * len(nodes)).astype(np.float32)
