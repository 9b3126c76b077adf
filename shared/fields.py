"""Fields of an answer at all nodes: displacement and von Mises stress."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from palpate.shared.answer import Answer
from palpate.shared.arrays import Array, Field
from palpate.shared.local_models import Body, LocalModels
from palpate.shared.reduced.points import expand
from palpate.shared.reduced.transfer import Transfer
from palpate.shared.stress_field import StressField


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
        if answer.past is None:
            return self._by_region(answer.parts)
        return self._by_region(self._transfer().displacements(answer.time, answer.active))

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
            return stress.astype(np.float32)

    def peaks(self, answer: Answer, displacement: Field) -> tuple[float, float]:
        """Largest stress and 99th percentile (kPa) of an answer; see ``StressField.peaks``."""
        return self._stress.peaks(displacement, self._remembered(answer), answer.footprint)

    def _remembered(self, answer: Answer) -> Array | None:
        """``B`` of ``mechanics.viscosity`` (e, 6, 8) at the points of all elements, of a past."""
        if answer.past is None:
            return None
        transfer = self._transfer()
        B = np.zeros((len(self._body.elements), 6, 8))
        for k, share, knot in transfer.knots(answer.active):
            u = self._field(self._by_region([(k, 1.0, knot)]))
            self._stress.remember(u, share, B)
        lasting = transfer.lasting(answer.time, answer.active)
        if lasting:
            self._stress.remember(self._field(self._by_region(lasting)), None, B)
        return B
