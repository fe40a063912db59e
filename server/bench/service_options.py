"""What `make bench-service` can be asked for."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from server.bench.service_scene import KNOT_TRIANGLES

BAD_INPUT = 2
SIZES = ("1280x640", "2048x1024", "3840x1920")
CLIPS = {"still": True, "sun": False}
TABLES = ("service", "objects", "triangles", "lamps", "viewers")
VIEWERS = (1, 2, 5, 10, 20)
MAX_VIEWERS = 100


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}\n")

    def check_json(self, file: Path | None) -> None:
        """End the process when the file of `--json` lies in no folder."""
        if file is not None and not file.absolute().parent.is_dir():
            self.error(f"argument --json: {str(file)!r} given, expected a file in a folder that exists")


def bench_options(arguments: list[str] | None) -> argparse.Namespace:
    """Ends the process with status 2 for what cannot be used."""
    parser = Parser(prog="bench-service", allow_abbrev=False, description="what the whole service costs beside a plain transcode")
    parser.add_argument("--quick", action="store_true", help="about a minute: one size, one clip, short, no scaling")
    parser.add_argument("--sizes", type=sizes, help=f"default {','.join(SIZES)}")
    parser.add_argument("--clips", type=_some_of(tuple(CLIPS)), help="default still,sun: the sun stands, or goes round in 30 s")
    parser.add_argument("--only", type=_some_of(TABLES), help=f"tables, default {','.join(TABLES)}")
    parser.add_argument("--viewers", type=counts, help=f"in the table of viewers, default {','.join(map(str, VIEWERS))}")
    parser.add_argument("--seconds", type=seconds, help="measured of each run, default 20")
    parser.add_argument("--warm-up", type=seconds, help="seconds before that, default 10")
    parser.add_argument("--fps", type=int, default=30, help="of the camera, default 30")
    parser.add_argument("--mesh-triangles", type=int, default=KNOT_TRIANGLES, help=f"of the mesh, default {KNOT_TRIANGLES}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the figures")
    options = parser.parse_args(arguments)
    quick = {"sizes": SIZES[:1], "clips": ("still",), "only": ("service",), "viewers": (1, 2), "seconds": 10.0, "warm_up": 3.0}
    whole = {"sizes": SIZES, "clips": tuple(CLIPS), "only": TABLES, "viewers": VIEWERS, "seconds": 20.0, "warm_up": 10.0}
    for name, default in (quick if options.quick else whole).items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    parser.check_json(options.json)
    return options


def sizes(text: str) -> tuple[str, ...]:
    """An argument: WIDTHxHEIGHT, several by commas."""
    for size in text.split(","):
        width, _, height = size.partition("x")
        if not (width + height).isdigit() or len(width) > 4 or int(width) % 4 or not 256 <= int(width) == 2 * int(height) <= 8192:
            raise argparse.ArgumentTypeError(f"{size!r} given, expected WIDTHxHEIGHT, twice as wide as high, 256x128 to 8192x4096")
    return tuple(dict.fromkeys(text.split(",")))


def one_size(text: str) -> str:
    """An argument: WIDTHxHEIGHT."""
    found = sizes(text)
    if len(found) != 1:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected one size")
    return found[0]


def _some_of(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    def chosen(text: str) -> tuple[str, ...]:
        for name in text.split(","):
            if name not in known:
                raise argparse.ArgumentTypeError(f"{name!r} given, expected some of {','.join(known)}")
        return tuple(dict.fromkeys(text.split(",")))
    return chosen


def counts(text: str) -> tuple[int, ...]:
    """An argument: numbers of viewers."""
    for count in text.split(","):
        if not count.isascii() or not count.isdigit() or not 1 <= int(count[:9]) <= MAX_VIEWERS:
            raise argparse.ArgumentTypeError(f"{count!r} given, expected whole numbers from 1 to {MAX_VIEWERS}")
    return tuple(dict.fromkeys(map(int, text.split(","))))


def one_count(text: str) -> int:
    """An argument: a number of viewers."""
    found = counts(text)
    if len(found) != 1:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected one number")
    return found[0]


def bitrate(text: str) -> int:
    """An argument: bit/s, as the service takes them."""
    if not text.isascii() or not text.isdigit() or not 100_000 <= int(text[:10]) <= 200_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected bit/s from 100000 to 200000000")
    return int(text)


def seconds(text: str) -> float:
    """An argument: a time."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 1.0 <= value <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text!r} given, expected a number of seconds from 1 to 3600")
    return value
