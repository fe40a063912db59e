"""Time against error as a picture: one Pareto front a stage. matplotlib is imported here and nowhere else."""

from __future__ import annotations

import itertools
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from server.bench.rows import Row, pooled

SUFFIXES = (".png", ".svg")
LEAST_ERROR = 1e-6      # where what is exact is drawn
COLUMNS = 3
COLOURS = {"default": "#c0392b", "paper": "#2471a3", "": "#7f8c8d"}
MARKERS = {"default": "*", "paper": "D", "": "o"}
LINES = ("-", "--", "-.", ":")       # by condition
SIZES = {"default": 130, "paper": 46, "": 26}


def check_suffix(path: Path) -> None:
    """Raises ValueError unless a plot can be written to a file of that name."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"plot {path.name!r}, expected a name that ends in {' or '.join(SUFFIXES)}")


def write_plot(path: Path, rows: list[Row], title: str) -> None:
    """One diagram a stage that has times, all scenes together; both axes logarithmic."""
    stages = [stage for stage in dict.fromkeys(row.stage for row in rows) if _points([row for row in rows if row.stage == stage])]
    lines = max(1, -(-len(stages) // COLUMNS))
    figure = Figure(figsize=(5.4 * COLUMNS, 4.6 * lines), layout="constrained")
    figure.suptitle(title, fontsize=10)
    axes = figure.subplots(lines, COLUMNS, squeeze=False).ravel()
    for axis, stage in zip(axes, stages, strict=False):
        _draw(axis, stage, pooled(row for row in rows if row.stage == stage))
    for axis in axes[len(stages):]:
        axis.set_axis_off()
    figure.savefig(path, dpi=110)


def _points(rows: list[Row]) -> list[tuple[float, float, Row]]:
    found = []
    for row in rows:
        milliseconds, error = row.percentile_ms(50), row.err_rms
        if milliseconds is not None and error is not None and row.mark != "null":
            found.append((milliseconds, max(error, LEAST_ERROR), row))
    return found


def front(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other one beats in both, by rising first coordinate."""
    found: list[tuple[float, float]] = []
    for one in sorted(points):
        if not found or one[1] < found[-1][1]:
            found.append(one)
    return found


def _draw(axis: Axes, stage: str, rows: list[Row]) -> None:
    """A front for each condition; what is measured under different ones is not compared."""
    conditions = list(dict.fromkeys(row.condition for row in rows))
    for condition, line in zip(conditions, itertools.cycle(LINES), strict=False):
        chosen = [row for row in rows if row.condition == condition]
        _draw_condition(axis, condition, line, chosen)
    if len(conditions) > 1:
        axis.legend(fontsize=6, loc="upper right", framealpha=0.7)
    axis.set(title=stage, xscale="log", yscale="log", xlabel="median time, ms", ylabel="error, rms")
    axis.margins(0.2)
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter(LogFormatter(minor_thresholds=(1.5, 0.4)))
        side.set_minor_formatter(LogFormatter(minor_thresholds=(1.2, 0.4)))
    axis.tick_params(which="both", labelsize=7)
    axis.grid(visible=True, which="major", linewidth=0.3)


def _draw_condition(axis: Axes, condition: str, line: str, rows: list[Row]) -> None:
    points = _points(rows)
    edge = front([(x, y) for x, y, _ in points])
    axis.step([x for x, _ in edge], [y for _, y in edge], where="post", color="#2c3e50", linewidth=1, linestyle=line, alpha=0.6,
              zorder=1, label=condition)
    for x, y, row in points:
        axis.scatter([x], [y], s=SIZES[row.mark], c=COLOURS[row.mark], marker=MARKERS[row.mark], zorder=3)
    for index, (x, y, row) in enumerate(sorted(points, key=lambda point: point[:2])):
        axis.annotate(f"{row.method} {row.params}", (x, y), xytext=(5, 5 if index % 2 else -9), textcoords="offset points",
                      fontsize=6, color=COLOURS[row.mark])
    for row in rows:
        if row.mark == "null":
            error = max(row.err_rms or 0.0, LEAST_ERROR)
            axis.axhline(error, color="#95a5a6", linewidth=0.8, linestyle=line)
            axis.annotate("nothing done", (0.01, error), xycoords=("axes fraction", "data"), ha="left", va="bottom", fontsize=6,
                          color="#7f8c8d")
