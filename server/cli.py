"""The command `mr360`. Exit status 0 on success, 2 on bad usage or bad input with one line on standard error."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from server.config import ConfigError

BAD_INPUT = 2


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    parsed = build_parser().parse_args(arguments)
    try:
        return int(parsed.run(parsed) or 0)
    except ConfigError as error:
        print(f"mr360 {parsed.command}: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        return 130


def build_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="mr360", allow_abbrev=False,
                     description="Live 360-degree video as backdrop and light source for virtual objects.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for add in (_add_serve, _add_demo, _add_render, _add_lights, _add_bench, _add_publish):
        add(commands)
    return parser


Commands = argparse._SubParsersAction  # the type has no public name


def _add_serve(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("serve", help="the service", allow_abbrev=False)
    parser.add_argument("--source", metavar="URL", help="what the stream `live` shows: RTSP or RTMP URL, or a file")
    parser.add_argument("--config", metavar="FILE", type=Path, help="TOML file with settings")
    parser.add_argument("--host", metavar="H", help="address to listen on, default 127.0.0.1")
    parser.add_argument("--port", metavar="P", help="TCP port, default 8360")
    parser.add_argument("--require-gpu", action="store_true", default=None, help="refuse a software renderer")
    parser.set_defaults(run=_serve)


def _add_demo(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("demo", help="a synthetic camera, the service and a sample scene", allow_abbrev=False)
    parser.add_argument("--duration", metavar="S", type=_positive, help="stop by itself after S seconds")
    parser.add_argument("--width", metavar="W", type=_even, default=2048, help="pixels across, default 2048")
    parser.add_argument("--fps", metavar="F", type=_positive, default=30.0, help="frames per second, default 30")
    parser.add_argument("--report", metavar="FILE", type=Path, help="where to write the JSON report")
    parser.set_defaults(run=_demo)


def _add_render(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("render", help="the same pipeline, offline", allow_abbrev=False)
    parser.add_argument("input", metavar="INPUT", type=Path, help="panorama (png, jpg), radiance map (exr, hdr), video")
    parser.add_argument("--output", metavar="OUT", type=Path, required=True, help="png, exr or mp4")
    parser.add_argument("--scene", metavar="FILE", type=Path, help="scene JSON")
    parser.add_argument("--preset", metavar="P", choices=("default", "paper"), help="default or paper")
    parser.add_argument("--report", metavar="FILE", type=Path, help="where to write the JSON report")
    parser.set_defaults(run=_render)


def _add_lights(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("lights", help="light detection as one JSON object", allow_abbrev=False)
    parser.add_argument("input", metavar="INPUT", type=Path, help="panorama or radiance map")
    parser.add_argument("--method", metavar="M", choices=("default", "threshold", "probe"), default="default",
                        help="default, threshold or probe")
    parser.add_argument("--count", metavar="N", type=_count, default="auto", help="number of lights, or auto")
    parser.set_defaults(run=_lights)


def _add_bench(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("bench", help="speed against error, every stage and preset", allow_abbrev=False)
    parser.add_argument("--quick", action="store_true", help="fewer frames and maps, under a minute")
    parser.add_argument("--json", metavar="FILE", type=Path, help="where to write the rows as JSON")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="time against error by stage: .png or .svg")
    parser.set_defaults(run=_bench)


def _add_publish(commands: Commands[_Parser]) -> None:
    parser = commands.add_parser("publish", help="feed a file to an RTMP or RTSP server", allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", type=Path)
    parser.add_argument("url", metavar="URL")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.set_defaults(run=_publish)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected a number above 0")
    return value


def _even(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 16 <= int(text[:9]) <= 16384 or int(text) % 4:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected a multiple of 4 from 16 to 16384")
    return int(text)


def _count(text: str) -> str | int:
    if text == "auto":
        return text
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= 64:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected auto or a number from 1 to 64")
    return int(text)


# Each command imports what it needs and nothing more: `serve` must come up without GL, `render` without a web server.

def _serve(arguments: argparse.Namespace) -> int:
    import uvloop

    from server.config import load_settings
    from server.run import configure_logging, serve

    given = {name: value for name in ("source", "host", "port", "require_gpu")
             if (value := getattr(arguments, name)) is not None}
    settings = load_settings(given, arguments.config)
    configure_logging()
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(serve(settings, started=lambda url: print(f"mr360 serves {url}", flush=True)))
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from server.demo.run import run_demo

    return int(run_demo(arguments) or 0)


def _render(arguments: argparse.Namespace) -> int:
    from server.worker.offline import run_render

    return int(run_render(arguments) or 0)


def _lights(arguments: argparse.Namespace) -> int:
    from server.worker.offline import run_lights

    return int(run_lights(arguments) or 0)


def _bench(arguments: argparse.Namespace) -> int:
    from server.bench.report import run_bench

    return int(run_bench(arguments) or 0)


def _publish(arguments: argparse.Namespace) -> int:
    from server.demo.publish import run_publish

    return int(run_publish(arguments) or 0)


if __name__ == "__main__":
    sys.exit(main())
