"""`make bench-service`: what the whole service costs, beside a plain transcode of the same clip in the same run.

A camera sends a clip over RTMP to the real service, which decodes, renders the papers' five objects, encodes and sends to a real
viewer over WebRTC; directly before and after, `service_transcode` decodes and encodes the same clip with the same settings. Then
what a frame costs by objects, triangles, lamps and viewers. Processor time is counted per frame and process: camera and viewer are
not ours.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

from renderer.gl import GLUnavailableError
from renderer.models.gltf import load
from server.bench.machine import machine_figures
from server.bench.service_options import BAD_INPUT, CLIPS, bench_options
from server.bench.service_processes import ProcessGoneError
from server.bench.service_run import Period, Report, Show, measure_service, measure_transcode
from server.bench.service_scaling import LAMPS, OBJECTS, TRIANGLES, Scaling
from server.bench.service_scene import KNOT, five_objects, knot_glb, triangles_of
from server.bench.service_tables import machine_lines, scaling_lines, service_lines, viewer_lines
from server.demo.children import ChildError
from server.demo.clip import demo_clip
from server.demo.watch import DemoError, StopError, signals_set

FAILED, INTERRUPTED = 1, 130
SCALING_SIZE = "2048x1024"


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0, 1 when something did not run, 2 for arguments that cannot be used, 130 after Ctrl-C."""
    options = bench_options(arguments)
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
        self.report: Report = {"machine": machine_figures(), "fps": options.fps}

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
            received = service["received"]
            runs.append({"size": size, "clip": clip, "service": service,
                         "slowest_fps": round(received["slowest"] / received["time"], 2),
                         "mbps_each": round(received["bytes"] * 8e-6 / received["time"] / count, 2)})
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


def _scaling_size(options: argparse.Namespace) -> str:
    return str(options.sizes[0]) if len(options.sizes) == 1 else SCALING_SIZE


def _print(lines: Iterator[str]) -> None:
    for line in lines:
        print(line, flush=True)
    print(flush=True)


def _width(size: str) -> int:
    return int(size.partition("x")[0])


if __name__ == "__main__":
    sys.exit(main())
