"""Who may: the setting `tokens` applied to requests and WebSockets."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from server.auth import WEBSOCKET_PREFIX, AuthError, ForbiddenError, Right, bearer, websocket_subprotocol
from server.routes.dependencies import ServiceDep
from server.routes.problems import Problem
from server.service import Service

_READING = ("GET", "HEAD", "OPTIONS")


class Access:
    """What the client of one request or WebSocket may do."""

    def __init__(self, connection: HTTPConnection, service: Service) -> None:
        self._tokens = service.tokens
        self.subprotocol = websocket_subprotocol(connection.scope.get("subprotocols", ()))
        named = self.subprotocol.removeprefix(WEBSOCKET_PREFIX) if self.subprotocol else None
        self._token = bearer(connection.headers.get("authorization")) or named

    def require(self, right: Right, stream: str | None) -> None:
        """Raises Problem 401 or 403."""
        try:
            self._tokens.check(self._token, right, stream)
        except AuthError as error:
            raise Problem(HTTPStatus.UNAUTHORIZED, str(error), headers={"WWW-Authenticate": "Bearer"}) from None
        except ForbiddenError as error:
            raise Problem(HTTPStatus.FORBIDDEN, str(error)) from None

    def has(self, right: Right, stream: str | None) -> bool:
        try:
            self._tokens.check(self._token, right, stream)
        except PermissionError:
            return False
        return True


def _access(connection: HTTPConnection, service: ServiceDep) -> Access:
    return Access(connection, service)


AccessDep = Annotated[Access, Depends(_access)]


def check_access(connection: HTTPConnection, access: AccessDep) -> None:
    """For whole routers: reading and WebSockets need the right to view the stream in the path, all else to control it."""
    reading = connection.scope["type"] == "websocket" or connection.scope["method"] in _READING
    access.require(Right.VIEW if reading else Right.CONTROL, connection.path_params.get("stream"))


def check_view(connection: HTTPConnection, access: AccessDep) -> None:
    access.require(Right.VIEW, connection.path_params.get("stream"))
