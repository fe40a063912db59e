"""What a running service and its viewer say about themselves, again and again."""

from __future__ import annotations

import time
from collections.abc import Mapping

from server.demo.calls import request
from server.demo.children import Child
from server.demo.report import Sample
from server.demo.watch import SAMPLE_EVERY_S, DemoError, NewestLine, Watch


def sampled(watch: Watch, base: str, seconds: float, viewer: NewestLine, children: Mapping[str, Child]) -> list[Sample]:
    """Two or more samples of the stream `live` over so many seconds, with the processor time of the children by these names.

    Raises DemoError when the worker gives no statistics.
    """
    end = time.monotonic() + seconds
    samples = []
    while time.monotonic() < end:
        stats = request("GET", f"{base}/api/streams/live/stats")
        cpu_seconds = {"worker": float(stats.get("cpu_seconds", 0)),
                       **{name: child.cpu_seconds() for name, child in children.items()}}
        if "frames_encoded" in stats:       # missing while a worker is being replaced
            samples.append(Sample(time.monotonic(), stats, viewer.value, cpu_seconds))
        watch.pause(SAMPLE_EVERY_S)
    if len(samples) < 2:
        raise DemoError("the worker gave no statistics")
    return samples
