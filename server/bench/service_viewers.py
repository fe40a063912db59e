"""Any number of WHEP viewers in one process, which receive and decode nothing.

`python -m server.bench.service_viewers URL COUNT` runs until SIGINT or SIGTERM and writes one JSON object a line on stdout:
`{"viewers", "frames", "bytes", "slowest", "keyframes", "width", "height", "time"}`: how many receive, what they have received
together, the frames and keyframes of the one that has fewest, 0 for a size that nobody knows, and the monotonic clock in
seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
import time
from typing import Any

from aiortc.codecs.base import Decoder
from aiortc.jitterbuffer import JitterFrame
from av.frame import Frame

from server.delivery.aiortc_hooks import decode_with
from server.demo.keyframe_decoder import is_keyframe
from server.demo.viewer import REPORT_EVERY_S, Viewer, ViewerError


class _Counter(Decoder):
    """Of one viewer, in place of a decoder."""

    def __init__(self) -> None:
        self.units = self.keyframes = self.bytes = 0

    def decode(self, encoded_frame: JitterFrame) -> list[Frame]:
        self.units += 1
        self.keyframes += is_keyframe(encoded_frame.data)
        self.bytes += len(encoded_frame.data)
        return []


class _Counters:
    """One for each viewer that has received something."""

    def __init__(self, viewers: int) -> None:
        self._viewers = viewers
        self._counters: list[_Counter] = []

    def make(self, _codec: object) -> _Counter:
        self._counters.append(_Counter())
        return self._counters[-1]

    def progress(self) -> dict[str, Any]:
        counters = list(self._counters)
        all_receive = len(counters) == self._viewers
        return {"frames": sum(one.units for one in counters), "bytes": sum(one.bytes for one in counters),
                "slowest": min(one.units for one in counters) if all_receive else 0,
                "keyframes": min(one.keyframes for one in counters) if all_receive else 0,
                "viewers": len(counters), "width": 0, "height": 0, "time": time.monotonic()}


async def watch(url: str, count: int) -> None:
    """View `url` so many times at once and report on stdout until a signal comes. Raises ViewerError."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    counters = _Counters(count)
    decode_with(counters.make)
    viewers = [Viewer(url) for _ in range(count)]
    try:
        for viewer in viewers:
            await viewer.start()
        while not stop.is_set():
            print(json.dumps(counters.progress()), flush=True)
            for viewer in viewers:
                viewer.check()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), REPORT_EVERY_S)
    finally:
        await asyncio.gather(*(viewer.stop() for viewer in viewers))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.service_viewers", description="WHEP viewers without a screen")
    parser.add_argument("url", help="http://HOST:PORT/whep/STREAM")
    parser.add_argument("count", type=int, help="how many")
    arguments = parser.parse_args()
    try:
        asyncio.run(watch(arguments.url, arguments.count))
    except ViewerError as error:
        print(f"viewers: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
