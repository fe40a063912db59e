"""`make bench-latency`: from a camera's picture to the same picture on a screen.

A camera draws the time into its picture, encodes it and sends it over RTMP to the real service, which composites the demo's scene;
Chromium plays it over WebRTC in a plain video element and reads the time back from the frames that it shows. All of it shares this
machine's processors. The browser's clock is compared with ours.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

from server.bench.latency_figures import browser_figures, frame_figures, report_lines
from server.bench.latency_page import LatencyPage, Shown, latency_page
from server.bench.machine import machine_figures
from server.bench.service_options import BAD_INPUT, Parser, bitrate, one_size, seconds
from server.bench.service_processes import OtherWork, ProcessGoneError
from server.bench.service_run import READY_WITHIN_S, Report, Show, start_service
from server.bench.viewers import capture_clocks, percentiles
from server.demo.calls import request
from server.demo.children import ChildError, Children
from server.demo.clip import demo_clip
from server.demo.sample_scene import sample_scene
from server.demo.watch import DemoError, NewestLine, StopError, Watch, signals_set

FAILED, INTERRUPTED = 1, 130
WARM_UP_S = 10.0


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0, 1 when something did not run, 2 for arguments that cannot be used, 130 after Ctrl-C."""
    options = _options(arguments)
    stop = threading.Event()
    try:
        clip = demo_clip(int(options.size.partition("x")[0]), options.fps, noisy=True)
        with tempfile.TemporaryDirectory(prefix="mr360-latency-") as folder, signals_set(stop):
            report = measured(options, clip, Path(folder), stop)
    except (StopError, KeyboardInterrupt):
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"bench-latency: {error}", file=sys.stderr)
        return BAD_INPUT
    except (DemoError, ChildError, ProcessGoneError) as error:
        print(f"bench-latency: {error}", file=sys.stderr)
        return FAILED
    for line in report_lines(report):
        print(line)
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


def measured(options: argparse.Namespace, clip: Path, folder: Path, stop: threading.Event) -> Report:
    """Raises DemoError, ChildError, ProcessGoneError, StopError."""
    machine = machine_figures()
    with Children() as children:
        watch = Watch(children, stop)
        served = start_service(
            children, watch, folder, Show(clip, sample_scene(), {}), 2, {"MR360_BITRATE_BPS": str(options.bitrate)},
            lambda url: children.start("camera", "server.bench.latency_camera", clip, url, piped=True, log=folder / "camera.log"))
        camera = NewestLine(served.publisher)
        with latency_page(served.base) as page:
            _first_picture(page, watch)
            _pause(page, watch, options.warm_up)
            page.take()
            clocks, before, others = capture_clocks(served.base), page.stats(), OtherWork([])
            shown = _watched(page, watch, options.seconds)
            after, others_now = page.stats(), others.cores()
            server = request("GET", f"{served.base}/api/streams/live/stats")
            clocks += capture_clocks(served.base)
            return {"machine": machine, "size": options.size, "fps": options.fps, "bitrate_bps": options.bitrate,
                    "clock_error_ms": round(1e3 * page.clock_error_s, 3), "clock_offset_ms": round(1e3 * page.clock_offset_s, 3),
                    "cores_in_use": round(others_now, 3), "camera_encode_ms": percentiles(camera.value["encode_ms"]),
                    "server_ms": server["latency_ms"], "render_ms": server["render_ms"], "dropped": server["frames_dropped"],
                    **frame_figures(shown, statistics.median(clocks)), "browser": browser_figures(before, after)}


def _first_picture(page: LatencyPage, watch: Watch) -> None:
    end = time.monotonic() + READY_WITHIN_S
    while not page.take():
        if time.monotonic() > end:
            raise DemoError(f"no picture in the browser within {READY_WITHIN_S:g} s")
        _pause(page, watch, 0.5)


def _pause(page: LatencyPage, watch: Watch, seconds_: float) -> None:
    end = time.monotonic() + seconds_
    while (left := end - time.monotonic()) > 0:
        page.wait(min(left, 1.0))
        watch.pause(0.0)


def _watched(page: LatencyPage, watch: Watch, seconds_: float) -> list[Shown]:
    shown = []
    end = time.monotonic() + seconds_
    while time.monotonic() < end:
        _pause(page, watch, 1.0)
        shown += page.take()
    return shown


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = Parser(prog="bench-latency", allow_abbrev=False, description="from a camera's picture to the same picture on a screen")
    parser.add_argument("--seconds", type=seconds, default=30.0, help="measured, default 30")
    parser.add_argument("--warm-up", type=seconds, default=WARM_UP_S, help=f"seconds before that, default {WARM_UP_S:g}")
    parser.add_argument("--size", type=one_size, default="2048x1024", help="of the camera's picture, default 2048x1024")
    parser.add_argument("--fps", type=int, default=30, help="of the camera, default 30")
    parser.add_argument("--bitrate", type=bitrate, default=10_000_000, help="of the full rendition in bit/s, default 10000000")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the figures")
    options = parser.parse_args(arguments)
    parser.check_json(options.json)
    return options


if __name__ == "__main__":
    sys.exit(main())
