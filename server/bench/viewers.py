"""`make bench-viewers`: what a further viewer costs, and what each one gets.

A camera sends a noisy clip over RTMP to the real service, which composites the demo's scene and sends to so many real
WebRTC peers on this machine, in one process that counts and decodes nothing. Processor time is counted by process: camera and
receivers are not ours, though they share the processors with the service. Then viewers come and go while the others watch.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from server.bench.machine import machine_figures
from server.bench.service_options import BAD_INPUT, Parser, bitrate, counts, one_count, one_size, seconds
from server.bench.service_processes import ProcessGoneError
from server.bench.service_run import READY_WITHIN_S, Report, Served, Show, measure_watched, start_service
from server.bench.viewers_process import SUMMED
from server.bench.viewers_tables import churn_lines, heading_lines, row_line, verdict_lines
from server.demo.calls import request
from server.demo.children import Child, ChildError, Children
from server.demo.clip import demo_clip
from server.demo.sample_scene import sample_scene
from server.demo.watch import DemoError, NewestLine, StopError, Watch, signals_set

FAILED, INTERRUPTED = 1, 130
COUNTS, QUICK_COUNTS = (1, 5, 10, 20, 30, 40), (1, 3)
CHURN_AMONG = 20            # viewers at the most
CLOCK_READINGS = 9
Line = Mapping[str, Any]    # of `viewers_process`


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0, 1 when something did not run, 2 for arguments that cannot be used, 130 after Ctrl-C."""
    options = _options(arguments)
    stop = threading.Event()
    try:
        clip = demo_clip(int(options.size.partition("x")[0]), options.fps, noisy=True)
        with tempfile.TemporaryDirectory(prefix="mr360-viewers-") as folder, signals_set(stop):
            _run(options, clip, Path(folder), stop)
    except (StopError, KeyboardInterrupt):
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"bench-viewers: {error}", file=sys.stderr)
        return BAD_INPUT
    except (DemoError, ChildError, ProcessGoneError) as error:
        print(f"bench-viewers: {error}", file=sys.stderr)
        return FAILED
    return 0


def _run(options: argparse.Namespace, clip: Path, folder: Path, stop: threading.Event) -> None:
    """Print and write every row as it comes, so that an interrupted run leaves what it has."""
    report: Report = {"machine": machine_figures(), "size": options.size, "fps": options.fps, "bitrate_bps": options.bitrate,
                      "rows": []}
    _print(heading_lines(report))
    with Children() as children:
        watch = Watch(children, stop)
        served = start_service(children, watch, folder, Show(clip, sample_scene(), {}), max(options.counts) + 1,
                               {"MR360_BITRATE_BPS": str(options.bitrate)})
        for count in options.counts:
            with _audience(children, watch, served, folder, count, options) as (child, seen):
                row = _measured(watch, served, child, seen, options)
                report["rows"].append(row)
                _print([row_line(row)])
                if count == _churn_count(options.counts):
                    report["churn"] = _churn(watch, served, child, seen)
            _save(report, options.json)
    if len(report["rows"]) > 1:
        report["slope"] = slope([row["viewers"] for row in report["rows"]], [row["cores"]["server"] for row in report["rows"]])
    _print(churn_lines(report))
    _print(verdict_lines(report))
    _save(report, options.json)


def _churn_count(viewers: Sequence[int]) -> int:
    return max((count for count in viewers if count <= CHURN_AMONG), default=min(viewers))


@contextlib.contextmanager
def _audience(children: Children, watch: Watch, served: Served, folder: Path, count: int,
              options: argparse.Namespace) -> Iterator[tuple[Child, NewestLine]]:
    """So many viewers, all of whom have a picture. Asked for by name, the rendition does not follow from what the network bears."""
    child = children.start("viewers", "server.bench.viewers_process", f"{served.base}/whep/live?rendition=full", str(count),
                           "--fps", str(options.fps), "--guests", str(options.guests), piped=True, log=folder / "viewers.log")
    seen = NewestLine(child)
    watch.until("picture in every viewer", lambda: len(seen.value.get("joins_ms", ())) == count, READY_WITHIN_S)
    yield child, seen
    children.stop(child)


