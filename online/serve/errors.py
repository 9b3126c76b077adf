"""Everything the service can refuse. No input is echoed: a NaN sent is never a NaN returned."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import orjson
from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from palpate.online.session.frames import FrameError
from palpate.shared.errors import PalpateError

_CODES = {
    401: "unauthorized",
    403: "foreign_origin",
    404: "unknown_scene unknown_artifact unknown_model no_tip no_time unknown_snapshot not_found",
    405: "method_not_allowed",
    406: "not_acceptable",
    413: "body_too_large",
    414: "url_too_long",
    415: "unsupported_media_type",
    421: "foreign_host",
    422: "invalid_json invalid_value unanswerable_query no_equilibrium too_large_for_json",
    426: "upgrade_required",
    429: "too_many_requests",
    431: "headers_too_large",
    500: "internal",
    503: "overloaded not_ready too_many_sessions",
}
STATUS = {code: status for status, codes in _CODES.items() for code in codes.split()}
"""HTTP status of every code of a refusal."""


@dataclass(eq=False)
class Refusal(PalpateError):
    """A request that gets no answer.

    `code` is a key of `STATUS`; `field` the path of what is wrong in the request, such as
    ``contacts.0.pressure``; `allowed` what would be right, where that is short.
    """

    code: str
    field: str
    message: str
    allowed: Any = None
    headers: Mapping[str, str] | None = None

    def __str__(self) -> str:
        return self.message

    def body(self) -> bytes:
        """Write the JSON that says so."""
        names = "code", "field", "message", "allowed"
        return orjson.dumps({"error": {name: getattr(self, name) for name in names}})

    def response(self) -> Response:
        """Make the HTTP response that says so."""
        return Response(self.body(), STATUS[self.code], self.headers, "application/json")


def check_json_size(outputs: Collection[str], nodes: int, limit: float, field: str) -> None:
    """Refuse fields that would keep the event loop busy with writing decimals."""
    numbers = nodes * (3 * ("displacement" in outputs) + ("von_mises" in outputs))
    check_numbers(numbers, limit, field)


def check_numbers(numbers: int, limit: float, field: str) -> None:
    """Refuse so many numbers in JSON."""
    if numbers > limit:
        message = f"{numbers} numbers are too many for JSON; ask for a binary format instead"
        raise Refusal("too_large_for_json", field, message, {"max_numbers": limit})


def invalid(details: Sequence[Any], names: Mapping[str, Sequence[str]] | None = None) -> Refusal:
    """Make the refusal of a request that pydantic complained about.

    The locations of its `details` start at the body's top; `names` are the valid keys of the body
    (``""``) and of its tables (``"contacts"``).
    """
    # a misspelt key also leaves its right name missing; the misspelling comes first
    first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
    path, kind, message = [str(part) for part in first["loc"]], first["type"], first["msg"]
    if kind == "json_invalid":
        return Refusal("invalid_json", "body", message)
    if kind == "extra_forbidden" and names is not None:
        allowed: Any = names[path[0] if len(path) > 1 else ""]
    else:
        allowed = {k: v for k, v in first.get("ctx", {}).items() if k != "error"} or None
    return Refusal("invalid_value", ".".join(path) or "body", message, allowed)


def as_refusal(error: Exception) -> Refusal:
    """Say in the one shape what stopped a request or a message of a session."""
    match error:
        case Refusal():
            return error
        case FrameError(field=field):
            code = "unknown_version" if field == "version" else "invalid_frame"
            return Refusal(code, field, error.message)
        case RequestValidationError():  # path and query parameters, all that FastAPI checks here
            return invalid([{**detail, "loc": detail["loc"][1:]} for detail in error.errors()])
        case HTTPException(status_code=405):
            methods = Headers(error.headers).get("allow", "").split(", ")
            message = "Not a method of this path"
            return Refusal("method_not_allowed", "method", message, methods, error.headers)
        case HTTPException():
            return Refusal("not_found", "path", "There is nothing at this path; see /docs")
        case _:  # without details, which are for the log
            return Refusal("internal", "", "The service failed; its log says why")


async def refuse(request: Request, error: Exception) -> Response:
    """Count a refusal and answer with it; errors of our own also go on to the server's log."""
    if isinstance(error, ClientDisconnect):
        return Response(status_code=400)  # nobody is there to read it
    refusal = as_refusal(error)
    request.app.state.service.metrics.count("refusals_total", refusal.code)
    return refusal.response()


KINDS = (Refusal, RequestValidationError, HTTPException, ClientDisconnect, Exception)
"""Errors that `refuse` answers: all."""
