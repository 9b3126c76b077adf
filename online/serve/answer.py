"""From a request to the bytes of its answer: solve, recover, encode.

The service's hot path. Nothing here awaits: an answer has the model for itself from its first line
to its last; the number of steps of a history bounds how long others wait.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
from starlette.responses import Response

from palpate.online.serve import wire
from palpate.online.serve.errors import Refusal, check_json_size
from palpate.online.serve.metrics import PHASES, Metrics
from palpate.online.serve.schemas import Contact, HistoryRequest, SolveRequest
from palpate.online.serve.wire import JSON
from palpate.shared.answer import Answer, describe
from palpate.shared.arrays import Field
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST


def answer(
    model: ReducedModel,
    request: SolveRequest | HistoryRequest,
    media_type: str,
    metrics: Metrics,
    received: float = 0.0,
    max_json_numbers: float = math.inf,
) -> Response:
    """Solve a request from rest, whose decoding began when it was `received`; write the answer.

    The same request has the same answer, whatever came before it. Sessions are for clients that
    want a warm start. Raises `Refusal` if a load is not one the model can be asked about, or it has
    no equilibrium; or if a history is asked of elastic tissue.
    """
    if media_type == JSON:
        nodes = {"none": 0, "surface": len(model.surface_nodes), "all": len(model.nodes)}
        check_json_size(request.outputs, nodes[request.region], max_json_numbers, "region")
    start = perf_counter()
    if isinstance(request, HistoryRequest):
        answers = _follow(model, request)
    else:
        answers = [_press(model, request.contacts[0], "contacts.0", young=request.young)]
    solved = perf_counter()
    fields, more = _recover(model, answers[-1], request)
    recovered = perf_counter()
    steps = [describe(answer) for answer in answers]
    steps[-1] |= more
    told = {"steps": steps} if isinstance(request, HistoryRequest) else steps[0]
    timing = {"solve_us": 1e6 * (solved - start), "recover_us": 1e6 * (recovered - solved)}
    head = {"scene": model.name, **told, "timing": timing}
    content = wire.encode(media_type, head, fields)
    borders = (received, start, solved, recovered, perf_counter())
    metrics.count_query(borders, all(answer.in_range for answer in answers))
    durations = (1e3 * (end - begin) for begin, end in pairwise(borders))
    phases = ", ".join(f"{p};dur={ms:.4f}" for p, ms in zip(PHASES, durations, strict=True))
    return Response(content, media_type=media_type, headers={"server-timing": phases})


def _follow(model: ReducedModel, request: HistoryRequest) -> list[Answer]:
    """Answer loads over time, step by step."""
    if not model.scene.tissue.prony:
        raise Refusal("no_time", "name", "The tissue of this scene is elastic; ask it to solve")
    warm, now, answers = model.new_warm(), 0.0, [Answer(past=REST)]
    for number, step in enumerate(request.steps):
        more = {"young": request.young, "past": answers[-1].past, "dt": step.time - now}
        contact = f"steps.{number}.contact"
        answers.append(_press(model, step.contact, contact, warm=warm, **more))
        now = step.time
    return answers[1:]


def _press(model: ReducedModel, contact: Contact | None, path: str, **more: Any) -> Answer:
    """Answer a load that the request has at `path`, at once or, with `more`, after a past."""
    with _refused(path):
        found = model.press(**_load(contact), **more)
    if not found.converged:
        limit = found.pressure_limit
        message = (
            "There is no equilibrium under this load; the model was trained for up to "
            f"{limit:.3g} kPa there"
        )
        raise Refusal("no_equilibrium", f"{path}.pressure", message, {"le": limit})
    if not math.isfinite(found.force.sum() + found.contact_displacement.sum() + found.min_jacobian):
        raise Refusal("no_equilibrium", f"{path}.pressure", "The answer to this load is not finite")
    return found


def checked(model: ReducedModel, request: SolveRequest) -> tuple[float, tuple[str, ...]]:
    """Largest trained pressure (kPa) for a load that could be solved, and what is out of range."""
    with _refused("contacts.0"):
        return model.check(**_load(request.contacts[0]), young=request.young)


def _load(contact: Contact | None) -> dict[str, Any]:
    """What a model is asked for a contact, or its absence."""
    return {"position": None, "pressure": 0.0} if contact is None else dict(contact)


@contextmanager
def _refused(path: str) -> Iterator[None]:
    """Refuse what a model cannot be asked, by its place in the request."""
    try:
        yield
    except QueryError as error:
        raise Refusal("unanswerable_query", f"{path}.{error.field}", error.message) from None


def _finite(found: Mapping[str, Any] | float) -> bool:
    """Whether all numbers of a document are."""
    return all(map(_finite, found.values())) if isinstance(found, Mapping) else math.isfinite(found)


def _recover(
    model: ReducedModel, answer: Answer, request: SolveRequest | HistoryRequest
) -> tuple[wire.Arrays, Mapping[str, Any]]:
    """Get the fields that a request wants, and the ``peak`` if it wants that; all is finite."""
    fields: dict[str, Field] = {}
    more: dict[str, dict[str, Any]] = {}
    region = request.region
    if region != "none" or "peak" in request.outputs:
        displacement = model.displacement(answer)
    if "peak" in request.outputs:
        more["peak"] = model.peak(answer, displacement)
    if region != "none":
        if "displacement" in request.outputs:
            nodes = model.surface_nodes if region == "surface" else slice(None)
            fields["displacement"] = displacement[nodes]
        if "von_mises" in request.outputs:
            fields["von_mises"] = model.von_mises(answer, region, displacement)
    if not (_finite(more) and all(np.isfinite(field).all() for field in fields.values())):
        raise Refusal("no_equilibrium", "region", "The fields of this answer are not finite")
    return fields, more
