"""`mr360 demo`: the synthetic camera, published over real RTMP into the real service, with a sample scene.

Service, publisher and viewer are processes of their own, just as in real use; this one only starts and watches them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from server.demo.children import Child, ChildError, Children
from server.demo.clip import demo_clip
from server.demo.report import SETTLING_S, Sample, demo_report
from server.demo.sample_scene import sample_scene

HOST = "127.0.0.1"
PORT = 8360
READY_WITHIN_S = 90.0
SAMPLE_EVERY_S = 0.2
BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


class DemoError(RuntimeError):
    """The demo cannot go on; the text says why."""


class _StopError(Exception):
    """A signal came."""


def run_demo(args: argparse.Namespace) -> int:
    """Run until Ctrl-C or, with `args.duration`, so many seconds from the first picture. Returns the exit status."""
    try:
        _check(args)
        clip = demo_clip(args.width, int(args.fps))
    except (ValueError, OSError) as error:
        print(f"mr360 demo: {error}", file=sys.stderr)
        return BAD_INPUT
    stop = threading.Event()
    with _signals(stop), Children() as children:
        try:
            return _run(args, clip, children, stop)
        except _StopError:
            return 0 if args.duration is None else INTERRUPTED
        except (DemoError, ChildError) as error:
            print(f"mr360 demo: {error}", file=sys.stderr)
            return FAILED


def _run(args: argparse.Namespace, clip: Path, children: Children, stop: threading.Event) -> int:
    watch = _Watch(children, stop)
    port = PORT if _is_free(PORT) else _free_port()
    base = f"http://{HOST}:{port}"
    camera_url = f"rtmp://{HOST}:{_free_port()}/live/camera"
    service = children.start("service", "server.cli", "serve", "--host", HOST, "--port", str(port),
                             "--source", camera_url.replace("rtmp:", "rtmp-listen:"))
    watch.until("ready service", lambda: _is_ready(base), READY_WITHIN_S)
    _request("PUT", f"{base}/api/streams/live/scene", sample_scene())
    publisher = children.start("camera", "server.cli", "publish", clip, camera_url, "--loop")
    watch.until("picture from the camera", lambda: _stream(base)["state"] == "live", READY_WITHIN_S)
    print(_invitation(base, args.duration), flush=True)
    if args.duration is None:
        watch.pause(float("inf"))
    viewer = children.start("viewer", "server.demo.viewer", f"{base}/whep/live", piped=True)
    samples = _measure(watch, base, args.duration, {"server": service, "publisher": publisher, "viewer": viewer})
    report = json.dumps(demo_report(samples, _stream(base)["worker"]["renderer"]), indent=2)
    if args.report is None:
        print(report)
    else:
        args.report.write_text(report + "\n")
        print(f"report in {args.report}")
    return 0


class _Watch:
    """Waiting that ends with _StopError at a signal and with ChildError when a child has ended."""

    def __init__(self, children: Children, stop: threading.Event) -> None:
        self._children, self._stop = children, stop

    def pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if self._stop.wait(min(left, 0.5)):
                raise _StopError
            self._children.check()

    def until(self, what: str, check: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while not check():
            if time.monotonic() > end:
                raise DemoError(f"no {what} within {seconds:g} s")
            self.pause(SAMPLE_EVERY_S)


def _measure(watch: _Watch, base: str, duration: float, children: dict[str, Child]) -> list[Sample]:
    lines: list[dict[str, Any]] = [{"frames": 0}]
    reader = threading.Thread(target=_keep_newest, args=(children["viewer"], lines), daemon=True)
    reader.start()
    watch.until("picture in the viewer", lambda: lines[0].get("keyframes", 0) > 0, READY_WITHIN_S)
    started = time.monotonic()
    watch.pause(SETTLING_S)
    samples = []
    while time.monotonic() < started + duration:
        stats = _request("GET", f"{base}/api/streams/live/stats")
        cpu_seconds = {"worker": float(stats.get("cpu_seconds", 0)),
                       **{name: child.cpu_seconds() for name, child in children.items()}}
        if "frames_encoded" in stats:       # missing while a worker is being replaced
            samples.append(Sample(time.monotonic(), stats, lines[0], cpu_seconds))
        watch.pause(SAMPLE_EVERY_S)
    if len(samples) < 2:
        raise DemoError("the worker gave no statistics")
    return samples


def _keep_newest(viewer: Child, newest: list[dict[str, Any]]) -> None:
    for line in viewer.stdout:
        newest[0] = json.loads(line)
    viewer.stdout.close()


def _invitation(base: str, duration: float | None) -> str:
    end = "Ctrl-C ends it" if duration is None else f"It ends by itself after {duration:g} s"
    return (f"\nThe synthetic camera is live. Open\n  {base}/view/live     to look around (WebXR works on this machine)"
            f"\n  {base}/control/live  to move the objects\n  {base}/docs          for the REST API\n{end}.\n")


def _check(args: argparse.Namespace) -> None:
    """Raises ValueError for arguments that cannot be used."""
    if args.fps != int(args.fps):
        raise ValueError(f"fps is {args.fps:g}, expected a whole number")
    if args.duration is not None and args.duration <= SETTLING_S:
        raise ValueError(f"duration is {args.duration:g}, expected more than the {SETTLING_S:g} s of settling")
    if args.report is not None and args.duration is None:
        raise ValueError(f"report is {str(args.report)!r} without a duration, expected both")


@contextlib.contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
        return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _stream(base: str) -> dict[str, Any]:
    found: dict[str, Any] = _request("GET", f"{base}/api/streams/live")
    return found


def _is_ready(base: str) -> bool:
    """Raises DemoError when it never will be."""
    try:
        stream = _stream(base)
    except DemoError:
        return False        # not listening yet
    if stream["state"] == "failed":
        raise DemoError(stream["detail"])
    return bool(stream["worker"]["ready"])


def _request(method: str, url: str, body: Any = None) -> Any:
    """The JSON of the answer. Raises DemoError."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json"}, method=method)
    try:
        with urllib.request.urlopen(request, timeout=5) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        with error:
            raise DemoError(f"{method} {url} answered {error.code}: {error.read(500).decode()}") from None
    except (OSError, ValueError) as error:
        raise DemoError(f"{method} {url} failed: {error}") from None
