"""Bearer tokens: who may do what with which stream. Without any configured token everybody may do everything."""

from __future__ import annotations

import hmac
import re
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, SecretStr, field_validator

WEBSOCKET_PREFIX = "bearer."    # of the subprotocol by which a browser's WebSocket names its token
# What a header, a WebSocket subprotocol and the fragment of a URL all carry as it is.
_TOKEN = r"[A-Za-z0-9._~-]{16,256}"


class Right(StrEnum):
    VIEW = "view"           # watch: WHEP, GET, WebSockets
    CONTROL = "control"     # change: every other REST method, transforms over the events' WebSocket


class Token(BaseModel):
    """One entry of the setting `tokens`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    token: SecretStr
    may: Annotated[tuple[Right, ...], Field(min_length=1)]
    streams: tuple[str, ...] | None = None
    """None: all of them, and what belongs to no stream."""

    @field_validator("token")
    @classmethod
    def _usable(cls, value: SecretStr) -> SecretStr:
        if not re.fullmatch(_TOKEN, value.get_secret_value()):
            raise ValueError("expected 16 to 256 letters, digits and . _ ~ -")
        return value

    def allows(self, right: Right, stream: str | None) -> bool:
        """`stream` None: what belongs to no stream. Whoever may see one stream may ask for the list of them."""
        if right not in self.may:
            return False
        return self.streams is None or stream in self.streams or (stream is None and right is Right.VIEW)


class AuthError(PermissionError):
    """The request names no token, or one that nobody has given out."""


class ForbiddenError(PermissionError):
    """The token may not do this."""


class Tokens:
    """Checks what a request says about itself against the setting `tokens`."""

    def __init__(self, tokens: Sequence[Token]) -> None:
        self._tokens = tuple(tokens)

    @property
    def required(self) -> bool:
        return bool(self._tokens)

    def check(self, given: str | None, right: Right, stream: str | None) -> None:
        """Raises AuthError, ForbiddenError."""
        if not self.required:
            return
        if given is None:
            raise AuthError("no token is given, expected the header Authorization: Bearer TOKEN")
        found = self._find(given)
        if found is None:
            raise AuthError("the token is unknown")
        if not found.allows(right, stream):
            where = f" stream {stream!r}" if stream is not None else ""
            raise ForbiddenError(f"the token may not {right.value}{where}")

    def _find(self, given: str) -> Token | None:
        found = None
        for token in self._tokens:     # all of them, however early one matches: time must not tell which
            if hmac.compare_digest(token.token.get_secret_value().encode(), given.encode(errors="replace")):
                found = token
        return found


def bearer(authorization: str | None) -> str | None:
    """The token of an Authorization header (RFC 6750 section 2.1), None for anything else."""
    scheme, _, token = (authorization or "").strip().partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None


def websocket_subprotocol(offered: Sequence[str]) -> str | None:
    """The one that names a token, `bearer.TOKEN`; the server has to accept it by that name."""
    return next((protocol for protocol in offered if protocol.startswith(WEBSOCKET_PREFIX)), None)
