"""Time-limited TURN credentials (draft-uberti-behave-turn-rest), as coturn takes them with `use-auth-secret`."""

from __future__ import annotations

import base64
import hmac
import secrets
import time


def turn_credentials(secret: str, ttl_s: int, now: float | None = None) -> tuple[str, str]:
    """A user name that says when it expires, and the password that the TURN server derives from it by the shared secret."""
    expiry = int(time.time() if now is None else now) + ttl_s
    username = f"{expiry}:{secrets.token_hex(8)}"       # random, so that one viewer's traffic cannot be told by another's name
    return username, base64.b64encode(hmac.digest(secret.encode(), username.encode(), "sha1")).decode()
