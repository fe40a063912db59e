"""All WHEP sessions of the service: who may come in, which renditions a viewer is sent, and everybody's end."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from server.delivery import aiortc_hooks, ice
from server.delivery.media_addresses import MediaAddresses
from server.delivery.subscription import Choice
from server.delivery.whep import WhepSession
from server.rate_limit import is_loopback, shared_network
from server.stream import Stream

RETRY_AFTER_S = 5
FEWEST_UNCONNECTED = 4      # of one address, also where max_viewers is small


class TooManyViewersError(RuntimeError):
    """`max_viewers` is reached."""


class UnknownRenditionError(ValueError):
    """The stream's ladder has no rendition of that name."""


class WhepSessions:
    """Owner of all sessions of all streams."""

    def __init__(self, max_viewers: int, addresses: MediaAddresses) -> None:
        aiortc_hooks.install()
        ice.install(addresses)
        self._max_viewers = max_viewers
        self._sessions: dict[str, WhepSession] = {}

    def __len__(self) -> int:
        return len(self._sessions)

    def of(self, stream: Stream) -> list[WhepSession]:
        """The stream's sessions, oldest first."""
        return [session for session in self._sessions.values() if session.stream is stream and not session.closing]

    def find(self, stream: str, session_id: str) -> WhepSession | None:
        session = self._sessions.get(session_id)
        if session is None or session.closing or session.stream.name != stream:
            return None
        return session

    async def open(self, stream: Stream, offer: str, rendition: str | None = None,
                   at_most: str | None = None, address: str = "") -> tuple[WhepSession, str]:
        """A new session and the SDP answer.

        Args:
            rendition: the one to send whatever happens; None: as the viewer's network allows.
            at_most: the best one that may be sent, for a viewer that cannot decode better ones; None: the best there is.
            address: the viewer's, as HTTP knows it.

        Raises:
            TooManyViewersError, UnknownRenditionError, OfferError, CodecError: there is no session then.
        """
        choice = _choice(stream.rendition_names, rendition, at_most)
        if len(self._sessions) >= self._max_viewers:
            raise TooManyViewersError(f"{self._max_viewers} viewers are connected, the setting max_viewers")
        self._check_unconnected(address)
        session = WhepSession(stream, choice, address, self._forget)
        self._sessions[session.id] = session
        try:
            return session, await session.negotiate(offer)
        except BaseException as error:
            await session.close(f"no answer: {error or type(error).__name__}")
            raise

    def _check_unconnected(self, address: str) -> None:
        """One address may not hold all places with offers that never become connections."""
        if is_loopback(address):
            return
        here = [session for session in self._sessions.values()
                if not session.connected and shared_network(session.address) == shared_network(address)]
        if len(here) >= max(FEWEST_UNCONNECTED, self._max_viewers // 4):
            raise TooManyViewersError(f"{len(here)} viewers of this address are not connected yet, expected fewer")

    async def close_stream(self, stream: Stream) -> None:
        await self._close([session for session in self._sessions.values() if session.stream is stream])

    async def close(self) -> None:
        await self._close(list(self._sessions.values()))

    async def _close(self, sessions: list[WhepSession]) -> None:
        await asyncio.gather(*(session.close("the stream ends") for session in sessions))

    def _forget(self, session: WhepSession) -> None:
        self._sessions.pop(session.id, None)


def _choice(names: Sequence[str], rendition: str | None, at_most: str | None) -> Choice:
    for name in (rendition, at_most):
        if name is not None and name not in names:
            raise UnknownRenditionError(f"rendition is {name!r}, expected one of {', '.join(names)}")
    if rendition is not None:
        return Choice(names.index(rendition), names.index(rendition))
    return Choice(names.index(at_most) if at_most is not None else 0, len(names) - 1)
