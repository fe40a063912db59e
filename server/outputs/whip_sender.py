"""Hands the stream's packets to one peer connection of a WHIP client, by the sender that viewers get."""

from __future__ import annotations

import time
from collections.abc import Callable

from aiortc import RTCPeerConnection

from server.delivery.codecs import opus, with_retransmission
from server.delivery.fanout import EncodedFrame, FanOut
from server.delivery.feed import FeedTrack
from server.delivery.stream_clock import StreamClock
from server.delivery.subscription import TrackFeed

CLOCK_HZ = {"video": 90_000, "audio": 48_000}


class PushTrack:
    """Fed by `push`; cut to the next keyframe when the connection is slower than that."""

    def __init__(self, kind: str, fanout: FanOut, clock: StreamClock) -> None:
        self._rate, self._fanout, self._clock = CLOCK_HZ[kind], fanout, clock

    def push(self, timestamp: int, data: bytes, *, keyframe: bool) -> bool:
        """Returns whether there is a connection that takes it."""
        now = time.monotonic()
        self._clock.start(timestamp, self._rate, now)
        self._fanout.publish(EncodedFrame(data, timestamp, keyframe=keyframe, decoded_at=now))
        return len(self._fanout) > 0


def add_tracks(connection: RTCPeerConnection, request_keyframe: Callable[[], None], *, sound: bool) -> dict[str, PushTrack]:
    """Video as H.264 and, if there is sound, Opus; to be called before the offer is made. PLI and FIR call `request_keyframe`."""
    clock, tracks = StreamClock(), {}
    for kind in ("video", "audio") if sound else ("video",):
        fanout = FanOut(request_keyframe=request_keyframe if kind == "video" else _nothing, takers_changed=_nothing,
                        keyframes=kind == "video")
        feed = TrackFeed(fanout, "h264" if kind == "video" else "opus", clock)
        transceiver = connection.addTransceiver(FeedTrack(kind, feed), direction="sendonly")
        transceiver.setCodecPreferences(with_retransmission("h264") if kind == "video" else opus())
        tracks[kind] = PushTrack(kind, fanout, clock)
    return tracks


def _nothing() -> None:
    """Sound has no keyframes, and nobody here wants to know who listens."""
