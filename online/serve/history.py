"""A history of visco-elastic tissue in one request, answered step by step.

Like ``serve.answer``, nothing here awaits; the number of steps bounds how long others wait.
"""

import math
from time import perf_counter

import numpy as np
from starlette.responses import Response

from palpate.online.serve import wire
from palpate.online.serve.answer import ABSURD, check_size, recover
from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.negotiation import JSON
from palpate.online.serve.schemas import HistoryRequest, Step, parse_history
from palpate.online.serve.store import Model
from palpate.shared.answer import describe_moment
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.history import History, Moment


def answer_history(
    model: Model, body: bytes, media_type: str, max_json_numbers: int, metrics: Metrics
) -> Response:
    """Follow a history from rest; fields, if asked for, are those of its end.

    Raises
    ------
    Refusal
        If the request is malformed, the tissue is elastic, a load is not one the model can be asked
        about, or it has no equilibrium.
    """
    received = perf_counter()
    atlas = model.atlas
    request = parse_history(body)
    if not atlas.scene.tissue.prony:
        raise Refusal("no_time", "name", "The tissue of this scene is elastic; ask it to solve")
    if media_type == JSON:
        check_size(atlas, request, max_json_numbers)
    start = perf_counter()
    history, now, moments = History(), 0.0, []
    for number, step in enumerate(request.steps):
        moment, history = _step(atlas, history, step, step.time - now, f"steps.{number}")
        now = step.time
        moments.append(moment)
    solved = perf_counter()
    fields = _fields(atlas, moments[-1], request)
    recovered = perf_counter()
    head = {
        "scene": atlas.name,
        "steps": [describe_moment(moment) for moment in moments],
        "timing": {"solve_us": 1e6 * (solved - start), "recover_us": 1e6 * (recovered - solved)},
    }
    content = wire.encode(media_type, head, fields)
    borders = (received, start, solved, recovered, perf_counter())
    metrics.count_query(borders, all(moment.in_range for moment in moments))
    return Response(content, media_type=media_type)


def _step(
    atlas: ReducedModel, history: History, step: Step, dt: float, path: str
) -> tuple[Moment, History]:
    """One step, or the refusal that says which field of it is wrong."""
    contact = step.contact
    try:
        if contact is None:
            moment, history = atlas.step(history, dt)
        else:
            if contact.pressure > ABSURD * atlas.pressure_max:
                raise Refusal(
                    "unanswerable_query",
                    f"{path}.contact.pressure",
                    f"More than {ABSURD:g} times the {atlas.pressure_max:.3g} kPa of the training",
                    {"le": ABSURD * atlas.pressure_max},
                )
            moment, history = atlas.step(
                history, dt, contact.position, contact.pressure, contact.direction, contact.radius
            )
    except QueryError as error:
        raise Refusal(
            "unanswerable_query", f"{path}.contact.{error.field}", error.message
        ) from None
    scalars = moment.force.sum() + moment.contact_displacement.sum() + moment.min_jacobian
    if not (moment.converged and math.isfinite(scalars)):
        raise Refusal(
            "no_equilibrium",
            f"{path}.contact.pressure",
            "There is no equilibrium under this load after what was before; the model was trained "
            f"for up to {moment.pressure_limit:.3g} kPa there",
            {"le": moment.pressure_limit},
        )
    return moment, history


def _fields(atlas: ReducedModel, moment: Moment, request: HistoryRequest) -> wire.Arrays:
    """Fields at the end of the history."""
    fields = recover(atlas, moment, request)
    if not all(np.isfinite(field).all() for field in fields.values()):
        raise Refusal("no_equilibrium", "steps", "The answer to these loads is not finite")
    return fields
