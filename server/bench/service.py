"""`make bench-service`: what the whole service costs, beside a plain transcode of the same clip in the same run.

A camera sends a clip over RTMP to the real service, which decodes, renders the papers' five objects, encodes and sends to a real
viewer over WebRTC; directly before and after, `service_transcode` decodes and encodes the same clip with the same settings. Then
what a frame costs by objects, triangles, lamps and viewers. Processor time is counted per frame and process: camera and viewer are
not ours.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import NoReturn

from renderer.gl import GLUnavailableError
from renderer.models.gltf import load
from server.bench.service_processes import ProcessGoneError
from server.bench.service_run import Period, Report, Show, measure_service, measure_transcode
from server.bench.service_scaling import LAMPS, OBJECTS, TRIANGLES, Scaling
from server.bench.service_scene import KNOT, KNOT_TRIANGLES, five_objects, knot_glb, triangles_of
from server.bench.service_tables import machine_lines, scaling_lines, service_lines, viewer_lines
from server.demo.children import ChildError
from server.demo.clip import demo_clip
from server.demo.watch import DemoError, StopError, signals_set

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130
SIZES = ("1280x640", "2048x1024", "3840x1920")
CLIPS = {"still": True, "sun": False}
TABLES = ("service", "objects", "triangles", "lamps", "viewers")
VIEWERS = (1, 2, 5, 10, 20)
SCALING_SIZE = "2048x1024"
MAX_VIEWERS = 100


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}\n")


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0, 1 when something did not run, 2 for arguments that cannot be used, 130 after Ctrl-C."""
    options = _options(arguments)
    stop = threading.Event()
    try:
        _make_clips(options)
        with tempfile.TemporaryDirectory(prefix="mr360-bench-") as folder, signals_set(stop):
            _Bench(options, Path(folder), stop).run()
    except (StopError, KeyboardInterrupt):
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"bench-service: {error}", file=sys.stderr)
        return BAD_INPUT
    except (DemoError, ChildError, ProcessGoneError, GLUnavailableError) as error:
        print(f"bench-service: {error}", file=sys.stderr)
        return FAILED
    return 0


def _make_clips(options: argparse.Namespace) -> None:
    """Those that are not in the cache: it may take minutes, in which nothing else is to run. Raises ValueError and OSError."""
    wanted = {(size, clip) for size in options.sizes for clip in options.clips} if "service" in options.only else set()
    if "viewers" in options.only:
        wanted.add((options.sizes[0], options.clips[0]))
    if {"objects", "triangles"} & set(options.only):
        wanted |= {(_scaling_size(options), clip) for clip in CLIPS}
    for size, clip in sorted(wanted):
        demo_clip(_width(size), options.fps, still=CLIPS[clip])