def _measured(watch: Watch, served: Served, child: Child, seen: NewestLine, options: argparse.Namespace) -> Report:
    watch.pause(options.warm_up)
    clocks = capture_clocks(served.base)
    before = seen.value
    service = measure_watched(watch, served, child, seen, options.seconds)
    after = seen.value
    capture_ms = 1e3 * (statistics.median([*clocks, *capture_clocks(served.base)]) - after["epoch"])
    span, viewers = after["time"] - before["time"], len(after["by_viewer"])
    by_viewer = [(now - then) / span for now, then in zip(after["by_viewer"], before["by_viewer"], strict=True)]
    return {
        "viewers": viewers, "seconds": round(span, 2), "fps_sent": service["fps"], "fps_min": round(min(by_viewer), 2),
        "fps_mean": round(statistics.fmean(by_viewer), 2),
        "mbps_each": round((after["bytes"] - before["bytes"]) * 8e-6 / span / viewers, 2),
        "frames_dropped": service["frames_dropped"], "dropped_after_encoder": service["dropped_after_encoder"],
        **{name: after[name] - before[name] for name in SUMMED}, "joins_ms": percentiles(after["joins_ms"]),
        "latency_ms": _shifted(delay_percentiles(before["delays_ms"], after["delays_ms"]), -capture_ms),
        "sender_reports_ms": _shifted(percentiles(after["sender_reports_ms"]), -capture_ms),
        "server_latency_ms": service["latency_ms"], "render_ms": service["render_ms"],
        "cpu_ms_per_frame": service["cpu_ms_per_frame"],
        # at the camera's rate: on a machine that others use too, fewer frames are sent
        "cores": {name: round(cost * options.fps / 1e3, 4) for name, cost in service["cpu_ms_per_frame"].items()},
        "peak_mb": service["peak_mb"], "other_cores": service["other_cores"]}


def capture_clocks(base: str) -> list[float]:
    """The time (of the system's clock, seconds) of the capture that has RTP time 0, several times measured: light messages have
    both times of a frame, whatever RTCP says."""
    messages = [request("GET", f"{base}/api/streams/live/lights") for _ in range(CLOCK_READINGS)]
    return [float(one["captured_at"]) - one["rtp_timestamp"] / 90_000 for one in messages]


def _churn(watch: Watch, served: Served, child: Child, seen: NewestLine) -> Report:
    """What those who stay notice of guests who come and go; `frames` and what was wrong with them is theirs alone."""
    before, cut = seen.value, _cut(served)
    os.kill(child.pid, signal.SIGUSR1)
    watch.until("end of the visits", lambda: bool(seen.value["churned"]), READY_WITHIN_S)
    time.sleep(0.5)
    after = seen.value
    return {"viewers": len(after["by_viewer"]), "guests": len(after["guests_joins_ms"]),
            "seconds": round(after["time"] - before["time"], 2), "joins_ms": percentiles(after["guests_joins_ms"]),
            "dropped_after_encoder": _cut(served) - cut, "longest_gap_ms": after["longest_gap_ms"],
            **{name: after[name] - before[name] for name in SUMMED}}


def _cut(served: Served) -> int:
    return int(request("GET", f"{served.base}/api/streams/live/stats")["dropped_after_encoder"])


def percentiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {**{name: round(float(np.percentile(values, at)), 1) for name, at in (("p50", 50), ("p95", 95))},
            "max": round(max(values), 1)}


def delay_percentiles(before: Line, after: Line) -> dict[str, float] | None:
    """Of what has been counted between two lines, each milliseconds (as text, rounded down) to how often."""
    counted = Counter({int(delay): number - before.get(delay, 0) for delay, number in after.items()})
    return percentiles([delay + 0.5 for delay in sorted(counted.elements())])


def _shifted(figures: dict[str, float] | None, by: float) -> dict[str, float] | None:
    return None if figures is None else {name: round(value + by, 1) for name, value in figures.items()}


def slope(viewers: Sequence[int], cores: Sequence[float]) -> dict[str, float]:
    """The line of least squares: what the service's process uses without viewers, and for each."""
    each, none = np.polyfit(viewers, cores, 1)
    return {"cores_without": round(float(none), 4), "cores_a_viewer": round(float(each), 5)}


def _save(report: Report, file: Path | None) -> None:
    if file is not None:
        file.write_text(json.dumps(report, indent=1) + "\n")


def _print(lines: Iterator[str] | Sequence[str]) -> None:
    for line in lines:
        print(line, flush=True)


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = Parser(prog="bench-viewers", allow_abbrev=False, description="what a further viewer costs, and what each one gets")
    parser.add_argument("--quick", action="store_true", help="a quarter of a minute: few viewers, a small picture")
    parser.add_argument("--counts", type=counts, help=f"of viewers, default {','.join(map(str, COUNTS))}")
    parser.add_argument("--seconds", type=seconds, help="measured with each count, default 20")
    parser.add_argument("--warm-up", type=seconds, default=5.0, help="seconds before that, default 5")
    parser.add_argument("--guests", type=one_count, default=20, help="who come and go while others watch, default 20")
    parser.add_argument("--size", type=one_size, help="of the camera's picture, default 2048x1024")
    parser.add_argument("--fps", type=int, help="of the camera, default 30")
    parser.add_argument("--bitrate", type=bitrate, default=10_000_000, help="of the full rendition in bit/s, default 10000000")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the figures")
    options = parser.parse_args(arguments)
    quick = {"counts": QUICK_COUNTS, "seconds": 5.0, "size": "512x256", "fps": 10}
    whole = {"counts": COUNTS, "seconds": 20.0, "size": "2048x1024", "fps": 30}
    for name, default in (quick if options.quick else whole).items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    parser.check_json(options.json)
    return options


if __name__ == "__main__":
    sys.exit(main())
