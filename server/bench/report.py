"""`mr360 bench`: speed against error of every stage and preset, hard cases, and what scenes cost that need less."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from renderer.gl import Context, GLUnavailableError
from server.bench import (
    ablation,
    composite_rows,
    diffuse_rows,
    glossy_rows,
    light_rows,
    radiance_rows,
    shadow_rows,
    whole_rows,
)
from server.bench.effort import FULL, QUICK, Effort
from server.bench.hard_cases import light_cases, outcomes
from server.bench.hard_scenes import scene_cases
from server.bench.machine import machine_record
from server.bench.needs import Need, needs, needs_table
from server.bench.pipelines import Pipelines
from server.bench.rows import Row, pooled
from server.bench.stages import frame_path, frame_path_table

BAD_INPUT = 2
Rows = Callable[[Pipelines, Effort], Iterator[Row]]
STAGES: tuple[tuple[str, str, Rows], ...] = (
    (radiance_rows.STAGE, radiance_rows.MEASURE, radiance_rows.radiance_rows),
    (light_rows.STAGE, light_rows.MEASURE, light_rows.light_rows),
    (diffuse_rows.STAGE, diffuse_rows.MEASURE, diffuse_rows.diffuse_rows),
    (glossy_rows.STAGE, glossy_rows.MEASURE, glossy_rows.glossy_rows),
    (shadow_rows.STAGE, shadow_rows.MEASURE, shadow_rows.shadow_rows),
    (composite_rows.STAGE, composite_rows.MEASURE, composite_rows.composite_rows),
    (whole_rows.STAGE, whole_rows.MEASURE, whole_rows.whole_rows),
    (ablation.STAGE, ablation.MEASURE, ablation.ablation_rows))
PERCENT = {"power", "share"}


@dataclass
class Report:
    """All that was measured. `hard`: what each case missed, None for nothing."""

    machine: dict[str, Any]
    effort: Effort
    rows: list[Row] = field(default_factory=list)
    hard: dict[str, str | None] = field(default_factory=dict)
    needs: list[Need] = field(default_factory=list)
    frame_path: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        by_stage = [pooled(row for row in self.rows if row.stage == stage) for stage, _, _ in STAGES]
        everything = self.rows + [row for rows in by_stage for row in rows if row.scene == "all"]
        return {"machine": self.machine, "effort": self.effort.name, "measures": {stage: measure for stage, measure, _ in STAGES},
                "rows": [row.as_json() for row in everything],
                "hard_cases": [{"case": name, "passed": missed is None, "missed": missed} for name, missed in self.hard.items()],
                "needs": [need.as_json() for need in self.needs], "frame_path": self.frame_path}


def run_bench(arguments: argparse.Namespace) -> int:
    """Print the report as it comes; write the JSON file and the plot. Returns the exit status: 1 if a hard case is missed."""
    try:
        write_plot = _plot_writer(arguments)
        if arguments.json is not None and not arguments.json.parent.is_dir():
            raise ValueError(f"json folder {str(arguments.json.parent)!r} does not exist")
        report = measured(QUICK if arguments.quick else FULL, partial(print, flush=True))
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(report.as_json(), indent=1) + "\n")
        write_plot(report)
    except (GLUnavailableError, ValueError, OSError) as error:
        print(f"mr360 bench: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    return int(any(report.hard.values()))


def _plot_writer(arguments: argparse.Namespace) -> Callable[[Report], None]:
    """matplotlib is needed only where a plot is asked for. Raises ValueError for a file that is no plot's, before any work."""
    if arguments.plot is None:
        return lambda report: None
    from server.bench.plot import check_suffix, write_plot

    check_suffix(arguments.plot)
    if not arguments.plot.parent.is_dir():
        raise ValueError(f"plot folder {str(arguments.plot.parent)!r} does not exist")
    return lambda report: write_plot(arguments.plot, report.rows, " | ".join(_heading(report.machine, report.effort)))


def measured(effort: Effort, say: Callable[[str], object]) -> Report:
    """Everything, one after another; `say` is given each line of the text."""
    context = Context()
    pipelines, started = Pipelines(context), time.perf_counter()
    report = Report(machine_record(context), effort)
    for line in _heading(report.machine, effort):
        say(line)
    for stage, measure, rows in STAGES:
        found = list(rows(pipelines, effort))
        report.rows += found
        for line in ("", *table(stage, measure, found)):
            say(line)
    report.hard = dict(outcomes(pipelines, {**light_cases(), **scene_cases()}))
    report.needs = list(needs(pipelines, effort))
    pipelines.release()
    report.frame_path = frame_path(context, effort.clip_frames, *effort.clip)
    context.release()
    report.machine |= {"load_average_end": os.getloadavg()[0], "seconds": round(time.perf_counter() - started, 1)}
    for line in (*_hard_lines(report.hard), "", *needs_table(report.needs), "", *frame_path_table(report.frame_path), "",
                 f"load at the end {report.machine['load_average_end']:.2f}, {report.machine['seconds']:.0f} s"):
        say(line)
    return report


def _heading(machine: dict[str, Any], effort: Effort) -> tuple[str, ...]:
    threads = machine["LP_NUM_THREADS"] or "unset"
    return (f"{machine['processors']} x {machine['cpu']}, {machine['renderer']}, LP_NUM_THREADS {threads}",
            f"{effort.name}: stages {effort.repeats} times, live sequences {effort.frames} frames of "
            f"{effort.size[0]}x{effort.size[1]}, worlds {', '.join(effort.worlds)}, "
            f"load {machine['load_average_start']:.2f}, {machine['date']}")


def table(stage: str, measure: str, rows: list[Row]) -> Iterator[str]:
    """A stage's rows, all scenes together: the methods that a preset uses are marked, errors are percent of the unit."""
    yield stage.upper()
    yield from _wrapped(measure)
    together = pooled(rows)
    extras = list(dict.fromkeys(name for row in together for name in row.extra))
    yield (f"{'':9}{'method':36}{'p50 ms':>9}{'p95':>9}{'rms %':>9}{'p99':>9}{'max':>9}{'bias':>9}"
           + "".join(f"{name + (' %' if name in PERCENT else ''):>14}" for name in extras))
    for row in together:
        figures = row.as_json()
        times = "".join(_number(figures[name]) for name in ("ms_p50", "ms_p95"))
        errors = "".join(_number(figures[name], 100) for name in ("err_rms", "err_p99", "err_max", "bias"))
        yield f"{row.mark:9}{row.name:36}{times}{errors}" + "".join(
            _number(row.extra.get(name), 100 if name in PERCENT else 1, 14) for name in extras)


def _number(value: float | None, factor: float = 1.0, width: int = 9) -> str:
    return f"{'-':>{width}}" if value is None else f"{factor * value:{width}.2f}"


def _wrapped(text: str, width: int = 128) -> Iterator[str]:
    line = ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > width:
            yield line
            line = ""
        line = f"{line} {word}".strip()
    yield line


def _hard_lines(hard: dict[str, str | None]) -> Iterator[str]:
    missed = {name: text for name, text in hard.items() if text is not None}
    yield ""
    yield f"HARD CASES: {len(hard) - len(missed)} of {len(hard)} passed"
    for name, text in missed.items():
        yield f"    missed: {name}: {text}"
