"""JSON request bodies: bounded, of a JSON media type, without NaN and Infinity."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine
from http import HTTPStatus
from typing import Any, NoReturn

from fastapi import Request, Response
from fastapi.routing import APIRoute

from server.routes.content_negotiation import media_type
from server.routes.problems import Problem, shown

MAX_BODY_BYTES = 2 << 20


async def read_body(request: Request, limit: int) -> bytes:
    """The whole body. Raises Problem 413 as soon as it is longer than `limit` bytes."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > limit:
            raise Problem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body is longer than {limit} bytes")
    return bytes(body)


def parse_json(text: bytes | str) -> Any:
    """Parse strict JSON. Raises ValueError, also for NaN, Infinity and nesting that is too deep."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("the nesting is too deep") from None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON value")


class _StrictRequest(Request):
    async def body(self) -> bytes:
        if not hasattr(self, "_body"):
            self._body = await read_body(self, MAX_BODY_BYTES)
        return self._body

    async def json(self) -> Any:
        try:
            return parse_json(await self.body())
        except ValueError as error:
            raise Problem(HTTPStatus.BAD_REQUEST, f"the body is no JSON: {str(error).lower()}") from None


class StrictJsonRoute(APIRoute):
    """A route whose JSON body, if it declares one, is read strictly.

    Requiring the media type is also what keeps a foreign page's plain form from reaching the API: it forces the
    browser to ask first (CORS preflight).
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        takes_body = self.body_field is not None

        async def handle_strictly(request: Request) -> Response:
            kind = media_type(request)
            if takes_body and kind != "application/json" and not kind.endswith("+json"):
                raise Problem(HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
                              f"content-type is {shown(kind)}, expected application/json")
            return await handle(_StrictRequest(request.scope, request.receive))

        return handle_strictly
