"""Hands the stream's packets to the delivery's own RTP sender, for the one peer connection of a WHIP client."""

from __future__ import annotations

from collections.abc import Callable

from aiortc import RTCPeerConnection

from server.delivery.codecs import opus, with_retransmission
from server.delivery.fanout import EncodedFrame, Taker
from server.delivery.feed import FeedTrack
from server.delivery.reception import Reception, Report
from server.delivery.stream_clock import VIDEO_CLOCK_HZ, StreamClock


class PushedFeed:
    """Frames as the server pushes them; cut to the next keyframe where the connection is slower."""

    def __init__(self, codec: str, clock: StreamClock, request_keyframe: Callable[[], None]) -> None:
        self.codec = codec
        self.clock = clock
        self.reception = Reception()
        self.request_keyframe = request_keyframe
        self._taker = Taker(request_keyframe, needs_keyframe=codec == "h264")

    @property
    def at_once(self) -> bool:
        return False        # the media server's viewers decide

    def push(self, frame: EncodedFrame) -> None:
        if self.codec == "h264":
            self.clock.start(frame.timestamp, VIDEO_CLOCK_HZ, frame.decoded_at)
        self._taker.offer(frame)

    async def next_frame(self) -> EncodedFrame:
        return await self._taker.next_frame()

    def close(self) -> None:
        """Nobody else holds anything of it."""


def add_feeds(connection: RTCPeerConnection, request_keyframe: Callable[[], None], *, sound: bool) -> dict[str, PushedFeed]:
    """Feeds for `picture`, as H.264, and `sound`, if there is any, as Opus. To be called before the offer is made; the process
    has `aiortc_hooks.install` behind it."""
    clock = StreamClock()
    feeds = {"picture": PushedFeed("h264", clock, request_keyframe)}
    feeds["picture"].reception.heard = lambda report: _after_silence(report, request_keyframe)
    video = connection.addTransceiver(FeedTrack("video", feeds["picture"]), direction="sendonly")
    video.setCodecPreferences(with_retransmission("h264"))
    if sound:
        feeds["sound"] = PushedFeed("opus", clock, lambda: None)
        audio = connection.addTransceiver(FeedTrack("audio", feeds["sound"]), direction="sendonly")
        audio.setCodecPreferences(opus())
    return feeds


def _after_silence(report: Report, request_keyframe: Callable[[], None]) -> None:
    if report.after_silence:
        request_keyframe()      # whatever the other side has is broken
