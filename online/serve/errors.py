"""Everything the service can refuse: one table from code to status, one shape of body.

``{"error": {"code", "field", "message", "allowed"}}`` — `field` is the path of what is wrong in the
request, such as ``contacts.0.pressure``, and `allowed` what would be right, where that can be said
in a few words. No input is echoed, so a NaN sent is never a NaN returned.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from palpate.shared.errors import PalpateError

STATUS = {
    "unauthorized": 401,
    "foreign_origin": 403,
    "unknown_scene": 404,
    "no_tip": 404,
    "no_time": 404,
    "unknown_snapshot": 404,
    "not_found": 404,
    "method_not_allowed": 405,
    "not_acceptable": 406,
    "body_too_large": 413,
    "unsupported_media_type": 415,
    "foreign_host": 421,
    "upgrade_required": 426,
    "invalid_json": 422,
    "invalid_value": 422,
    "unanswerable_query": 422,
    "no_equilibrium": 422,
    "too_large_for_json": 422,
    "too_many_requests": 429,
    "internal": 500,
    "overloaded": 503,
    "not_ready": 503,
    "too_many_sessions": 503,
}


class Refusal(PalpateError):
    """A request that gets no answer.

    Parameters
    ----------
    code : str
        A key of `STATUS`.
    field : str
        Path of what is wrong in the request.
    message : str
        What is wrong with it.
    allowed : JSON-able, optional
        What would be right.
    headers : mapping from str to str, optional
        Headers of the response, such as ``Retry-After``.
    """

    def __init__(
        self,
        code: str,
        field: str,
        message: str,
        allowed: Any = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.field = field
        self.message = message
        self.allowed = allowed
        self.headers = headers

    def response(self) -> Response:
        """Make the HTTP response that says so."""
        error = {
            "code": self.code,
            "field": self.field,
            "message": self.message,
            "allowed": self.allowed,
        }
        return Response(
            orjson.dumps({"error": error}), STATUS[self.code], self.headers, "application/json"
        )


def invalid(details: Sequence[Any], names: Mapping[str, Sequence[str]] | None = None) -> Refusal:
    """Make the refusal of a request that pydantic complained about.

    Parameters
    ----------
    details : sequence of pydantic error details
        Their locations start at the body's top.
    names : mapping from table to keys, optional
        The valid keys of the body (``""``) and of its tables (``"contacts"``).
    """
    # A misspelt key also leaves its right name missing; the misspelling is the news.
    first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
    path = [str(part) for part in first["loc"]]
    field = ".".join(path) or "body"
    if first["type"] == "json_invalid":
        return Refusal("invalid_json", "body", first["msg"])
    context = {key: value for key, value in first.get("ctx", {}).items() if key != "error"}
    allowed: Any = context or None
    if first["type"] == "extra_forbidden" and names is not None:
        allowed = names[path[0] if len(path) > 1 else ""]
    return Refusal("invalid_value", field, first["msg"], allowed)


def _refuse(request: Request, refusal: Refusal) -> Response:
    """Count a refusal and answer with it."""
    request.app.state.metrics.count_refusal(refusal.code)
    return refusal.response()


async def _refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return _refuse(request, error)


async def _parameters(request: Request, error: Exception) -> Response:
    """Answer wrong path and query parameters, all that FastAPI checks here."""
    assert isinstance(error, RequestValidationError)
    details = [{**detail, "loc": detail["loc"][1:]} for detail in error.errors()]
    return _refuse(request, invalid(details))


async def _http(request: Request, error: Exception) -> Response:
    """Answer what the router refuses before any endpoint is found."""
    assert isinstance(error, HTTPException)
    if error.status_code == 405:
        methods = Headers(error.headers).get("allow", "").split(", ")
        return _refuse(
            request,
            Refusal(
                "method_not_allowed",
                "method",
                "Not a method of this path",
                methods,
                error.headers,
            ),
        )
    return _refuse(
        request, Refusal("not_found", "path", "There is nothing at this path; see /docs")
    )


async def _gone(request: Request, error: Exception) -> Response:
    """Let a client go that hung up before its request was whole; nobody reads this."""
    return Response(status_code=400)


async def _bug(request: Request, error: Exception) -> Response:
    """Answer anything else without details; it is raised on to the server, which logs it."""
    return _refuse(request, Refusal("internal", "", "The service failed; its log says why"))


def install(app: FastAPI) -> None:
    """Make `app` answer every error in the one shape, and count it in ``app.state.metrics``."""
    app.add_exception_handler(Refusal, _refusal)
    app.add_exception_handler(RequestValidationError, _parameters)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(ClientDisconnect, _gone)
    app.add_exception_handler(Exception, _bug)
