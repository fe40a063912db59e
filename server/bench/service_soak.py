"""`make soak`: the memory of server and worker over minutes in which scene, methods and viewers change.

Every EDIT_EVERY_S something is edited; after a minute it begins again, so that all that is made once has been made in the first
minute, and samples that are a minute apart show the same. From then on memory must be flat, by its slope and by its growth from the
first minute measured to the last.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from server.bench.service_options import BAD_INPUT, Parser
from server.bench.service_processes import ProcessGoneError, memory_of
from server.bench.service_run import READY_WITHIN_S, Served, Show, start_service
from server.bench.service_scene import KNOT, KNOT_TRIANGLES, five_objects, knot_glb, objects_around
from server.demo.calls import request
from server.demo.children import Child, ChildError, Children
from server.demo.clip import demo_clip
from server.demo.watch import DemoError, NewestLine, StopError, Watch, signals_set

FAILED, INTERRUPTED = 1, 130
CYCLE_S, EDIT_EVERY_S, SAMPLE_EVERY_S = 60, 5, 10
# The slope tells a leak, the growth a step that stays. Arenas fill up for some minutes more: in the server by 8 MB in all,
# which is then flat for many viewers; the worker goes back and forth by a buffer of 30 MB.
MOST_MB_A_MINUTE = 2.0
MOST_GROWTH, MOST_GROWTH_MB = 0.05, 6.0     # from the second minute to the last: of the second's memory, and beside that


@dataclass(frozen=True)
class Sample:
    """Resident megabytes of both processes so many seconds after the start."""

    seconds: int
    worker_mb: float
    server_mb: float
    fps: float


@dataclass(frozen=True)
class Trend:
    """Of one process: the slope of its samples, and the means of the first and the last minute."""

    mb_a_minute: float
    first_mb: float
    last_mb: float

    @property
    def is_flat(self) -> bool:
        return self.mb_a_minute <= MOST_MB_A_MINUTE and self.last_mb <= self.first_mb * (1 + MOST_GROWTH) + MOST_GROWTH_MB


def trend(seconds: Sequence[float], megabytes: Sequence[float]) -> Trend:
    """Of samples every SAMPLE_EVERY_S over two minutes or more. All moments of the minute share one slope, each has a level of its
    own: what the edits of a minute do to the memory is no slope."""
    times, values = np.array(seconds) / 60, np.array(megabytes)
    along, up = times.copy(), values.copy()
    for moment in range(CYCLE_S // SAMPLE_EVERY_S):
        same = slice(moment, None, CYCLE_S // SAMPLE_EVERY_S)
        along[same] -= along[same].mean()
        up[same] -= up[same].mean()
    is_first, is_last = times < times[0] + 0.99, times > times[-1] - 0.99
    return Trend(round(float(along @ up / (along @ along)), 3), round(float(values[is_first].mean()), 1),
                 round(float(values[is_last].mean()), 1))


class _Edits:
    """One minute of edits, over and over."""

    def __init__(self, served: Served, children: Children, log: Path) -> None:
        self._stream = f"{served.base}/api/streams/live"
        self._viewer_url, self._children, self._log = f"{served.base}/whep/live", children, log
        self._guest: Child | None = None
        guest = objects_around(16)["objects"][0] | {"id": "guest"}
        edits: tuple[Callable[[], object], ...] = (
            partial(self._move, "teapot", 0.3), partial(self._call, "POST", "objects", guest), partial(self._move, "guest", 0.2),
            self._join, partial(self._preset, "paper"), partial(self._move, "knot", -0.2), partial(self._preset, "default"),
            self._leave, partial(self._call, "DELETE", "objects/guest"), partial(self._call, "PUT", "scene", objects_around(20)),
            partial(self._call, "PUT", "scene", five_objects()), partial(self._move, "box", 0.3))
        assert len(edits) * EDIT_EVERY_S == CYCLE_S
        self._cycle = itertools.cycle(edits)

    def next(self) -> None:
        """Raises DemoError."""
        next(self._cycle)()

    def _call(self, method: str, path: str, body: Any = None) -> Any:
        return request(method, f"{self._stream}/{path}", body)

    def _move(self, name: str, metres: float) -> None:
        x, y, z = self._call("GET", f"objects/{name}")["position"]
        self._call("PATCH", f"objects/{name}", {"position": [x + metres, y, z]})

    def _preset(self, name: str) -> None:
        self._call("PUT", "scene", self._call("GET", "scene") | {"lighting": {"preset": name}})

    def _join(self) -> None:
        self._guest = self._children.start("second viewer", "server.demo.viewer", self._viewer_url, log=self._log)

    def _leave(self) -> None:
        assert self._guest is not None
        self._children.stop(self._guest)


def soak(folder: Path, stop: threading.Event, clip: Path, minutes: float) -> Generator[Sample]:
    """Samples from the first picture on. Raises DemoError when the worker was replaced, ChildError, ProcessGoneError, StopError."""
    model, _ = knot_glb(KNOT_TRIANGLES)
    with Children() as children:
        watch = Watch(children, stop)
        served = start_service(children, watch, folder, Show(clip, five_objects(), {KNOT: model}), max_viewers=4)
        viewer = children.start("viewer", "server.demo.viewer", f"{served.base}/whep/live", piped=True, log=folder / "viewer.log")
        seen = NewestLine(viewer)
        watch.until("picture in the viewer", lambda: seen.value.get("keyframes", 0) > 0, READY_WITHIN_S)
        edits, started = _Edits(served, children, folder / "guest.log"), time.monotonic()
        for second in itertools.count(EDIT_EVERY_S, EDIT_EVERY_S):
            watch.pause(started + second - time.monotonic())
            started += max(0.0, time.monotonic() - started - second)    # a machine that stood still is not made up for in a burst
            if second % SAMPLE_EVERY_S == 0:
                yield _sample(served, second)
            if second >= minutes * 60:
                return
            edits.next()


def _sample(served: Served, second: int) -> Sample:
    stats = request("GET", f"{served.base}/api/streams/live/stats")
    if stats["worker_restarts"] or stats.get("scene_errors"):
        raise DemoError(f"the worker was replaced {stats['worker_restarts']} times; objects not drawn: {stats.get('scene_errors')}")
    return Sample(second, round(memory_of(served.worker()).now_mb, 1),
                  round(memory_of(served.service.pid).now_mb, 1), float(stats.get("fps", 0.0)))


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0 when memory is flat, 1 when it is not or something did not run, 2 for bad arguments, 130 after Ctrl-C."""
    options = _options(arguments)
    stop = threading.Event()
    try:
        clip = demo_clip(options.width, options.fps)
        with tempfile.TemporaryDirectory(prefix="mr360-soak-") as folder, signals_set(stop):
            return _run(options, clip, Path(folder), stop)
    except (StopError, KeyboardInterrupt):
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"soak: {error}", file=sys.stderr)
        return BAD_INPUT
    except (DemoError, ChildError, ProcessGoneError) as error:
        print(f"soak: {error}", file=sys.stderr)
        return FAILED


