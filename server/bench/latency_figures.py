"""What `make bench-latency` makes of the frames that were seen, and its report as text."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

from server.bench.latency_page import Shown
from server.bench.service_run import Report
from server.bench.service_tables import machine_lines
from server.bench.viewers import percentiles
from server.demo.watch import DemoError

MOST_MS = {"p50": 120.0, "p95": 180.0}
MIN_FRAMES = 200
COUNTERS = ("framesDecoded", "framesDropped", "freezeCount", "packetsLost", "nackCount", "pliCount")


def frame_figures(shown: Sequence[Shown], capture_clock: float) -> Report:
    """Percentiles in milliseconds of all frames with a time code, as a whole and from stage to stage. Raises DemoError when most
    have none."""
    coded = [(one, one.coded_at) for one in shown if one.coded_at is not None]
    if not coded or len(coded) < len(shown) / 2:
        raise DemoError(f"a time code could be read in {len(coded)} of {len(shown)} frames")
    stamped = [(one, at, capture_clock + one.rtp_timestamp / 90_000) for one, at in coded if one.rtp_timestamp is not None]
    received = [(one, one.received_at) for one, _ in coded if one.received_at is not None]
    gaps = [after.displayed_at - before.displayed_at for before, after in itertools.pairwise(shown)]
    return {
        "frames": len(coded), "without_code": len(shown) - len(coded), "width": shown[-1].width,
        "not_presented": shown[-1].presented - shown[0].presented + 1 - len(shown),
        "glass_to_glass_ms": _ms(one.displayed_at - at for one, at in coded),
        "stages_ms": {
            "time code to decoded by the service": _ms(decoded - at for _, at, decoded in stamped),
            "decoded to received by the browser": _ms(one.received_at - decoded for one, _, decoded in stamped if one.received_at),
            "received to callback": _ms(one.called_at - at for one, at in received),
            "  of which decoding": _ms(one.decode_s for one, _ in received),
            "callback to display": _ms(one.displayed_at - one.called_at for one, _ in coded)},
        "longest_gap_ms": round(1e3 * max(gaps, default=0.0), 1)}


def browser_figures(before: Report, after: Report) -> Report:
    """Means over a period in milliseconds, and counters, by two readings of `inbound-rtp`."""
    def grown(name: str) -> float:
        return float(after.get(name, 0) - before.get(name, 0))

    def mean_ms(total: str, count: str) -> float | None:
        return round(1e3 * grown(total) / grown(count), 2) if grown(count) else None

    return {"jitter_buffer_ms": mean_ms("jitterBufferDelay", "jitterBufferEmittedCount"),
            "jitter_buffer_target_ms": mean_ms("jitterBufferTargetDelay", "jitterBufferEmittedCount"),
            "decode_ms": mean_ms("totalDecodeTime", "framesDecoded"),
            "processing_ms": mean_ms("totalProcessingDelay", "framesDecoded"),
            "assembly_ms": mean_ms("totalAssemblyTime", "framesAssembledFromMultiplePackets"),
            "decoder": after.get("decoderImplementation"),
            **{name: int(grown(name)) for name in COUNTERS}}


def _ms(values: Iterable[float]) -> dict[str, float] | None:
    return percentiles([1e3 * value for value in values])


def report_lines(report: Report) -> Iterator[str]:
    yield from machine_lines(report["machine"])
    yield (f"{report['size']}, {report['fps']} frames/s, {report['bitrate_bps'] / 1e6:g} Mbit/s; {report['frames']} frames with "
           f"a time code, {report['without_code']} without; width {report['width']}")
    yield f"{'ms':44}{'p50':>9}{'p95':>9}{'max':>9}"
    figures = {"glass to glass": report["glass_to_glass_ms"], **report["stages_ms"],
               "(camera's encoder)": report["camera_encode_ms"],
               "(service: decoded to handed to WebRTC)": report["server_ms"], "(service: render)": report["render_ms"]}
    for name, one in figures.items():
        if one is not None:
            yield f"{name:44}" + "".join(f"{one[key]:9.1f}" for key in ("p50", "p95", "max"))
    yield "browser, means: " + ", ".join(f"{name} {value}" for name, value in report["browser"].items())
    yield (f"longest pause between two frames {report['longest_gap_ms']:.0f} ms; frames that were not presented "
           f"{report['not_presented']}; frames dropped before the encoder {report['dropped']}; the browser's clock is "
           f"{report['clock_offset_ms']:+.2f} ms ahead (±{report['clock_error_ms']:.2f}); {report['cores_in_use']:.2f} cores "
           "in use")
    whole = report["glass_to_glass_ms"]
    yield "; ".join(f"{name} {whole[name]:.0f} ms (bar {bar:g}: {'met' if whole[name] <= bar else 'missed'})"
                    for name, bar in MOST_MS.items())
    if report["frames"] < MIN_FRAMES:
        yield f"fewer than {MIN_FRAMES} frames: the percentiles say little"
