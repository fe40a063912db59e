"""Every error answer is RFC 9457 problem JSON that names the offending value."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match, Route

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
MAX_VALUE_LENGTH = 120
MAX_ERRORS = 20


class Problem(HTTPException):
    """An error answer. `detail` says which value is wrong and what was expected."""

    def __init__(self, status: int, detail: str, *, headers: Mapping[str, str] | None = None, **members: Any) -> None:
        super().__init__(status, detail, dict(headers) if headers else None)
        self.members = members


def problem_response(status: int, detail: str, *, headers: Mapping[str, str] | None = None, **members: Any) -> Response:
    body = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": status, "detail": detail, **members}
    # ASCII only: the offending value may hold a lone surrogate, which UTF-8 cannot carry.
    return Response(json.dumps(body, ensure_ascii=True, allow_nan=False), status, headers, MEDIA_TYPE)


def shown(value: Any) -> str:
    """The value as it stands in a message, cut to a readable length."""
    text = repr(value)
    return text if len(text) <= MAX_VALUE_LENGTH else text[:MAX_VALUE_LENGTH] + "…"


def validation_problem(errors: Sequence[Any]) -> Response:
    """422 for pydantic's list of errors."""
    described = [describe_error(error) for error in errors[:MAX_ERRORS]]
    detail = described[0]["detail"] if described else "the request is invalid"
    return problem_response(HTTPStatus.UNPROCESSABLE_ENTITY, detail, errors=described)


def describe_error(error: Mapping[str, Any]) -> dict[str, str]:
    location = [str(part) for part in error["loc"]]
    if location and location[0] in ("body", "query", "path", "header"):
        location = location[1:]
    where = ".".join(location) or "body"
    cause = error.get("ctx", {}).get("error")
    if error["type"] == "missing":
        detail = f"{where} is missing"
    elif error["type"] == "extra_forbidden":
        detail = f"{where} is an unknown key"
    elif isinstance(cause, ValueError):
        detail = f"{where}: {cause}"
    else:
        detail = f"{where} is {shown(error.get('input'))}: {error['msg'][:1].lower()}{error['msg'][1:]}"
    return {"pointer": "/" + "/".join(location), "detail": detail}


async def _http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    members = error.members if isinstance(error, Problem) else {}
    detail = error.detail
    if not isinstance(error, Problem):
        detail = {
            HTTPStatus.NOT_FOUND: f"no resource {request.url.path!r}",
            HTTPStatus.METHOD_NOT_ALLOWED: f"{request.method} is not allowed on {request.url.path!r}",
        }.get(HTTPStatus(error.status_code), detail)
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        headers["Allow"] = ", ".join(sorted(_methods(request)))
    return problem_response(error.status_code, detail, headers=headers, **members)


def _methods(request: Request) -> set[str]:
    """Of every route with this path; Starlette tells those of the first one only."""
    return {method for route in request.app.state.routes
            if isinstance(route, Route) and route.matches(request.scope)[0] != Match.NONE for method in route.methods or ()}


async def _validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError | ValidationError)
    return validation_problem(error.errors())


async def _unexpected(request: Request, error: Exception) -> Response:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, "the request failed inside the service, its log says why")


def install(app: FastAPI) -> None:
    app.add_exception_handler(HTTPException, _http_exception)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(ValidationError, _validation_error)
    app.add_exception_handler(Exception, _unexpected)
