"""`make bench-light`: the light stages against closed forms and float64 references, the papers' methods beside ours.

`python -m server.bench.light [--maps FOLDER] [--clips FOLDER]` takes the analytic maps; every `.exr` and `.hdr` of FOLDER besides;
every clip of FOLDER that has its truth beside it, `NAME.gt.json`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from renderer.gl import Context
from server.bench.light_clips import clip_table
from server.bench.light_range import dynamic_range_table
from server.bench.light_reference import analytic_maps, given_maps
from server.bench.light_tables import detection_table, diffuse_table, glossy_table, irradiance_table, probe_table
from server.bench.pipelines import Pipelines


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.light", description=__doc__)
    parser.add_argument("--maps", metavar="FOLDER", type=Path, help="radiance maps to measure besides the analytic ones")
    parser.add_argument("--clips", metavar="FOLDER", type=Path, help="clips with their truth beside them")
    parser.add_argument("--only", metavar="TABLE", help="irradiance, diffuse, glossy, detection, probe, range or clips")
    arguments = parser.parse_args()
    analytic, given = list(analytic_maps()), list(given_maps(arguments.maps))
    context = Context()
    pipelines = Pipelines(context)
    tables: dict[str, Callable[[], Iterator[str]]] = {
        "irradiance": lambda: irradiance_table(pipelines, analytic + given),
        "diffuse": lambda: diffuse_table(pipelines, analytic + given),
        "glossy": lambda: glossy_table(pipelines, analytic + given),
        "detection": lambda: detection_table(analytic + given),
        "probe": lambda: probe_table(analytic + given),
        "range": lambda: dynamic_range_table(pipelines, given),
        "clips": lambda: clip_table(pipelines, arguments.clips)}
    for name, table in tables.items():
        if arguments.only in (None, name):
            for line in table():
                print(line, flush=True)
            print()
    pipelines.release()
    context.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
