"""The process of an output that FFmpeg writes: RTMP, RTSP, a recording."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from pathlib import Path
from typing import Protocol

import av

from server.outputs.beginning import Beginning
from server.outputs.muxing import Muxing
from server.outputs.networks import check_network
from server.outputs.recording import Recording
from server.outputs.server_link import OutputFailedError, Pulse, ServerLink, failed_message
from server.outputs.sound import CopiedOpus, EncodedAac
from server.worker.messages import Message, ProtocolError

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOENT, errno.EEXIST, errno.ENOTDIR)


class _Sink(Protocol):
    @property
    def name(self) -> str | None: ...

    def write_picture(self, message: Message, access_unit: bytes) -> bool: ...

    def write_sound(self, timestamp: int, opus: bytes) -> None: ...

    def note(self, message: Message) -> None: ...

    def close(self) -> None: ...

    def discard_empty(self) -> None: ...


class _Push:
    """To a media server."""

    name = None

    def __init__(self, start: Message, beginning: Beginning) -> None:
        self._beginning = beginning
        rtmp = start["kind"] == "rtmp"
        # Without flush_packets the end of a frame waits in a buffer for the next frame.
        options = {"flvflags": "no_duration_filesize", "flush_packets": "1"} if rtmp else {"rtsp_transport": "tcp"}
        make_sound = (EncodedAac if rtmp else CopiedOpus) if start["sound"] else None
        self._muxing = Muxing(start["url"], "flv" if rtmp else "rtsp", options, make_sound, sets_in_band=not rtmp)

    def write_picture(self, message: Message, access_unit: bytes) -> bool:
        """Returns whether the picture has gone out."""
        keyframe = bool(message["keyframe"])
        if not self._muxing.opened:
            self._muxing.open(access_unit)
            self._beginning.opened()
        if not self._muxing.begun and not self._beginning.reached_by(float(message["decoded_at"]), keyframe=keyframe):
            return False
        self._muxing.write_picture(int(message["timestamp"]), access_unit, keyframe=keyframe)
        return True

    def write_sound(self, timestamp: int, opus: bytes) -> None:
        self._beginning.sound_came()
        self._muxing.write_sound(timestamp, opus)

    def note(self, message: Message) -> None:
        """Scenes and the source's state have no place in a push."""

    def close(self) -> None:
        self._muxing.close()

    def discard_empty(self) -> None:
        """A push leaves nothing behind."""


def mux(start: Message, connection: socket.socket) -> None:
    """Until the server says `stop` or goes away, or the output fails, of which the server is told. Then the process ends."""
    av.logging.set_level(av.logging.ERROR)      # so that errors say what the peer said; nothing is printed
    link = ServerLink(connection)
    pulse = Pulse(link)
    sink: _Sink | None = None
    failure: OutputFailedError | None = None
    try:
        _check_network(start)
        sink = _open(start, link)
        link.send({"type": "ready"})
        failure = _write_all(link, pulse, sink)
        with pulse.writing():
            sink.close()
    except OutputFailedError as error:
        failure = error
    except (av.error.FFmpegError, OSError, ValueError) as error:
        hopeless = start["kind"] == "record" and getattr(error, "errno", None) in DISK_ERRORS
        failure = OutputFailedError(_reason(error), hopeless=hopeless)
    if sink is not None:
        sink.discard_empty()
    pulse.report()
    if failure is not None:
        link.send(failed_message(failure))
    os._exit(0)     # or the container would be closed once more, on a connection that may take nothing


def _check_network(start: Message) -> None:
    """Raises OutputFailedError. FFmpeg's muxers follow no redirections: what is checked is where they go."""
    if start["url"] is not None:
        # Not asyncio.run: its end waits for a resolver that does not answer.
        asyncio.new_event_loop().run_until_complete(check_network(start["url"], start["networks"]))


def _open(start: Message, link: ServerLink) -> _Sink:
    beginning = Beginning(lambda: link.send({"type": "keyframe"}), sound=bool(start["sound"]))
    if start["kind"] == "record":
        return Recording(Path(start["folder"]), start["prefix"], start["stream"], beginning, sound=bool(start["sound"]))
    return _Push(start, beginning)


def _write_all(link: ServerLink, pulse: Pulse, sink: _Sink) -> OutputFailedError | None:
    """Until the end. Returns what has become impossible, if it was that; what was written until then is whole."""
    live = False
    while True:
        try:
            message, payload = link.receive()
        except (EOFError, ProtocolError):
            return None
        try:
            match message["type"]:
                case "picture":
                    with pulse.writing():
                        written = sink.write_picture(message, payload)
                    pulse.frames += written
                    pulse.bytes += len(payload) if written else 0
                    if written and not live:
                        live = True
                        link.send({"type": "live", "detail": sink.name})
                case "sound":
                    with pulse.writing():
                        sink.write_sound(int(message["timestamp"]), payload)
                    pulse.bytes += len(payload) if live else 0
                case "scene" | "source":
                    sink.note(message)
                case "stop":
                    return None
        except OutputFailedError as error:
            return error


def _reason(error: Exception) -> str:
    reason = str(getattr(error, "strerror", None) or error).lower()
    log = getattr(error, "log", None)       # of FFmpeg: (level, who, what)
    return f"{reason} ({str(log[2]).strip()})" if log else reason
