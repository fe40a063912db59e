"""The floor under every service of this kind: the stream decoded and encoded again, with nothing done to the picture.

`python -m server.bench.service_transcode URL` has the worker's threads, decoder settings, encoder and bitrate. It runs until
SIGINT or SIGTERM and writes one JSON object a line on stdout: `{"frames_in", "frames_encoded", "frames_dropped", "bytes",
"cpu_seconds", "time"}`, all since the start, `time` the monotonic clock in seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import threading
import time
from typing import Any

from server.worker.encode import Composited, EncodeThread, full_plan
from server.worker.ingest import Ingest
from server.worker.newest import Newest
from server.worker.output_clock import CLOCK_RATE
from server.worker.picture import PictureReader, output_size
from server.worker.source import Decoded, SourceInfo

# The worker's own, whose modules would bring GL along and with it memory that a transcode does not need.
SWITCH_INTERVAL_S = 0.0005
BURST_S = 0.04
HEARTBEAT_S = 0.5

class Transcoder:
    """Ingest and encode threads, and between them the main thread, as in a worker."""

    def __init__(self, url: str) -> None:
        self.frames: Newest[Decoded] = Newest(BURST_S)
        self._bytes = 0
        self._index = 0
        self._reader: PictureReader | None = None
        self._fps = 30.0
        self._encode = EncodeThread(self._on_packet, plan=lambda size: full_plan(size, self._fps))
        self._ingest = Ingest(url, allow_files=False, frames=self.frames, on_state=self._on_state)

    def run(self, stop: threading.Event) -> None:
        """Report twice a second until `stop`. Raises what the encode thread died of, ValueError for a picture that is not 4:2:0."""
        due = time.monotonic() + HEARTBEAT_S
        while not stop.is_set():
            decoded = self.frames.take(timeout=0.1)
            if decoded is not None:
                self._pass_on(decoded)
            if self._encode.error is not None:
                raise self._encode.error
            if time.monotonic() >= due:
                print(json.dumps(self.progress()), flush=True)
                due += HEARTBEAT_S

    def progress(self) -> dict[str, Any]:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return {"frames_in": self._ingest.frames_in, "frames_encoded": self._encode.statistics.frames_encoded,
                "frames_dropped": self.frames.dropped + self._encode.pictures.dropped, "bytes": self._bytes,
                "cpu_seconds": usage.ru_utime + usage.ru_stime, "time": time.monotonic()}

    def _pass_on(self, decoded: Decoded) -> None:
        frame = decoded.frame
        if frame.format.name != "yuv420p":
            raise ValueError(f"pixel format is {frame.format.name!r}, expected yuv420p")
        self._reader = self._reader or PictureReader(output_size(frame.width, frame.height))
        picture = self._reader.read(frame)
        self._index += 1
        timestamp = round((decoded.pts or 0.0) * CLOCK_RATE)
        self._encode.pictures.put(Composited(picture, frame, self._index, timestamp, decoded.decoded_at, 0.0))

    def _on_state(self, state: str, detail: str | None, info: SourceInfo | None) -> None:
        if info is not None:
            self._fps = info.fps

    def _on_packet(self, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        self._bytes += len(payload)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.service_transcode", description="decode and encode, nothing else")
    parser.add_argument("url", help="what to pull, e.g. rtmp-listen://127.0.0.1:1935/live/camera")
    url = parser.parse_args().url
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        Transcoder(url).run(stop)
    except (ValueError, OSError) as error:
        print(f"transcode: {error}", file=sys.stderr, flush=True)
        return 2
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)    # the ingest thread may sit in a read that only its time limit ends
