"""Prometheus metrics. Their names are a promise to whoever draws graphs of them: do not rename."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

if TYPE_CHECKING:
    from server.outputs.output import Output
    from server.stream import Stream

RENDER_BUCKETS_S = (0.002, 0.004, 0.006, 0.008, 0.012, 0.016, 0.02, 0.033, 0.05, 0.1, 0.25)
LATENCY_BUCKETS_S = (0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.1, 0.15, 0.25, 0.5, 1.0, 2.0)
FRAME_COUNTERS = {
    "frames_in": "Frames decoded from the source",
    "frames_rendered": "Frames composited",
    "frames_encoded": "Frames encoded",
    "frames_dropped": "Frames dropped before the encoder",
}
DELIVERY_COUNTERS = {
    "rtp_packets_sent": "RTP packets of pictures sent for the first time, all viewers",
    "rtp_bytes_sent": "Bytes of their payloads, retransmissions included",
    "rtp_packets_resent": "RTP packets sent again",
    "rtp_packets_nacked": "RTP packets that viewers asked for again",
    "rtp_packets_lost": "RTP packets that viewers reported lost, before retransmission",
    "keyframe_requests": "Keyframes that viewers asked for (PLI, FIR)",
    "rendition_steps_down": "Viewers switched to a smaller rendition",
    "rendition_steps_up": "Viewers switched to a larger rendition",
}
# The worker's words for them, and ours.
QUALITY_GAUGES = {"load": "load", "level": "quality_level", "predicted_error": "quality_predicted_error"}


class Metrics:
    """The service's own registry."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.frames = {name: Counter(f"mr360_{name}", text, ["stream"], registry=self.registry)
                       for name, text in FRAME_COUNTERS.items()}
        self.render_seconds = Histogram("mr360_render_seconds", "Time to composite one frame", ["stream"],
                                        buckets=RENDER_BUCKETS_S, registry=self.registry)
        self.latency_seconds = Histogram("mr360_latency_seconds", "From decoded frame to packet handed to WebRTC",
                                         ["stream"], buckets=LATENCY_BUCKETS_S, registry=self.registry)
        self._gauges = {name: Gauge(f"mr360_{name}", text, ["stream"], registry=self.registry) for name, text in (
            ("viewers", "Viewers that receive media"),
            ("worker_ready", "1 when the worker is ready"),
            ("worker_restarts", "Times the worker was replaced"),
            ("packets_delivered", "Encoded frames handed to WebRTC, all viewers"),
            ("dropped_after_encoder", "Encoded frames that slow viewers lost"),
            ("load", "Time that a frame takes at its effort, light included, by the time between two frames"),
            ("quality_level", "Reductions of accuracy in force, for lack of time"),
            ("quality_predicted_error", "Relative error that they are predicted to make"),
        )}
        self._delivery = {name: Counter(f"mr360_{name}", text, ["stream"], registry=self.registry)
                          for name, text in DELIVERY_COUNTERS.items()}
        self._delivered: dict[str, dict[str, int]] = {}      # stream: what its counters stand at
        self._tracks = {name: Gauge(f"mr360_track_{name}", text, ["stream", "track"], registry=self.registry) for name, text in (
            ("takers", "Viewers and outputs of an encoded track"),
            ("bitrate_bps", "Bits per second that its encoder gives"),
        )}
        labels = ["stream", "output"]
        self._output_up = Gauge("mr360_output_up", "1 when the output is live", labels, registry=self.registry)
        self._output_counters = {
            "bytes": Counter("mr360_output_bytes", "Bytes of packets that went out", labels, registry=self.registry),
            "restarts": Counter("mr360_output_restarts", "Times the output was tried again", labels, registry=self.registry)}
        self._outputs_counted: dict[tuple[str, str], dict[str, int]] = {}
        self.decisions = Counter("mr360_quality_decisions", "Accuracy given up or taken back", ["stream"],
                                 registry=self.registry)

    def exposition(self, streams: Iterable[Stream]) -> bytes:
        """The text that Prometheus scrapes."""
        streams = list(streams)
        self._set_outputs({(stream.name, output.spec.id): output for stream in streams for output in stream.outputs})
        for stream in streams:
            self._delivery_of(stream)
            values = {"viewers": stream.tracks.viewers, "worker_ready": int(stream.ready),
                      "worker_restarts": stream.restarts, "packets_delivered": stream.tracks.delivered,
                      "dropped_after_encoder": stream.tracks.dropped,
                      **{QUALITY_GAUGES[key]: value for key, value in stream.worker_stats.get("quality", {}).items()
                         if key in QUALITY_GAUGES}}
            for name, value in values.items():
                self._gauges[name].labels(stream.name).set(value)
        return generate_latest(self.registry)

    def _delivery_of(self, stream: Stream) -> None:
        counts, before = stream.tracks.counts(), self._delivered.setdefault(stream.name, {})
        for name, counter in self._delivery.items():
            # rtp_packets_lost is the viewers' own count, which may go back when a late packet comes
            counter.labels(stream.name).inc(max(0, counts[name] - before.get(name, 0)))
            before[name] = max(counts[name], before.get(name, 0))
        for track, takers, bps in stream.tracks.load():
            self._tracks["takers"].labels(stream.name, track).set(takers)
            self._tracks["bitrate_bps"].labels(stream.name, track).set(bps)

    def _set_outputs(self, outputs: dict[tuple[str, str], Output]) -> None:
        for key in self._outputs_counted.keys() - outputs.keys():
            del self._outputs_counted[key]
            for metric in (self._output_up, *self._output_counters.values()):
                metric.remove(*key)
        for key, output in outputs.items():
            self._output_up.labels(*key).set(int(output.live))
            counted = self._outputs_counted.get(key, {"bytes": 0, "restarts": 0})
            counts = {"bytes": output.bytes_out, "restarts": output.restarts}
            for name, counter in self._output_counters.items():
                # Below what has been counted: another output of that id took its place between two scrapes.
                counter.labels(*key).inc(counts[name] - counted[name] if counts[name] >= counted[name] else counts[name])
            self._outputs_counted[key] = counts

    def forget(self, stream: str) -> None:
        """Remove the series of a stream that is deleted."""
        self._delivered.pop(stream, None)
        for metric in (*self._delivery.values(), *self._tracks.values(), *self.frames.values(), self.decisions, self.render_seconds,
                       self.latency_seconds, *self._gauges.values()):
            metric.remove_by_labels({"stream": stream})


class StreamMetrics:
    """What one stream counts."""

    def __init__(self, metrics: Metrics, stream: str) -> None:
        self.render_seconds = metrics.render_seconds.labels(stream)
        self.latency_seconds = metrics.latency_seconds.labels(stream)
        self._frames = {name: metrics.frames[name].labels(stream) for name in FRAME_COUNTERS}
        self._decisions = metrics.decisions.labels(stream)
        self._counted = dict.fromkeys((*FRAME_COUNTERS, "decisions"), 0)

    def worker_stats(self, stats: dict[str, Any]) -> None:
        """Add what has happened since the worker's last message; a worker counts from its own start."""
        counts = {name: int(stats[name]) for name in FRAME_COUNTERS} | {"decisions": int(stats["quality"]["decisions"])}
        for name, counter in (*self._frames.items(), ("decisions", self._decisions)):
            counter.inc(max(0, counts[name] - self._counted[name]))
        self._counted = counts

    def worker_ended(self) -> None:
        self._counted = dict.fromkeys(self._counted, 0)
