"""One run of the whole service, and one of a plain transcode, of the same clip sent over the same protocol."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from server.bench.service_processes import OtherWork, ThreadClock, child_of, memory_of
from server.demo.calls import HOST, free_port, is_ready, request, stream, upload
from server.demo.children import Child, Children
from server.demo.report import Sample, demo_report
from server.demo.sampling import sampled
from server.demo.watch import DemoError, NewestLine, Watch

READY_WITHIN_S = 90.0
LONGEST_SILENCE_S = 2.0     # of a child at the end of a period, beyond which its figures do not stand for the period
WORKER_MODULE = "server.worker"
DECODING_THREAD = "ingest"
COUNTED = ("time", "slowest", "bytes")      # by `viewers_process`
Report = dict[str, Any]


@dataclass(frozen=True)
class Period:
    """Seconds at the start that are not measured, then those that are."""

    warm_up_s: float
    seconds: float


@dataclass(frozen=True)
class Show:
    """What a service shows: a clip, scene JSON, and the models by name that the scene uses."""

    clip: Path
    scene: Mapping[str, Any]
    models: Mapping[str, bytes]


@dataclass(frozen=True)
class Served:
    """A service that has a picture."""

    base: str
    service: Child
    publisher: Child
    triangles: dict[str, int]   # of each uploaded model, as the service counted them

    def worker(self) -> int:
        """The process of the stream's worker, another one after a restart. Raises ProcessGoneError."""
        return child_of(self.service.pid, WORKER_MODULE)


def start_service(children: Children, watch: Watch, folder: Path, show: Show, max_viewers: int,
                  environment: Mapping[str, str] | None = None, camera: Callable[[str], Child] | None = None) -> Served:
    """Service, models, scene and camera, as a user would. Logs and assets lie in `folder`; `environment` has more settings.

    `camera` starts one that publishes to the URL it is given, in place of the clip. Raises DemoError and ChildError.
    """
    port, camera_url = free_port(), f"rtmp://{HOST}:{free_port()}/live/camera"
    base, assets = f"http://{HOST}:{port}", tempfile.mkdtemp(prefix="assets-", dir=folder)
    service = children.start("service", "server.cli", "serve", "--host", HOST, "--port", str(port),
                             "--source", camera_url.replace("rtmp:", "rtmp-listen:"), log=folder / "service.log",
                             environment={"MR360_ASSETS_DIR": assets, "MR360_MAX_VIEWERS": str(max_viewers),
                                         **(environment or {})})
    watch.until("ready service", lambda: is_ready(base), READY_WITHIN_S)
    found = {name: upload(base, name, model)["triangles"] for name, model in show.models.items()}
    request("PUT", f"{base}/api/streams/live/scene", show.scene)
    publisher = camera(camera_url) if camera else _clip_camera(children, show.clip, camera_url, folder)
    watch.until("picture from the camera", lambda: stream(base)["state"] == "live", READY_WITHIN_S)
    return Served(base, service, publisher, found)


def _clip_camera(children: Children, clip: Path, url: str, folder: Path) -> Child:
    return children.start("camera", "server.cli", "publish", clip, url, "--loop", log=folder / "camera.log")


def measure_service(folder: Path, stop: threading.Event, show: Show, period: Period, receivers: int | None = None) -> Report:
    """The service with one viewer that decodes the keyframes, as a headset decodes all, or so many that only receive.

    Raises DemoError, ChildError, ProcessGoneError, and StopError at a signal.
    """
    with Children() as children:
        watch = Watch(children, stop)
        served = start_service(children, watch, folder, show, receivers or 1)
        url, log = f"{served.base}/whep/live", folder / "viewer.log"
        viewer = (children.start("viewer", "server.demo.viewer", url, piped=True, log=log) if receivers is None else
                  children.start("viewers", "server.bench.viewers_process", url, str(receivers), piped=True, log=log))
        seen = NewestLine(viewer)
        watch.until("picture in every viewer", lambda: seen.value.get("keyframes", 0) > 0, READY_WITHIN_S)
        watch.pause(period.warm_up_s)
        return {**measure_watched(watch, served, viewer, seen, period.seconds), "viewers": receivers or 1,
                "triangles": served.triangles}


def measure_watched(watch: Watch, served: Served, viewer: Child, seen: NewestLine, seconds: float) -> Report:
    """A service that is being watched by `viewer`, whose lines `seen` reads, for so long from now on."""
    worker = served.worker()
    children_by_name = {"server": served.service, "publisher": served.publisher, "viewer": viewer}
    threads, others = ThreadClock(worker), OtherWork([worker, *(child.pid for child in children_by_name.values())])
    samples = sampled(watch, served.base, seconds, seen, children_by_name)
    threads_now, others_now = threads.cores(), others.cores()
    report = _service_report(samples, stream(served.base)["worker"]["renderer"], threads_now)
    peaks = {"worker": memory_of(worker).peak_mb, "server": memory_of(served.service.pid).peak_mb}
    return {**report, "peak_mb": _rounded(peaks, 1), "other_cores": round(others_now, 3)}


