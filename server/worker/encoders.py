"""Owner of the encode threads: one for each track of pictures that somebody wants, none for the others."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from server.renditions import LADDER, Rendition
from server.worker.encode import ENCODERS, Composited, EncodeThread, Plan
from server.worker.h264 import default_bitrate
from server.worker.scaler import scaled_size

logger = logging.getLogger(__name__)
GRACE_S = 2.0       # an encoder that nobody wants any more is kept for this long, for somebody who comes back

OnTrackPacket = Callable[[str, bytes, bool, Composited], None]


class Encoders:
    """Tracks are named by rendition and codec: `full/h264`, `low/vp8`. All but `on_packet`'s calls and the figures belong to the
    thread that owns it."""

    def __init__(self, on_packet: OnTrackPacket, ladder: Iterable[Rendition] = LADDER, bitrate_bps: int | None = None) -> None:
        self._on_packet = on_packet
        self._ladder = {rendition.name: rendition for rendition in ladder}
        self._bitrate = bitrate_bps                         # of the full picture; None: by geometry
        self._track_bitrates: dict[str, int] = {}
        self._threads: dict[str, EncodeThread] = {}
        self._unwanted_since: dict[str, float] = {}
        self._ending: list[EncodeThread] = []
        self._first = ""                                    # the track whose frames are counted
        self._counted = -1
        self.fps = 30.0
        self.frames_encoded = 0                             # of the first track that is wanted, in the ladder's order
        self.frames_dropped = 0                             # that this track has lost before its encoder
        self.frames_lost = 0                                # that any wanted track has lost

    @property
    def wanted(self) -> list[str]:
        """In the ladder's order, H.264 before VP8."""
        return [track for track in self._tracks() if track in self._threads and track not in self._unwanted_since]

    def want(self, tracks: Iterable[str]) -> None:
        """Encode these tracks and no others. Each that is new, or wanted again, begins with a keyframe."""
        now, known = time.monotonic(), set(self._tracks())
        asked = set(tracks)
        for track in asked - known:
            logger.warning("track %r is not known, expected one of %s", track, ", ".join(self._tracks()))
        for track in self._threads.keys() - asked:
            self._unwanted_since.setdefault(track, now)
        for track in asked & known:
            if track not in self._threads:
                self._threads[track] = self._thread(track)
            elif self._unwanted_since.pop(track, None) is not None:
                self._threads[track].request_keyframe()
        self._first = next(iter(self.wanted), "")

    def put(self, item: Composited) -> None:
        """The newest composite, for each encoder that is wanted."""
        lost = []
        for track in self.wanted:
            pictures = self._threads[track].pictures
            before = pictures.dropped
            pictures.put(item)
            if pictures.dropped > before:
                lost.append(track)
        self.frames_dropped += self._first in lost
        self.frames_lost += bool(lost)

    def tend(self) -> None:
        """Release what nobody has wanted for a while. Raises what an encode thread died of."""
        for thread in self._threads.values():
            if thread.error is not None:
                raise thread.error
        now = time.monotonic()
        for track in [track for track, since in self._unwanted_since.items() if now - since >= GRACE_S]:
            del self._unwanted_since[track]
            thread = self._threads.pop(track)
            thread.stop(join_timeout=0.0)
            self._ending.append(thread)
        self._ending = [thread for thread in self._ending if thread.alive]

    def request_keyframe(self, track: str) -> None:
        if track in self._threads:
            self._threads[track].request_keyframe()

    def set_bitrate(self, bps: int | None, track: str | None = None) -> None:
        """Of one track; without one, of the full picture, from which the others follow. None: by the ladder and the geometry."""
        if track is None:
            self._bitrate = bps
        elif bps is None:
            self._track_bitrates.pop(track, None)
        else:
            self._track_bitrates[track] = bps

    def renditions(self, size: tuple[int, int]) -> list[dict[str, Any]]:
        """What the ladder makes of a full picture of that size, best first."""
        found = []
        for rendition in self._ladder.values():
            width, height = scaled_size(size, rendition.scale)
            found.append({"name": rendition.name, "width": width, "height": height, "bitrate_bps": self.bitrate(size, rendition)})
        return found

    def bitrate(self, size: tuple[int, int], rendition: Rendition) -> int:
        """Bits per second for a full picture of that size: the rendition's own, or the full one's by the share of its pixels."""
        full = next((other.bitrate_bps for other in self._ladder.values() if other.scale == 1.0), None)
        return rendition.bitrate_bps or round((full or self._bitrate or default_bitrate(*size)) * rendition.scale ** 2)

    def report(self) -> dict[str, Any]:
        """Figures of each track that has an encoder."""
        return {track: {**thread.statistics.report(), "frames_dropped": thread.pictures.dropped}
                for track, thread in list(self._threads.items())}

    def close(self) -> None:
        """End all threads, wait for them."""
        for thread in self._threads.values():
            thread.stop(join_timeout=0.0)
        for thread in (*self._threads.values(), *self._ending):
            thread.stop()

    def _tracks(self) -> list[str]:
        return [f"{name}/{codec}" for name in self._ladder for codec in ENCODERS]

    def _thread(self, track: str) -> EncodeThread:
        name, codec = track.split("/")
        return EncodeThread(partial(self._packet, track), plan=partial(self._plan, track, self._ladder[name]), codec=codec,
                            name=f"{track} enc")

    def _plan(self, track: str, rendition: Rendition, size: tuple[int, int]) -> Plan:
        bitrate_bps = self._track_bitrates.get(track) or self.bitrate(size, rendition)
        return Plan(scaled_size(size, rendition.scale), round(self.fps), bitrate_bps)

    def _packet(self, track: str, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        if track == self._first and item.timestamp > self._counted:     # another may have been the first a moment ago
            self._counted = item.timestamp
            self.frames_encoded += 1
        self._on_packet(track, payload, is_keyframe, item)
