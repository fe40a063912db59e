"""Any number of WHEP viewers in one process, which receive and decode nothing.

`python -m server.bench.viewers_process URL COUNT` runs until SIGINT or SIGTERM and writes one JSON object a line on stdout, twice a
second: what `Audience.progress` says. SIGUSR1 begins the churn: so many guests come and go, one after the other.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
import time
from collections import Counter
from typing import Any

import uvloop

from server.bench.viewers_rtp import RtpCount
from server.bench.viewers_tap import Tap
from server.demo.viewer import REPORT_EVERY_S, Viewer, ViewerError

JOIN_EVERY_S = 0.1          # so that no two joins share a keyframe by chance, and forty still come within seconds
JOIN_WITHIN_S = 15.0
GUEST_STAYS_S, GUEST_PAUSE_S = 0.5, 0.2
SUMMED = ("frames", "incomplete", "undecodable", "packets", "lost", "late", "retransmitted", "bytes", "gaps")


class Counted:
    """One viewer with its counters."""

    def __init__(self, url: str, epoch: float, fps: float) -> None:
        self.count = RtpCount(epoch, fps)
        self._viewer = Viewer(url)
        self._tap: Tap | None = None
        self._began_at = 0.0

    async def start(self) -> None:
        """Make the session. Raises ViewerError."""
        self._began_at = time.monotonic()
        await self._viewer.start()
        peer = self._viewer.peer
        self._tap = Tap(peer.getTransceivers()[0].receiver, peer.remoteDescription.sdp, self.count)

    @property
    def join_ms(self) -> float | None:
        """From the wish to watch to the first whole keyframe."""
        at = self.count.first_keyframe_at
        return None if at is None else 1e3 * (at - self._began_at)

    def check(self) -> None:
        """Raises ViewerError when nothing can come any more."""
        self._viewer.check()

    async def stop(self) -> None:
        if self._tap is not None:
            self._tap.close()
        await self._viewer.stop()


class Audience:
    """So many viewers of `url` who stay, and the guests of the churn."""

    def __init__(self, url: str, count: int, guests: int, fps: float) -> None:
        self._url, self._guests, self._fps, self._epoch = url, guests, fps, time.time()
        self._staying = [self._viewer() for _ in range(count)]
        self._guest_joins_ms: list[float] = []
        self._churn: asyncio.Task[None] | None = None

    def _viewer(self) -> Counted:
        return Counted(self._url, self._epoch, self._fps)

    async def start(self) -> None:
        """Have them join one after the other. Raises ViewerError."""
        for viewer in self._staying:
            await viewer.start()
            await asyncio.sleep(JOIN_EVERY_S)

    def churn(self) -> None:
        if self._churn is None:
            self._churn = asyncio.create_task(self._come_and_go())

    def check(self) -> None:
        """Raises ViewerError when a viewer, or a guest, cannot watch."""
        for viewer in self._staying:
            viewer.check()
        if self._churn is not None and self._churn.done():
            self._churn.result()

    async def stop(self) -> None:
        if self._churn is not None:
            self._churn.cancel()
            await asyncio.gather(self._churn, return_exceptions=True)
        await asyncio.gather(*(viewer.stop() for viewer in self._staying))

    async def _come_and_go(self) -> None:
        for _ in range(self._guests):
            guest = self._viewer()
            try:
                await guest.start()
                end = time.monotonic() + JOIN_WITHIN_S
                while guest.join_ms is None:
                    if time.monotonic() > end:
                        raise ViewerError(f"a guest had no picture in {JOIN_WITHIN_S:g} s")
                    await asyncio.sleep(0.02)
                self._guest_joins_ms.append(guest.join_ms)
                await asyncio.sleep(GUEST_STAYS_S)
            finally:
                await guest.stop()
            await asyncio.sleep(GUEST_PAUSE_S)

    def progress(self) -> dict[str, Any]:
        """Of those who stay, together: the counters of RtpCount; `slowest` and `keyframes`, the frames and keyframes of the one
        that has fewest; `by_viewer`, the frames of each; `joins_ms`; `delays_ms`, what a frame's completion is behind its RTP
        time, where 0 is `epoch` (seconds of the system's clock), in whole milliseconds, with how often each;
        `sender_reports_ms`, what the sender says of that. `viewers` receive, `guests_joins_ms` are the guests' so far, `churned`
        says that the last one has gone, and `time` is the monotonic clock in seconds."""
        counts = [viewer.count for viewer in self._staying]
        delays: Counter[int] = Counter()
        for count in counts:
            delays.update(count.delays_ms)
        return {**{name: sum(getattr(count, name) for count in counts) for name in SUMMED},
                "slowest": min(count.frames for count in counts), "keyframes": min(count.keyframes for count in counts),
                "by_viewer": [count.frames for count in counts],
                "viewers": sum(count.frames > 0 for count in counts),
                "longest_gap_ms": round(1e3 * max(count.longest_gap_s for count in counts), 1),
                "joins_ms": [round(viewer.join_ms, 1) for viewer in self._staying if viewer.join_ms is not None],
                "guests_joins_ms": [round(join, 1) for join in self._guest_joins_ms],
                "churned": self._churn is not None and self._churn.done(),
                "sender_reports_ms": [round(report, 1) for count in counts for report in count.sender_reports_ms],
                "delays_ms": dict(delays), "epoch": self._epoch, "width": 0, "height": 0, "time": time.monotonic()}


async def watch(url: str, count: int, guests: int, fps: float) -> None:
    """View `url` so many times at once and report on stdout until a signal comes. Raises ViewerError."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    audience = Audience(url, count, guests, fps)
    loop.add_signal_handler(signal.SIGUSR1, audience.churn)
    joining = asyncio.create_task(audience.start())
    try:
        while not stop.is_set():
            if joining.done():
                joining.result()
            print(json.dumps(audience.progress()), flush=True)
            audience.check()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), REPORT_EVERY_S)
    finally:
        joining.cancel()
        await asyncio.gather(joining, return_exceptions=True)
        await audience.stop()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.viewers_process", description="WHEP viewers without a screen")
    parser.add_argument("url", help="http://HOST:PORT/whep/STREAM")
    parser.add_argument("count", type=int, help="how many")
    parser.add_argument("--guests", type=int, default=0, help="who come and go after SIGUSR1, default 0")
    parser.add_argument("--fps", type=float, default=30.0, help="of the stream, by which a pause is called a gap; default 30")
    arguments = parser.parse_args()
    try:
        uvloop.run(watch(arguments.url, arguments.count, arguments.guests, arguments.fps))
    except ViewerError as error:
        print(f"viewers: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
