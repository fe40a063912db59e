"""`mr360 demo`: the synthetic camera, published over real RTMP into the real service, with a sample scene.

Service, publisher and viewer are processes of their own, just as in real use; this one only starts and watches them.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from pathlib import Path

from server.demo.calls import HOST, free_port, is_free, is_ready, request, stream
from server.demo.children import ChildError, Children
from server.demo.clip import demo_clip
from server.demo.report import SETTLING_S, demo_report
from server.demo.sample_scene import sample_scene
from server.demo.sampling import sampled
from server.demo.watch import DemoError, NewestLine, StopError, Watch, signals_set

PORT = 8360
READY_WITHIN_S = 90.0
BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


def run_demo(args: argparse.Namespace) -> int:
    """Run until Ctrl-C or, with `args.duration`, so many seconds from the first picture. Returns the exit status."""
    try:
        _check(args)
        clip = demo_clip(args.width, int(args.fps))
    except (ValueError, OSError) as error:
        print(f"mr360 demo: {error}", file=sys.stderr)
        return BAD_INPUT
    stop = threading.Event()
    with signals_set(stop), Children() as children:
        try:
            return _run(args, clip, children, stop)
        except StopError:
            return 0 if args.duration is None else INTERRUPTED
        except (DemoError, ChildError) as error:
            print(f"mr360 demo: {error}", file=sys.stderr)
            return FAILED


def _run(args: argparse.Namespace, clip: Path, children: Children, stop: threading.Event) -> int:
    watch = Watch(children, stop)
    port = PORT if is_free(PORT) else free_port()
    base = f"http://{HOST}:{port}"
    camera_url = f"rtmp://{HOST}:{free_port()}/live/camera"
    service = children.start("service", "server.cli", "serve", "--host", HOST, "--port", str(port),
                             "--source", camera_url.replace("rtmp:", "rtmp-listen:"))
    watch.until("ready service", lambda: is_ready(base), READY_WITHIN_S)
    request("PUT", f"{base}/api/streams/live/scene", sample_scene())
    publisher = children.start("camera", "server.cli", "publish", clip, camera_url, "--loop")
    watch.until("picture from the camera", lambda: stream(base)["state"] == "live", READY_WITHIN_S)
    print(_invitation(base, args.duration), flush=True)
    if args.duration is None:
        watch.pause(float("inf"))
    viewer = children.start("viewer", "server.demo.viewer", f"{base}/whep/live?rendition=full", piped=True)
    seen = NewestLine(viewer)
    watch.until("picture in the viewer", lambda: seen.value.get("keyframes", 0) > 0, READY_WITHIN_S)
    watch.pause(SETTLING_S)
    samples = sampled(watch, base, args.duration - SETTLING_S, seen,
                      {"server": service, "publisher": publisher, "viewer": viewer})
    report = json.dumps(demo_report(samples, stream(base)["worker"]["renderer"]), indent=2)
    if args.report is None:
        print(report)
    else:
        args.report.write_text(report + "\n")
        print(f"report in {args.report}")
    return 0


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
