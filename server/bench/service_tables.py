"""The whole-service benchmark's report as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from server.demo.report import WINDOW_FRAMES

Report = Mapping[str, Any]
RATIO_BARS = {"2048x1024": (1.6, 1.35)}     # worker over transcode: at most, and what would be better still
SHARE_BARS = {"2048x1024": 0.60}            # of all processors
HELD = 0.98                                 # of the camera's frames a second, and the rate counts as held
QUIET_CORES = 0.1                           # that others may use before a figure is marked as disturbed
LABEL = 36
_COUNTS = (("seconds measured", "seconds", ".1f"), ("frames out", "frames_out", "d"), ("frames/s out", "fps", ".2f"),
           ("frames dropped before the encoder", "frames_dropped", "d"), ("cores that others used meanwhile", "other_cores", ".2f"))


def machine_lines(machine: Report) -> Iterator[str]:
    yield (f"{machine['processors']} x {machine['model']}, load average {machine['load_average']:.2f} at the start, "
           f"LP_NUM_THREADS {machine['lp_num_threads'] or 'not set'}")


def service_lines(run: Report) -> Iterator[str]:
    """One size and clip: the service between two transcodes."""
    before, service, after = run["transcodes"][0], run["service"], run["transcodes"][1]
    columns = (before, service, after)
    yield (f"{run['size']}, {run['clip']} clip, {run['fps']} frames/s; five objects, {run['triangles']} triangles "
           f"({run['knot_triangles']} in the mesh, {run['teapot_triangles']} in the teapot); {service['renderer']}")
    yield f"{'':{LABEL}}{'transcode':>12}{'service':>12}{'transcode':>12}"
    for label, key, form in _COUNTS:
        yield _row(label, (column[key] for column in columns), form)
    cost = service["cpu_ms_per_frame"]
    yield _row("processor ms a frame: worker", (before["cpu_ms_per_frame"], cost["worker"], after["cpu_ms_per_frame"]), ".2f")
    yield _row("  decoded once a frame in", (column["cost_ms"] for column in columns), ".2f")
    for name in ("server", "publisher", "viewer"):
        yield _row(f"  {name}{'' if name == 'server' else ', not ours'}", (None, cost[name], None), ".2f")
    for name in _thread_names(columns):
        yield _row(f"  thread {name}", (column["threads_ms_per_frame"].get(name) for column in columns), ".2f")
    peaks = [column["peak_mb"] for column in columns]
    yield _row("peak memory MB: worker", (peaks[0]["transcode"], peaks[1]["worker"], peaks[2]["transcode"]), ".0f")
    yield _row("  server", (None, peaks[1]["server"], None), ".0f")
    yield from _percentile_lines(service)
    yield from _verdict_lines(run)


def _thread_names(columns: Sequence[Report]) -> list[str]:
    """By cost in the service; what costs next to nothing is left out."""
    most: dict[str, float] = {}
    for column in (columns[1], columns[0], columns[2]):
        for name, cost in column["threads_ms_per_frame"].items():
            most[name] = max(cost, most.get(name, 0.0))
    return [name for name, cost in most.items() if cost >= 0.05]


def _percentile_lines(service: Report) -> Iterator[str]:
    yield f"{'service, ms':{LABEL}}{'p50':>12}{'p95':>12}{'max':>12}"
    for label, figures in (("render", service["render_ms"]), ("latency, decoded to handed to WebRTC", service["latency_ms"]),
                           *((f"  {name}", figures) for name, figures in service["stages_ms"].items())):
        if figures is not None:
            yield _row(label, (figures[key] for key in ("p50", "p95", "max")), ".2f")


def _verdict_lines(run: Report) -> Iterator[str]:
    service, ratio = run["service"], run["ratio"]
    bars = RATIO_BARS.get(run["size"])
    yield (f"ratio worker / transcode: {ratio['worker']:.2f}{_judged(ratio['worker'], bars)}"
           f"; by each transcode alone {ratio['range'][0]:.2f} to {ratio['range'][1]:.2f}")
    yield f"ratio (worker + server's sending) / transcode, which sends nothing: {ratio['worker_and_server']:.2f}"
    share, most = run["share_of_processors"], SHARE_BARS.get(run["size"])
    yield (f"worker and server need {share:.1%} of {run['processors']} processors for {run['fps']} frames/s"
           + ("" if most is None else f" (bar {most:.0%}: {'met' if share <= most else 'missed'})"))
    yield f"light read every {service['light_interval']:.1f} frames; {service['touched_fraction']:.1%} of the picture touched"
    yield f"{run['fps']} frames/s: the service {_holds(service, run)}, the transcode {_holds(run['transcodes'][0], run)}"
    if service["frames_out"] < WINDOW_FRAMES:
        yield f"fewer than {WINDOW_FRAMES} frames were measured: percentiles reach back into the warm-up"
    if max(column["other_cores"] for column in (*run["transcodes"], service)) > QUIET_CORES:
        yield "others worked on this machine meanwhile: times and ratios are worse and less certain than on a quiet one"


def _judged(ratio: float, bars: tuple[float, float] | None) -> str:
    if bars is None:
        return ""
    most, better = ("met" if ratio <= bar else "missed" for bar in bars)
    return f" (bar {bars[0]}: {most}; stretch {bars[1]}: {better})"


def _holds(column: Report, run: Report) -> str:
    return "holds them" if column["fps"] >= HELD * run["fps"] else f"does not hold them ({column['fps']:.1f})"


def viewer_lines(runs: Sequence[Report]) -> Iterator[str]:
    size = runs[0]["size"]
    yield f"viewers at {size}, {runs[0]['clip']} clip: all receive the same packets in one process and decode nothing"
    yield (f"{'viewers':>8}{'frames/s out':>14}{'of the slowest':>16}{'lost to them':>14}{'Mbit/s each':>13}{'server ms/frame':>17}"
           f"{'a viewer':>10}{'worker':>9}{'receiving':>11}{'latency p50':>13}{'p95':>8}{'others':>8}")
    for run in runs:
        service = run["service"]
        count, cost, latency = service["viewers"], service["cpu_ms_per_frame"], service["latency_ms"]
        yield (f"{count:8}{service['fps']:14.2f}{run['slowest_fps']:16.2f}{service['dropped_after_encoder']:14}"
               f"{run['mbps_each']:13.2f}"
               f"{cost['server']:17.2f}{cost['server'] / count:10.2f}{cost['worker']:9.2f}{cost['viewer']:11.2f}"
               f"{latency['p50']:13.1f}{latency['p95']:8.1f}{service['other_cores']:8.2f}")


def scaling_lines(title: str, unit: str, rows: Sequence[Report]) -> Iterator[str]:
    """`rows` have `count`, `note` and figures by condition."""
    yield f"{title}; milliseconds, wall time but for cpu"
    yield f"{'':10}" + "".join(f"{condition:>34}" for condition in rows[0]["conditions"])
    yield f"{unit:>10}" + f"{'render p50':>12}{'p95':>7}{'light':>7}{'cpu':>8}" * len(rows[0]["conditions"])
    for row in rows:
        cells = (f"{cell['render_ms']['p50']:12.1f}{cell['render_ms']['p95']:7.1f}{cell['light_ms']['p50']:7.1f}"
                 f"{cell['cpu_ms_per_frame']:8.1f}" for cell in row["conditions"].values())
        yield f"{row['count']:>10}" + "".join(cells) + f"  {row['note']}"


def _row(label: str, values: Iterator[Any] | Sequence[Any], form: str) -> str:
    return f"{label:{LABEL}}" + "".join(f"{'-' if value is None else format(value, form):>12}" for value in values)
