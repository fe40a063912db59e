"""A recording: fragmented MP4 that plays up to its last fragment whatever happens, and beside it the log of its scene.

The log is JSON lines. The first has `stream`, `file`, `start` (UTC), `clock` and `geometry`; then comes one for each revision of
the scene, with the whole scene and the `time` in seconds of the first picture that shows it, and one for each change of the
source's state, with the time since the start at which it came.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from server.outputs.beginning import Beginning
from server.outputs.muxing import CLOCK_RATE, Muxing
from server.outputs.sound import EncodedAac
from server.worker.messages import Message
from server.worker.spherical import with_spherical_metadata

# No index at the end: its offsets would be those from before the movie header grew.
MOVFLAGS = "frag_keyframe+empty_moov+default_base_moof+skip_trailer"
MAX_HEADER_BYTES = 1 << 20
NAMES_TRIED = 100


class Recording:
    """Both files. The film is opened by the first keyframe; raises OSError when the disk refuses."""

    def __init__(self, folder: Path, prefix: str, stream: str, beginning: Beginning, *, sound: bool) -> None:
        self._folder, self._prefix, self._stream = folder, prefix, stream
        self._beginning = beginning
        self._has_sound = sound
        self._muxing: Muxing | None = None
        self._file: _SphericalFile | None = None
        self._log: _SceneLog | None = None
        self._next_scene: Any = None
        self._shown_revision = -1

    @property
    def name(self) -> str | None:
        """Of the MP4, once there is one."""
        return self._file.path.name if self._file is not None else None

    def write_picture(self, message: Message, access_unit: bytes) -> bool:
        """Returns whether the picture is in the file."""
        timestamp, revision, keyframe = int(message["timestamp"]), int(message["revision"]), bool(message["keyframe"])
        decoded_at = float(message["decoded_at"])
        muxing = self._muxing or self._open(access_unit)
        if not muxing.begun and not self._beginning.reached_by(decoded_at, keyframe=keyframe):
            return False
        seconds = muxing.write_picture(timestamp, access_unit, keyframe=keyframe)
        log = self._log or self._begin_log(muxing, timestamp, max(0.0, time.monotonic() - decoded_at))
        if revision != self._shown_revision:
            self._shown_revision = revision
            log.write({"time": round(seconds, 6), "revision": revision, "scene": self._next_scene})
        return True

    def write_sound(self, timestamp: int, opus: bytes) -> None:
        self._beginning.sound_came()
        if self._muxing is not None:
            self._muxing.write_sound(timestamp, opus)

    def note(self, message: Message) -> None:
        """A scene, which is that of the picture that comes next, or a change of the source's state."""
        if message["type"] == "scene":
            self._next_scene = message["scene"]
        elif self._log is not None:
            self._log.write({"time": round(self._log.elapsed_s, 3), "source": message["state"], "detail": message["detail"]})

    def close(self) -> None:
        try:
            if self._muxing is not None:
                self._muxing.close()
        finally:
            for file in (self._file, self._log):
                if file is not None:
                    file.close()

    def discard_empty(self) -> None:
        """Remove a film without pictures: on a full disk each try would leave one behind."""
        if self._file is not None and self._file.empty:
            with contextlib.suppress(OSError):
                self._file.path.unlink()
                _log_path(self._file.path).unlink(missing_ok=True)

    def _open(self, keyframe: bytes) -> Muxing:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file = _SphericalFile(_new_file(self._folder, self._prefix))
        self._muxing = Muxing(self._file, "mp4", {"movflags": MOVFLAGS, "flush_packets": "1"},
                              EncodedAac if self._has_sound else None, sets_in_band=False)
        self._muxing.open(keyframe)
        self._beginning.opened()
        return self._muxing

    def _begin_log(self, muxing: Muxing, timestamp: int, age_s: float) -> _SceneLog:
        assert self._file is not None
        width, height = muxing.size
        self._log = log = _SceneLog(_log_path(self._file.path), age_s)
        log.write({
            "stream": self._stream, "file": self._file.path.name, "start": log.start.isoformat(timespec="milliseconds"),
            "clock": {"rate": CLOCK_RATE, "origin": timestamp},
            "geometry": {"width": width, "height": height, "projection": "equirectangular"}})
        return log


class _SceneLog:
    """Written line by line, each at once."""

    def __init__(self, path: Path, age_s: float) -> None:
        """`age_s`: how long ago the first picture was taken."""
        self.start = datetime.fromtimestamp(time.time() - age_s, UTC)
        self._started_at = time.monotonic() - age_s
        self._file = path.open("x", encoding="utf-8", buffering=1)

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._started_at

    def write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n")

    def close(self) -> None:
        self._file.close()


class _SphericalFile:
    """A file for FFmpeg to write to, unbuffered. The movie header gets its spherical metadata on the way."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._header: bytearray | None = bytearray()
        self.empty = True       # but for the movie header

    def write(self, data: bytes) -> int:
        if self._header is None:
            self._write_all(data)
            self.empty = False
        else:
            self._header += data
            grown = with_spherical_metadata(bytes(self._header))
            if grown is None and len(self._header) > MAX_HEADER_BYTES:
                raise OSError("no movie header at the beginning of the recording")
            if grown is not None:
                self._header = None
                self._write_all(grown)
        return len(data)

    def _write_all(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self._fd, view):]

    def close(self) -> None:
        os.close(self._fd)


def _log_path(film: Path) -> Path:
    return film.with_suffix(".scene.jsonl")


def _new_file(folder: Path, prefix: str) -> Path:
    """A path in the folder at which nothing is yet: recordings are never overwritten."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    for number in range(NAMES_TRIED):
        path = folder / f"{prefix}-{stamp}{f'-{number}' if number else ''}.mp4"
        if not path.exists() and not _log_path(path).exists():
            return path
    raise FileExistsError(errno.EEXIST, f"{NAMES_TRIED} recordings of this second exist")