def _service_report(samples: list[Sample], renderer: str | None, threads: Mapping[str, float]) -> Report:
    report, first, last = demo_report(samples, renderer), samples[0], samples[-1]
    if last.stats["scene_errors"]:
        raise DemoError(f"objects could not be drawn: {last.stats['scene_errors']}")
    seconds = last.time - first.time
    if not report["fps"] or report["worker_restarts"]:
        raise DemoError(f"the worker encoded {report['frames_out']} frames and was replaced {report['worker_restarts']} times")
    if last.time - last.viewer["time"] > LONGEST_SILENCE_S:
        raise DemoError(f"the viewer was silent for {last.time - last.viewer['time']:.1f} s")
    # The worker tells its counter and its processor time in one message, so that neither is older than the other.
    worker_ms = 1e3 * (last.cpu_seconds["worker"] - first.cpu_seconds["worker"]) / report["frames_out"]
    others = {name: 1e3 * (last.cpu_seconds[name] - first.cpu_seconds[name]) / seconds / report["fps"]
              for name in ("server", "publisher", "viewer")}
    by_thread = {name: 1e3 * cores / report["fps"] for name, cores in threads.items()}
    return {**report, "cpu_ms_per_frame": _rounded({"worker": worker_ms, **others}, 3),
            "threads_ms_per_frame": _rounded(by_thread, 3),
            "cost_ms": round(_cost_ms(worker_ms, by_thread, report), 3), "light_interval": last.stats["light_interval"],
            "received": {name: last.viewer[name] - first.viewer[name] for name in COUNTED if name in last.viewer}}


def measure_transcode(folder: Path, stop: threading.Event, clip: Path, period: Period) -> Report:
    """The clip decoded and encoded by `service_transcode`. Raises DemoError, ChildError, and StopError at a signal."""
    camera_url = f"rtmp://{HOST}:{free_port()}/live/camera"
    with Children() as children:
        watch = Watch(children, stop)
        transcode = children.start("transcode", "server.bench.service_transcode", camera_url.replace("rtmp:", "rtmp-listen:"),
                                   piped=True, log=folder / "transcode.log")
        seen = NewestLine(transcode)
        watch.until("transcode", lambda: bool(seen.value), READY_WITHIN_S)
        publisher = _clip_camera(children, clip, camera_url, folder)
        watch.until("transcoded frame", lambda: seen.value["frames_encoded"] > 0, READY_WITHIN_S)
        watch.pause(period.warm_up_s)
        threads, others, first = ThreadClock(transcode.pid), OtherWork([transcode.pid, publisher.pid]), seen.value
        watch.pause(period.seconds)
        threads_now, others_now = threads.cores(), others.cores()
        watch.until("report of the transcode", lambda: seen.value["time"] > first["time"], READY_WITHIN_S)
        report = _transcode_report(first, seen.value, threads_now, period.seconds)
        peak = memory_of(transcode.pid).peak_mb
    return {**report, "peak_mb": {"transcode": round(peak, 1)}, "other_cores": round(others_now, 3)}


def _transcode_report(first: Report, last: Report, threads: Mapping[str, float], wanted_s: float) -> Report:
    seconds, frames = last["time"] - first["time"], last["frames_encoded"] - first["frames_encoded"]
    if not frames or wanted_s - seconds > LONGEST_SILENCE_S:
        raise DemoError(f"the transcode encoded {frames} frames in {seconds:.1f} s, then was silent for {wanted_s - seconds:.1f} s")
    fps, cpu_ms = frames / seconds, 1e3 * (last["cpu_seconds"] - first["cpu_seconds"]) / frames
    by_thread = {name: 1e3 * cores / fps for name, cores in threads.items()}
    report = {"frames_in": last["frames_in"] - first["frames_in"], "frames_out": frames}
    return {**report, "seconds": round(seconds, 2), "frames_dropped": last["frames_dropped"] - first["frames_dropped"],
            "fps": round(fps, 2), "mbps": round((last["bytes"] - first["bytes"]) * 8e-6 / seconds, 2),
            "cpu_ms_per_frame": round(cpu_ms, 3), "threads_ms_per_frame": _rounded(by_thread, 3),
            "cost_ms": round(_cost_ms(cpu_ms, by_thread, report), 3)}


def _cost_ms(cpu_ms: float, by_thread: Mapping[str, float], report: Report) -> float:
    """Processor time of a frame that is not dropped: decoding by frames that came in, all else by frames that went out.

    On a machine that others use too, service and transcode drop different numbers of frames, all of which they have decoded.
    """
    kept = min(float(report["frames_out"] / report["frames_in"]), 1.0)
    return cpu_ms - by_thread.get(DECODING_THREAD, 0.0) * (1 - kept)


def _rounded(values: Mapping[str, float], digits: int) -> dict[str, float]:
    return {name: round(value, digits) for name, value in values.items()}
