"""The report of `make bench-viewers` as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from server.bench.service_tables import QUIET_CORES, machine_lines

Report = Mapping[str, Any]
MOST_CORES_A_VIEWER = 0.025     # at 10 Mbit/s
MOST_JOIN_MS = 1000.0
_COLUMNS = (("viewers", 8), ("frames/s: sent", 15), ("least", 7), ("mean", 7), ("Mbit/s", 8), ("dropped", 9), ("cut", 5),
            ("broken", 8), ("lost", 6), ("resent", 8), ("ms p50", 8), ("p95", 7), ("join p50", 10), ("p95", 7), ("max", 7),
            ("server %", 10), ("a viewer", 10), ("worker %", 10), ("receivers %", 13), ("others %", 10))


def heading_lines(report: Report) -> Iterator[str]:
    yield from machine_lines(report["machine"])
    yield (f"{report['size']}, {report['fps']} frames/s, {report['bitrate_bps'] / 1e6:g} Mbit/s wanted; WebRTC peers in one "
           "process that decode nothing; % of one core")
    yield ("dropped: before the encoder; cut: frames dropped after it; broken: frames not whole, or not decodable for that; "
           "ms: from the decoded source frame to the whole frame at the viewer; join: to the first whole keyframe")
    yield "".join(f"{name:>{width}}" for name, width in _COLUMNS)


def row_line(row: Report) -> str:
    cores, latency, join = row["cores"], row["latency_ms"] or {}, row["joins_ms"]
    values = (row["viewers"], *(f"{row[name]:.2f}" for name in ("fps_sent", "fps_min", "fps_mean", "mbps_each")),
              row["frames_dropped"], row["dropped_after_encoder"], row["incomplete"] + row["undecodable"], row["lost"],
              row["retransmitted"], latency.get("p50", "-"), latency.get("p95", "-"),
              *(f"{join[name]:.0f}" for name in ("p50", "p95", "max")), f"{100 * cores['server']:.1f}",
              f"{100 * cores['server'] / row['viewers']:.2f}", f"{100 * cores['worker']:.1f}", f"{100 * cores['viewer']:.1f}",
              f"{100 * row['other_cores']:.0f}")
    return "".join(f"{value:>{width}}" for value, (_, width) in zip(values, _COLUMNS, strict=True))


def churn_lines(report: Report) -> Iterator[str]:
    churn = report["churn"]
    alone = next(row for row in report["rows"] if row["viewers"] == churn["viewers"])
    join = churn["joins_ms"]
    yield (f"{churn['guests']} guests came and went in {churn['seconds']:.0f} s while {churn['viewers']} watched: the others lost "
           f"{churn['dropped_after_encoder']} frames after the encoder, {churn['incomplete'] + churn['undecodable']} on the way "
           f"and {churn['lost']} packets; pauses of more than three frames, each a minute: {_pauses(churn):.1f}, and "
           f"{_pauses(alone):.1f} while nobody came; "
           f"a guest had its picture after {join['p50']:.0f} ms, p95 {join['p95']:.0f}, at most {join['max']:.0f}")


def _pauses(figures: Report) -> float:
    return float(figures["gaps"] / figures["viewers"] / figures["seconds"] * 60)


def verdict_lines(report: Report) -> Iterator[str]:
    rows = report["rows"]
    if "slope" in report:
        slope = report["slope"]
        each = slope["cores_a_viewer"]
        yield (f"a further viewer costs {100 * each:.2f} % of a core (bar {100 * MOST_CORES_A_VIEWER:g} %: "
               f"{'met' if each <= MOST_CORES_A_VIEWER else 'missed'}), beside {100 * slope['cores_without']:.1f} % without any")
    slowest = max(row["joins_ms"]["max"] for row in rows)
    yield f"slowest join {slowest:.0f} ms (bar {MOST_JOIN_MS:g} ms: {'met' if slowest < MOST_JOIN_MS else 'missed'})"
    reports = [row["sender_reports_ms"] for row in rows if row["sender_reports_ms"] is not None]
    if reports:
        middle = sum(one["p50"] for one in reports) / len(reports)
        most = max(one["p95"] for one in reports)
        yield f"sender reports (RTCP) put a frame's time {middle:.1f} ms after its capture, p95 {most:.1f}"
    if max(row["other_cores"] for row in rows) > QUIET_CORES:
        yield "others worked on this machine meanwhile: times are worse and less certain than on a quiet one"
