"""From the bytes of a request to those of its answer: decode, solve, recover, encode.

The service's hot path. Nothing here awaits: an answer has the model for itself from its first line
to its last.
"""

import math
from time import perf_counter

import numpy as np
from starlette.responses import Response

from palpate.online.serve import wire
from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import PHASES, Metrics
from palpate.online.serve.negotiation import JSON
from palpate.online.serve.schemas import HistoryRequest, SolveRequest, parse_request
from palpate.online.serve.store import Model
from palpate.shared.answer import describe
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel, Solution
from palpate.shared.reduced.history import Moment

ABSURD = 10.0
"""Multiple of the largest trained pressure from which on there is no answer at all."""


def answer(
    model: Model, body: bytes, media_type: str, max_json_numbers: int, metrics: Metrics
) -> Response:
    """Solve a request from rest and write the answer.

    Each request is answered on its own: the same request has the same answer, whatever came
    before it. Sessions are for clients that want a warm start.

    Raises
    ------
    Refusal
        If the request is malformed, the load is not one the model can be asked about, or it has
        no equilibrium.
    """
    received = perf_counter()
    request = parse_request(body)
    atlas = model.atlas
    contact = request.contacts[0]
    if media_type == JSON:
        check_size(atlas, request, max_json_numbers)
    if contact.pressure > ABSURD * atlas.pressure_max:
        raise Refusal(
            "unanswerable_query",
            "contacts.0.pressure",
            f"More than {ABSURD:g} times the {atlas.pressure_max:.3g} kPa of the training",
            {"le": ABSURD * atlas.pressure_max},
        )

    start = perf_counter()
    try:
        solution = atlas.solve(
            contact.position, contact.pressure, contact.direction, contact.radius
        )
    except QueryError as error:
        raise Refusal("unanswerable_query", f"contacts.0.{error.field}", error.message) from None
    solved = perf_counter()
    if not solution.converged:
        raise Refusal(
            "no_equilibrium",
            "contacts.0.pressure",
            "There is no equilibrium under this load; the model was trained for up to "
            f"{solution.pressure_limit:.3g} kPa there",
            {"le": solution.pressure_limit},
        )

    fields = recover(atlas, solution, request)
    recovered = perf_counter()

    head = describe(atlas.name, solution)
    _check_finite(solution, fields)
    head["timing"] = {
        "solve_us": 1e6 * (solved - start),
        "recover_us": 1e6 * (recovered - solved),
    }
    content = wire.encode(media_type, head, fields)
    encoded = perf_counter()
    borders = (received, start, solved, recovered, encoded)
    metrics.count_query(borders, solution.in_range)
    timing = ", ".join(
        f"{phase};dur={1e3 * (end - begin):.4f}"
        for phase, begin, end in zip(PHASES, borders, borders[1:], strict=False)
    )
    return Response(content, media_type=media_type, headers={"server-timing": timing})


def check_size(atlas: ReducedModel, request: SolveRequest | HistoryRequest, limit: int) -> None:
    """Refuse fields that would keep the event loop busy writing decimals."""
    nodes = {"none": 0, "surface": len(atlas.surface_nodes), "all": len(atlas.nodes)}
    per_node = 3 * ("displacement" in request.outputs) + ("von_mises" in request.outputs)
    numbers = per_node * nodes[request.region]
    if numbers > limit:
        raise Refusal(
            "too_large_for_json",
            "region",
            f"{numbers} numbers are too many for JSON; accept application/octet-stream instead",
            {"max_numbers": limit},
        )


def recover(
    atlas: ReducedModel, answer: Solution | Moment, request: SolveRequest | HistoryRequest
) -> wire.Arrays:
    """Fields that a request wants of an answer."""
    fields = {}
    if request.region != "none":
        displacement = atlas.displacement(answer)
        if "displacement" in request.outputs:
            nodes = atlas.surface_nodes if request.region == "surface" else slice(None)
            fields["displacement"] = displacement[nodes]
        if "von_mises" in request.outputs:
            fields["von_mises"] = atlas.von_mises(answer, request.region, displacement)
    return fields


def _check_finite(solution: Solution, fields: wire.Arrays) -> None:
    """Let no NaN and no infinity out, whatever the model thinks of itself."""
    scalars = (
        solution.force.sum()
        + solution.contact_displacement.sum()
        + solution.error_displacement
        + solution.error_von_mises
        + solution.min_jacobian
    )
    if not (math.isfinite(scalars) and all(np.isfinite(f).all() for f in fields.values())):
        raise Refusal(
            "no_equilibrium", "contacts.0.pressure", "The answer to this load is not finite"
        )