class _Bench:
    """The tables of one call, printed as they come; `report` has all of it."""

    def __init__(self, options: argparse.Namespace, folder: Path, stop: threading.Event) -> None:
        self._options, self._folder, self._stop = options, folder, stop
        self._period = Period(options.warm_up, options.seconds)
        model, self._knot_triangles = knot_glb(options.mesh_triangles)
        self._models = {KNOT: model}
        self._teapot_triangles = load(Path(str(resources.files("renderer.models.builtin") / "teapot.glb"))).triangle_count
        self.report: Report = {"machine": _machine(), "fps": options.fps}

    def run(self) -> None:
        """Write the JSON file after every table, so that an interrupted run leaves what it has."""
        _print(machine_lines(self.report["machine"]))
        for table in self._options.only:
            for _ in self._tables()[table]():
                if self._options.json is not None:
                    self._options.json.write_text(json.dumps(self.report, indent=1) + "\n")

    def _tables(self) -> dict[str, Callable[[], Iterator[None]]]:
        return {"service": self._services, "viewers": self._viewers,
                "objects": lambda: self._scaling("objects", "objects", "by objects"),
                "triangles": lambda: self._scaling("triangles", "triangles", "by triangles"),
                "lamps": lambda: self._scaling("lamps", "lamps", "by lamps, five objects")}

    def _services(self) -> Iterator[None]:
        for size in self._options.sizes:
            for clip in self._options.clips:
                run = self._service(size, clip)
                self.report.setdefault("service", []).append(run)
                _print(service_lines(run))
                yield

    def _service(self, size: str, clip: str) -> Report:
        file = self._clip(size, clip)
        scene = five_objects()
        before = measure_transcode(self._folder, self._stop, file, self._period)
        service = measure_service(self._folder, self._stop, Show(file, scene, self._models), self._period)
        after = measure_transcode(self._folder, self._stop, file, self._period)
        floors = (before["cost_ms"], after["cost_ms"])
        cost, floor = service["cost_ms"], sum(floors) / 2
        sending = service["cpu_ms_per_frame"]["server"]
        processors = self.report["machine"]["processors"]
        return {"size": size, "clip": clip, "fps": self._options.fps, "processors": processors,
                "triangles": triangles_of(scene, {KNOT: self._knot_triangles, "teapot": self._teapot_triangles}),
                "knot_triangles": self._knot_triangles, "teapot_triangles": self._teapot_triangles,
                "transcodes": [before, after], "service": service,
                "share_of_processors": round((cost + sending) * self._options.fps / 1e3 / processors, 4),
                "ratio": {"worker": round(cost / floor, 3), "range": [round(cost / max(floors), 3), round(cost / min(floors), 3)],
                          "worker_and_server": round((cost + sending) / floor, 3)}}

    def _viewers(self) -> Iterator[None]:
        size, clip = self._options.sizes[0], self._options.clips[0]
        show = Show(self._clip(size, clip), five_objects(), self._models)
        runs = self.report.setdefault("viewers", [])
        for count in self._options.viewers:
            service = measure_service(self._folder, self._stop, show, self._period, count)
            received, seconds = service["received"], service["seconds"]
            runs.append({"size": size, "clip": clip, "service": service, "slowest_fps": round(received["slowest"] / seconds, 2),
                         "mbps_each": round(received["bytes"] * 8e-6 / seconds / count, 2)})
            yield
        _print(viewer_lines(runs))

    def _scaling(self, table: str, unit: str, title: str) -> Iterator[None]:
        folder = self._folder / table
        folder.mkdir()
        width = _width(_scaling_size(self._options))
        scaling = Scaling(width, self._options.fps, folder, *((60, 30) if self._options.quick else (200, 60)),
                          teapot_triangles=self._teapot_triangles, stop=self._stop)
        self.report["machine"]["renderer"] = scaling.renderer
        rows = self.report.setdefault(table, [])
        made = {"objects": scaling.objects, "triangles": scaling.triangles, "lamps": scaling.lamps}[table]
        counts = {"objects": OBJECTS, "triangles": TRIANGLES, "lamps": LAMPS}[table]
        try:
            for row in made(counts[:2] if self._options.quick else counts):
                rows.append(row)
                yield
        finally:
            scaling.release()
        _print(scaling_lines(f"{title}, {width}x{width // 2}, {scaling.renderer}", unit, rows))

    def _clip(self, size: str, clip: str) -> Path:
        return demo_clip(_width(size), self._options.fps, still=CLIPS[clip])


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = _Parser(prog="bench-service", allow_abbrev=False, description="what the whole service costs beside a plain transcode")
    parser.add_argument("--quick", action="store_true", help="about a minute: one size, one clip, short, no scaling")
    parser.add_argument("--sizes", type=_sizes, help=f"default {','.join(SIZES)}")
    parser.add_argument("--clips", type=_some_of(tuple(CLIPS)), help="default still,sun: the sun stands, or goes round in 30 s")
    parser.add_argument("--only", type=_some_of(TABLES), help=f"tables, default {','.join(TABLES)}")
    parser.add_argument("--viewers", type=_counts, help=f"in the table of viewers, default {','.join(map(str, VIEWERS))}")
    parser.add_argument("--seconds", type=_seconds, help="measured of each run, default 20")
    parser.add_argument("--warm-up", type=_seconds, help="seconds before that, default 10")
    parser.add_argument("--fps", type=int, default=30, help="of the camera, default 30")
    parser.add_argument("--mesh-triangles", type=int, default=KNOT_TRIANGLES, help=f"of the mesh, default {KNOT_TRIANGLES}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the figures")
    options = parser.parse_args(arguments)
    quick = {"sizes": SIZES[:1], "clips": ("still",), "only": ("service",), "viewers": (1, 2), "seconds": 10.0, "warm_up": 3.0}
    whole = {"sizes": SIZES, "clips": tuple(CLIPS), "only": TABLES, "viewers": VIEWERS, "seconds": 20.0, "warm_up": 10.0}
    for name, default in (quick if options.quick else whole).items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    if options.json is not None and not options.json.absolute().parent.is_dir():
        parser.error(f"argument --json: {str(options.json)!r} given, expected a file in a folder that exists")
    return options


def _sizes(text: str) -> tuple[str, ...]:
    for size in text.split(","):
        width, _, height = size.partition("x")
        if not (width + height).isdigit() or len(width) > 4 or int(width) % 4 or not 256 <= int(width) == 2 * int(height) <= 8192:
            raise argparse.ArgumentTypeError(f"{size!r} given, expected WIDTHxHEIGHT, twice as wide as high, 256x128 to 8192x4096")
    return tuple(text.split(","))


def _some_of(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    def chosen(text: str) -> tuple[str, ...]:
        for name in text.split(","):
            if name not in known:
                raise argparse.ArgumentTypeError(f"{name!r} given, expected some of {','.join(known)}")
        return tuple(text.split(","))
    return chosen


def _counts(text: str) -> tuple[int, ...]:
    for count in text.split(","):
        if not count.isascii() or not count.isdigit() or not 1 <= int(count[:9]) <= MAX_VIEWERS:
            raise argparse.ArgumentTypeError(f"{count!r} given, expected whole numbers from 1 to {MAX_VIEWERS}")
    return tuple(map(int, text.split(",")))


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 1.0 <= value <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected a number of seconds from 1 to 3600")
    return value


def _scaling_size(options: argparse.Namespace) -> str:
    return str(options.sizes[0]) if len(options.sizes) == 1 else SCALING_SIZE


def _machine() -> Report:
    return {"processors": os.cpu_count() or 1, "model": _processor(), "load_average": os.getloadavg()[0],
            "lp_num_threads": os.environ.get("LP_NUM_THREADS")}


def _processor() -> str:
    """The processor's name where the kernel tells, and its architecture."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return f"{found[1]}, {platform.machine()}" if found else platform.machine()


def _print(lines: Iterator[str]) -> None:
    for line in lines:
        print(line, flush=True)
    print(flush=True)


def _width(size: str) -> int:
    return int(size.partition("x")[0])


if __name__ == "__main__":
    sys.exit(main())
