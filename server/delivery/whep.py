"""A WHEP session: one peer connection per viewer, fed with the stream's shared packets.

A session ends when its viewer says so, when its connection fails or closes, when it does not connect in time, and with
its stream. Every end goes through `close`, which may be called any number of times.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

from aiortc import (
    RTCConfiguration,
    RTCIceCandidate,
    RTCPeerConnection,
    RTCRtpTransceiver,
    RTCSessionDescription,
)
from aiortc.exceptions import InvalidAccessError, InvalidStateError, OperationError

from server.delivery import ice
from server.delivery.codecs import opus, with_retransmission
from server.delivery.feed import FeedTrack
from server.delivery.ice_fragment import Fragment, fragment_text
from server.delivery.sdp_offer import CodecError, OfferError, parse_offer
from server.delivery.subscription import Choice, PictureFeed, SoundFeed
from server.stream import Stream

logger = logging.getLogger(__name__)

CONNECT_LIMIT_S = 15.0
NEGOTIATE_LIMIT_S = 10.0
CLOSE_LIMIT_S = 1.0
MAX_LOOKUPS = 16        # of names at a time: each is a question by multicast to everybody in the hall


_numbers = count(1)


class WhepSession:
    """One viewer's connection."""

    def __init__(self, stream: Stream, choice: Choice, address: str, closed: Callable[[WhepSession], None]) -> None:
        self.id = secrets.token_urlsafe(24)     # the session URL is what entitles to change or end the session
        self.number = next(_numbers)            # for people: the id is a secret
        self.etag = _new_tag()
        self.stream = stream
        self.address = address                  # of the viewer, as HTTP knows it
        self.connected = False                  # has been, at some time
        # An empty list, not None: None means Google's STUN server and a pause of 5 s where that cannot be reached.
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._choice = choice
        self._feeds: list[PictureFeed | SoundFeed] = []
        self.picture: PictureFeed | None = None     # from `negotiate` on
        self._closed = closed
        self._closing: asyncio.Task[None] | None = None
        self._username = ""                         # the viewer's, of the present generation of ICE
        self._head = ("video", "")                  # the section whose transport carries all media
        self._adding_late: set[asyncio.Task[None]] = set()
        self._started_at = time.monotonic()
        self._timer = asyncio.get_running_loop().call_later(CONNECT_LIMIT_S, self._not_connected)

    @property
    def closing(self) -> bool:
        return self._closing is not None

    def describe(self) -> dict[str, Any]:
        """The viewer as `GET /api/streams/{stream}/viewers` shows it."""
        return {"viewer": self.number, "state": self._connection.connectionState,
                "seconds": round(time.monotonic() - self._started_at, 1), "sound": len(self._feeds) > 1,
                **(self.picture.describe() if self.picture is not None else {})}

    async def negotiate(self, offer: str) -> str:
        """Take the offer, return the answer with all our ICE candidates.

        Raises:
            OfferError, CodecError: the offer cannot be answered. The session is to be closed then.
        """
        parsed = parse_offer(offer)
        stream = self.stream
        self.picture = PictureFeed(stream.tracks, stream.rendition_names, parsed.codec, self._choice, stream.delivered)
        video = self._send("video", self.picture)
        # Before the offer is set: aiortc chooses codecs there, else the offerer's first one, which is VP8 in browsers.
        video.setCodecPreferences(with_retransmission(parsed.codec))
        if parsed.sound:
            self.picture.sound = SoundFeed(stream.tracks)
            self._send("audio", self.picture.sound).setCodecPreferences(opus())
        self._connection.on("connectionstatechange", self._state_changed)
        try:
            async with asyncio.timeout(NEGOTIATE_LIMIT_S):
                await self._connection.setRemoteDescription(RTCSessionDescription(parsed.text, "offer"))
                await self._connection.setLocalDescription()
        except OperationError:
            raise CodecError("the offer has no H.264 baseline with packetization-mode=1, nor VP8") from None
        except TimeoutError:
            raise OfferError(f"the offer could not be answered in {NEGOTIATE_LIMIT_S:g} s") from None
        except (InvalidAccessError, InvalidStateError, ValueError, KeyError, AttributeError) as error:
            raise OfferError(f"the offer cannot be answered: {error}") from None
        self._username, self._head = parsed.username, parsed.head
        self._add_late(parsed.late)
        return parsed.complete(self._connection.localDescription.sdp)

    def _send(self, kind: str, feed: PictureFeed | SoundFeed) -> RTCRtpTransceiver:
        self._feeds.append(feed)
        return self._connection.addTransceiver(FeedTrack(kind, feed), direction="sendonly")

    def is_present_generation(self, fragment: Fragment) -> bool:
        """Whether the fragment belongs to the ICE credentials in use; one that names none does."""
        return fragment.username in (None, self._username)

    async def add_candidates(self, fragment: Fragment) -> None:
        """Take more of the viewer's ICE candidates. Raises OfferError."""
        with contextlib.suppress(InvalidStateError):    # closed meanwhile
            hidden = [candidate for candidate in fragment.candidates if candidate.ip.endswith(".local")]
            try:
                for candidate in fragment.candidates:
                    if candidate not in hidden:
                        await self._connection.addIceCandidate(candidate)
            except ValueError as error:
                raise OfferError(f"a candidate cannot be used: {error}") from None
            if fragment.complete and not hidden:
                await self._connection.addIceCandidate(None)
            self._add_late(hidden)

    def _add_late(self, candidates: Sequence[RTCIceCandidate]) -> None:
        """Candidates whose name is yet to be looked up, for which nobody waits."""
        for candidate in candidates[:max(0, MAX_LOOKUPS - len(self._adding_late))]:
            task = asyncio.create_task(self._connection.addIceCandidate(candidate))
            self._adding_late.add(task)
            task.add_done_callback(self._added)

    def _added(self, task: asyncio.Task[None]) -> None:
        self._adding_late.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.info("%s: a viewer's candidate cannot be used: %s", self.stream.name, error)

    async def restart_ice(self, fragment: Fragment) -> str:
        """Begin a new generation of ICE: media goes on over the old path until a new one is found.

        Returns:
            The fragment with our new credentials and candidates; `etag` is a new one.

        Raises:
            OfferError: nothing has changed then.
        """
        if fragment.username is None or fragment.password is None:
            raise OfferError("the fragment has no a=ice-ufrag and a=ice-pwd, expected both for an ICE restart")
        try:
            ice.restart(self._connection, fragment.username, fragment.password)
        except (ValueError, ConnectionError) as error:
            raise OfferError(f"ICE cannot be restarted: {str(error).lower()}") from None
        self._username, self.etag = fragment.username, _new_tag()
        await self.add_candidates(fragment)
        ours = ice.description(self._connection)
        return fragment_text(*self._head, ours.username, ours.password, ours.candidates)

    async def close(self, reason: str) -> None:
        """End the session. Later callers wait for the first one."""
        if self._closing is None:
            self._closing = asyncio.create_task(self._close(reason))
        await asyncio.shield(self._closing)

    async def _close(self, reason: str) -> None:
        self._timer.cancel()
        for adding in self._adding_late:
            adding.cancel()
        for feed in self._feeds:
            feed.close()
        try:
            async with asyncio.timeout(CLOSE_LIMIT_S):
                await self._connection.close()
        except TimeoutError:
            logger.warning("%s: a viewer's connection did not close in %g s", self.stream.name, CLOSE_LIMIT_S)
        finally:
            self._closed(self)
        logger.info("%s: viewer left after %.0f s: %s", self.stream.name, time.monotonic() - self._started_at, reason)

    def _close_soon(self, reason: str) -> None:
        if self._closing is None:
            self._closing = asyncio.create_task(self._close(reason))

    def _not_connected(self) -> None:
        self._close_soon(f"not connected after {CONNECT_LIMIT_S:g} s")

    def _state_changed(self) -> None:
        state = self._connection.connectionState
        if state == "connected":
            self._timer.cancel()
            self.connected = True
            logger.info("%s: viewer connected", self.stream.name)
        elif state in ("failed", "closed"):
            self._close_soon(f"connection {state}")


def _new_tag() -> str:
    return f'"{secrets.token_hex(8)}"'