def _run(options: argparse.Namespace, clip: Path, folder: Path, stop: threading.Event) -> int:
    print(f"{options.minutes:g} minutes at {options.width}x{options.width // 2}, {options.fps} frames/s; resident MB", flush=True)
    print(f"{'seconds':>8}{'worker':>10}{'server':>10}{'frames/s':>10}", flush=True)
    samples = []
    with contextlib.closing(soak(folder, stop, clip, options.minutes)) as running:
        for sample in running:
            samples.append(sample)
            print(f"{sample.seconds:8.0f}{sample.worker_mb:10.1f}{sample.server_mb:10.1f}{sample.fps:10.1f}", flush=True)
    measured = [sample for sample in samples if sample.seconds >= CYCLE_S]
    trends = {name: trend([sample.seconds for sample in measured], [getattr(sample, f"{name}_mb") for sample in measured])
              for name in ("worker", "server")}
    for name, found in trends.items():
        print(f"{name}: {found.mb_a_minute:+.2f} MB a minute after the first (bound {MOST_MB_A_MINUTE:g}), "
              f"{found.first_mb:.1f} MB in the second minute, {found.last_mb:.1f} MB in the last "
              f"(bound +{MOST_GROWTH:.0%} and {MOST_GROWTH_MB:g} MB): {'flat' if found.is_flat else 'GROWS'}")
    if options.json is not None:
        options.json.write_text(json.dumps({"samples": [vars(sample) for sample in samples],
                                            "trends": {name: vars(found) for name, found in trends.items()}}, indent=1) + "\n")
    return 0 if all(found.is_flat for found in trends.values()) else FAILED


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = Parser(prog="soak", allow_abbrev=False, description="memory of the service while scene, methods and viewers change")
    parser.add_argument("--minutes", type=_minutes, default=10.0, help="3 to 1440, default 10")
    parser.add_argument("--width", type=int, default=2048, help="of the camera's picture, default 2048")
    parser.add_argument("--fps", type=int, default=30, help="of the camera, default 30")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the samples")
    return parser.parse_args(arguments)


def _minutes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 3.0 <= value <= 1440.0:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected a number from 3 to 1440")
    return value


if __name__ == "__main__":
    sys.exit(main())
