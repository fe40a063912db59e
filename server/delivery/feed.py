"""What a sender sends: the frames of one viewer's choice of tracks, one after another."""

from __future__ import annotations

from typing import Protocol

import av
from aiortc import MediaStreamTrack
from aiortc.mediastreams import MediaStreamError

from server.delivery.fanout import EncodedFrame
from server.delivery.reception import Reception
from server.delivery.stream_clock import StreamClock


class Feed(Protocol):
    """One viewer's frames, and where what comes back from the viewer goes."""

    codec: str              # h264, vp8 or opus
    clock: StreamClock
    reception: Reception

    @property
    def at_once(self) -> bool:
        """Pictures are to be shown as soon as they are whole. With sound a viewer has to hold them back for it."""

    async def next_frame(self) -> EncodedFrame:
        """The next one to send."""

    def request_keyframe(self) -> None:
        """The viewer cannot go on without one."""

    def close(self) -> None:
        """Nothing more will be asked for. May be called again."""


class FeedTrack(MediaStreamTrack):
    """Stands for a feed where aiortc wants a track; `PacketSender` takes the frames from the feed itself."""

    def __init__(self, kind: str, feed: Feed) -> None:
        super().__init__()
        self.kind = kind
        self.feed = feed

    async def recv(self) -> av.Packet[av.VideoStream]:
        """No other sender than ours can send what a feed gives."""
        raise MediaStreamError

    def stop(self) -> None:
        self.feed.close()
        super().stop()
