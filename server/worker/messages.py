"""The two-way protocol between the server and a stream's worker.

One Unix socket pair carries both directions. A message is a JSON object with a `type`, followed by an optional binary
payload (an H.264 access unit, a JPEG). On the wire: two little-endian uint32 (JSON length, payload length), the JSON in
UTF-8, the payload. No pickle: a worker decodes hostile bitstreams, so the server must not trust what it sends.

Down, server to worker: `start` (first, once), `scene`, `source`, `demand`, `keyframe`, `bitrate`, `snapshot`, `stop`.
Up, worker to server: `ready`, `fatal`, `state`, `packet`, `lights`, `stats` (also the heartbeat), `snapshot`.
ARCHITECTURE.md has the fields.
"""

from __future__ import annotations

import asyncio
import json
import socket
import struct
from typing import Any

HEADER = struct.Struct("<II")
MAX_JSON_BYTES = 16 << 20
MAX_PAYLOAD_BYTES = 64 << 20

Message = dict[str, Any]


class ProtocolError(ValueError):
    """The peer sent bytes that are no message."""


def encode_message(message: Message, payload: bytes = b"") -> bytes:
    body = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
    return HEADER.pack(len(body), len(payload)) + body + payload


def _lengths(header: bytes) -> tuple[int, int]:
    body_length, payload_length = HEADER.unpack(header)
    if body_length > MAX_JSON_BYTES or payload_length > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"message of {body_length}+{payload_length} bytes, expected at most "
                            f"{MAX_JSON_BYTES}+{MAX_PAYLOAD_BYTES}")
    return body_length, payload_length


def _decode_body(body: bytes) -> Message:
    try:
        message = json.loads(body)
    except ValueError as error:
        raise ProtocolError(f"message is not JSON: {error}") from None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ProtocolError("message is not an object with a string `type`")
    return message


async def read_message(reader: asyncio.StreamReader) -> tuple[Message, bytes]:
    """Read one message. Raises asyncio.IncompleteReadError at the end of the stream, ProtocolError on garbage."""
    body_length, payload_length = _lengths(await reader.readexactly(HEADER.size))
    message = _decode_body(await reader.readexactly(body_length))
    return message, await reader.readexactly(payload_length)


def receive_message(connection: socket.socket) -> tuple[Message, bytes]:
    """Blocking twin of `read_message`. Raises EOFError when the peer has closed."""
    body_length, payload_length = _lengths(_receive_exactly(connection, HEADER.size))
    message = _decode_body(_receive_exactly(connection, body_length))
    return message, _receive_exactly(connection, payload_length)


def _receive_exactly(connection: socket.socket, length: int) -> bytes:
    buffer = bytearray(length)
    view = memoryview(buffer)
    while view:
        count = connection.recv_into(view)
        if count == 0:
            raise EOFError("the peer closed the connection")
        view = view[count:]
    return bytes(buffer)
