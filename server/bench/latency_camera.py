"""A camera with a time code in its picture, over RTMP.

`python -m server.bench.latency_camera CLIP URL` plays the first seconds of a clip forwards and backwards in real time, draws the
code (`server.demo.time_code`) at the moment a frame goes to the encoder, and writes a JSON object a second on stdout: `{"frames",
"encode_ms", "late_ms"}`: frames so far, the milliseconds from time code to the hand-over to RTMP, and those after its time at which
the newest frame was taken. It runs until SIGINT or SIGTERM.
"""

from __future__ import annotations

import argparse
import itertools
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.frame import PictureType, VideoFrame
from numpy.typing import NDArray

from server.demo import time_code

CLIP_S = 2.0
KEYFRAME_INTERVAL_S = 1.0
REPORT_EVERY_S = 1.0


def publish(clip: Path, url: str, bitrate_bps: int, stop: threading.Event) -> None:
    """Until `stop`. Raises av.FFmpegError when the server is lost."""
    frames, rate = _frames(clip)
    with av.open(url, "w", format="flv", options={"flush_packets": "1"}) as output:
        encoder = output.add_stream("libx264", rate=rate, options={
            "preset": "ultrafast", "tune": "zerolatency", "g": str(round(KEYFRAME_INTERVAL_S * rate)), "sc_threshold": "0",
            "maxrate": str(bitrate_bps), "bufsize": str(bitrate_bps // 4)})
        encoder.width, encoder.height, encoder.pix_fmt = frames[0].width, frames[0].height, "yuv420p"
        encoder.bit_rate, encoder.thread_count = bitrate_bps, 1
        started = reported = time.monotonic()
        encode_ms: list[float] = []
        for number, frame in enumerate(_back_and_forth(frames)):
            due = started + number / rate
            if stop.wait(max(due - time.monotonic(), 0.0)):
                return
            frame.pts, frame.time_base, frame.pict_type = number, 1 / rate, PictureType.NONE
            taken = time.monotonic()
            time_code.draw(_luma(frame), time.time())
            for packet in encoder.encode(frame):
                output.mux(packet)
            encode_ms.append(1e3 * (time.monotonic() - taken))
            if taken - reported >= REPORT_EVERY_S:
                reported = taken
                late_ms = 1e3 * (taken - due)
                print(json.dumps({"frames": number + 1, "encode_ms": encode_ms, "late_ms": round(late_ms, 2)}), flush=True)
                encode_ms = []


def _frames(clip: Path) -> tuple[list[VideoFrame], Fraction]:
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        rate = stream.average_rate or Fraction(30)
        return list(itertools.islice(container.decode(stream), round(CLIP_S * rate))), rate


def _back_and_forth(frames: list[VideoFrame]) -> Iterator[VideoFrame]:
    return itertools.cycle([*frames, *frames[-2:0:-1]])


def _luma(frame: VideoFrame) -> NDArray[np.uint8]:
    plane: Any = frame.planes[0]
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.latency_camera", description="a camera with a time code")
    parser.add_argument("clip", type=Path)
    parser.add_argument("url", help="rtmp://HOST:PORT/APPLICATION/KEY")
    parser.add_argument("--bitrate", type=int, default=20_000_000, help="bit/s, default 20000000")
    arguments = parser.parse_args()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        publish(arguments.clip, arguments.url, arguments.bitrate, stop)
    except OSError as error:
        print(f"camera: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
