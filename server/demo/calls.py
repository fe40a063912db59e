"""Calls of the service's REST API on this machine, and free ports for it."""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from typing import Any

from server.demo.watch import DemoError

HOST = "127.0.0.1"
CALL_WITHIN_S = 5.0
UPLOAD_WITHIN_S = 60.0


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
        return True


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def stream(base: str) -> dict[str, Any]:
    found: dict[str, Any] = request("GET", f"{base}/api/streams/live")
    return found


def is_ready(base: str) -> bool:
    """Raises DemoError when it never will be."""
    try:
        found = stream(base)
    except DemoError:
        return False        # not listening yet
    if found["state"] == "failed":
        raise DemoError(found["detail"])
    return bool(found["worker"]["ready"])


def request(method: str, url: str, body: Any = None) -> Any:
    """The JSON of the answer. Raises DemoError."""
    data = None if body is None else json.dumps(body).encode()
    return _answer(urllib.request.Request(url, data, {"Content-Type": "application/json"}, method=method), CALL_WITHIN_S)


def upload(base: str, name: str, model: bytes) -> dict[str, Any]:
    """Store a GLB as asset `name`; what the service found in it. Raises DemoError."""
    sent = urllib.request.Request(f"{base}/api/assets?name={name}", model, {"Content-Type": "model/gltf-binary"}, method="POST")
    found: dict[str, Any] = _answer(sent, UPLOAD_WITHIN_S)
    return found


def _answer(sent: urllib.request.Request, within_s: float) -> Any:
    try:
        with urllib.request.urlopen(sent, timeout=within_s) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        with error:
            raise DemoError(f"{sent.method} {sent.full_url} answered {error.code}: {error.read(500).decode()}") from None
    except (OSError, ValueError) as error:
        raise DemoError(f"{sent.method} {sent.full_url} failed: {error}") from None
