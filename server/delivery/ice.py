"""ICE as a service needs it: ports of a range, advertised addresses, restarts, and viewers that are gone noticed in time.

The only place that reaches into the private parts of aioice 0.13 and of aiortc's ICE. Each hook has a test in
tests/server/test_ice.py that fails when they no longer work that way.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
from collections import deque
from dataclasses import dataclass
from types import CodeType
from typing import Any

from aioice import stun, turn
from aioice.candidate import Candidate, candidate_foundation, candidate_priority
from aioice.ice import CandidatePair, Connection, StunProtocol, validate_password, validate_username
from aioice.utils import random_string
from aiortc import RTCIceCandidate, RTCPeerConnection, rtcicetransport

from server.delivery.media_addresses import MediaAddresses

SILENCE_S = 15.0                # nothing at all comes from a viewer for so long: it is gone; an outage of 8 s is survived
CONSENT_S = 30.0                # RFC 7675 section 5.1: no more media without an authenticated answer for so long
CHECK_S = 5.0                   # and the pause between checks, to be spread by 20 %
CHECK_SPACING_S = 0.02          # between first checks of pairs: Ta of RFC 8445 section 14
RESTART_LIMIT_S = 30.0
EARLIER_GENERATIONS = 4
MAX_REMOTE_CANDIDATES = 100     # of one generation: RFC 8445 section 6.1.2.5
OPEN_CHECKS = 8                 # for consent: as many as are sent while it lasts


@dataclass(frozen=True, slots=True)
class Credentials:
    """Of one generation of ICE: what either side calls itself and signs with."""

    local_username: str
    local_password: str
    remote_username: str
    remote_password: str


def install(addresses: MediaAddresses) -> None:
    """Have every peer connection of this process made from now on use `IceConnection`.

    Raises:
        RuntimeError: aiortc or aioice has changed and the hooks would silently do nothing.
    """
    expected = {
        rtcicetransport.RTCIceGatherer.__init__: {"Connection"},
        Connection.connect: {"query_consent", "_check_list", "_check_list_state"},
        Connection.gather_candidates: {"get_component_candidates"},
        Connection.request_received: {"_valid_username", "check_incoming"},
        StunProtocol.datagram_received: {"transactions", "response_received", "request_received", "data_received"},
    }
    for function, names in expected.items():
        if not names <= _names_in(function.__code__):
            raise RuntimeError(f"{function.__qualname__} has changed, expected aiortc 1.16 and aioice 0.13")

    def make(*arguments: Any, **options: Any) -> IceConnection:
        return IceConnection(addresses, *arguments, **options)

    vars(rtcicetransport)["Connection"] = make


def _names_in(code: CodeType) -> set[str]:
    """Used by a function and by the comprehensions inside it, which Python 3.11 compiles apart."""
    inner = [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*(_names_in(one) for one in inner))


def restart(peer: RTCPeerConnection, username: str, password: str) -> None:
    """Begin a new generation of ICE with the viewer's new credentials (RFC 8445 section 9); its candidates come after this.

    Raises:
        ValueError: username or password have not the form of RFC 8839.
        ConnectionError: the connection is closed or has not begun.
    """
    transport = _transport(peer)
    connection(peer).restart(username, password)
    transport.iceGatherer._remote_candidates_end = False


@dataclass(frozen=True, slots=True)
class OurSide:
    """What a viewer has to know of us to connect."""

    username: str
    password: str
    candidates: tuple[RTCIceCandidate, ...]


def description(peer: RTCPeerConnection) -> OurSide:
    """Our side of the present generation of ICE."""
    gatherer = _transport(peer).iceGatherer
    ours = connection(peer).credentials
    return OurSide(ours.local_username, ours.local_password, tuple(gatherer.getLocalCandidates()))


def connection(peer: RTCPeerConnection) -> IceConnection:
    """The ICE agent of a peer whose media is bundled."""
    found = _transport(peer)._connection
    assert isinstance(found, IceConnection)
    return found


def _transport(peer: RTCPeerConnection) -> rtcicetransport.RTCIceTransport:
    return peer.getTransceivers()[0].receiver.transport.transport


class IceConnection(Connection):
    """An ICE agent that keeps its sockets through restarts: media goes on over the old pair until a new one is nominated."""

    def __init__(self, addresses: MediaAddresses, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._addresses = addresses
        self._earlier: deque[Credentials] = deque(maxlen=EARLIER_GENERATIONS)
        self._old_pair: tuple[CandidatePair, Credentials] | None = None
        self._checking: asyncio.Task[None] | None = None
        self._consent_checks: deque[tuple[dict[bytes, Any], bytes]] = deque()
        self._heard_at = self._consent_at = 0.0

    @property
    def credentials(self) -> Credentials:
        """Of the present generation."""
        return Credentials(self._local_username, self._local_password, self.remote_username or "", self.remote_password or "")

    # --- candidates --------------------------------------------------------------------------------------------------

    async def get_component_candidates(self, component: int, addresses: list[str], timeout: int = 5) -> list[Candidate]:
        """Bind the sockets. The service asks no STUN or TURN server about itself: viewers reach it, or their relay does."""
        told: dict[tuple[str, int], Candidate] = {}
        for bound in self._addresses.ports.bind(self._addresses.usable(addresses)):
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, turn.UDP_SOCKET_BUFFER_SIZE)
            host, port = bound.getsockname()[:2]
            loop = asyncio.get_running_loop()
            _, protocol = await loop.create_datagram_endpoint(lambda: _Protocol(self), sock=bound)
            protocol.local_candidate = _host_candidate(component, host, port)
            self._protocols.append(protocol)
            for address in self._addresses.shown(host):
                told[address, port] = _host_candidate(component, address, port)
        return list(told.values())

    def _add_remote_candidate(self, remote_candidate: Candidate, network_host: str) -> None:
        if len(self._remote_candidates) < MAX_REMOTE_CANDIDATES:     # each one makes us send checks to wherever it says
            super()._add_remote_candidate(remote_candidate, network_host)

    # --- restart -----------------------------------------------------------------------------------------------------

    def restart(self, remote_username: str, remote_password: str) -> None:
        """Begin a new generation. Raises ValueError, ConnectionError; nothing has changed then."""
        validate_username(remote_username)
        validate_password(remote_password)
        if self._closing or self.remote_username is None:
            raise ConnectionError("the connection is closed or has not begun")
        self._keep_nominated_pair()
        self._earlier.append(self.credentials)
        for pair in self._check_list:
            if pair.task is not None:
                pair.task.cancel()
        self._check_list.clear()
        self._nominating.clear()
        self._remote_candidates.clear()
        self._remote_candidates_end = False
        self._local_username, self._local_password = random_string(8), random_string(24)
        self.remote_username, self.remote_password = remote_username, remote_password
        self._heard_at = self._consent_at = asyncio.get_running_loop().time()   # it has just spoken, over HTTP
        if self._checking is not None:
            self._checking.cancel()
        self._checking = asyncio.create_task(self._check_pairs())

    def _keep_nominated_pair(self) -> None:
        """The pair in use is checked on with the credentials that it was nominated with."""
        pair = self._nominated.get(1)
        if pair is not None and (self._old_pair is None or self._old_pair[0] is not pair):
            self._old_pair = pair, self.credentials

    async def _check_pairs(self) -> None:
        """What `connect` does for the first generation, where nothing else would begin checks of our own."""
        old = self._nominated.get(1)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RESTART_LIMIT_S):
                while self._nominated.get(1) is old:
                    waiting = [pair for pair in self._check_list
                               if pair.state in (CandidatePair.State.WAITING, CandidatePair.State.FROZEN)]
                    if waiting:
                        self.check_start_task(waiting[0])
                    await asyncio.sleep(CHECK_SPACING_S)

    def request_received(self, message: stun.Message, addr: tuple[str, int], protocol: StunProtocol) -> None:
        """Answer a check, also one of an earlier generation: the viewer keeps the old pair until it has a new one."""
        earlier = self._earlier_credentials(message)
        if earlier is not None:
            if message.check_message_integrity(earlier.local_password.encode()):
                self._heard_now()
                _respond(message, addr, protocol, earlier.local_password)
            return
        if message.check_message_integrity(self._local_password.encode()):
            self._heard_now()
        super().request_received(message, addr, protocol)

    def _earlier_credentials(self, message: stun.Message) -> Credentials | None:
        if self._closing or message.message_method != stun.Method.BINDING:
            return None
        username = message.attributes.get("USERNAME")
        for one in self._earlier:
            if username == f"{one.local_username}:{one.remote_username}":
                return one
        return None

    # --- is the viewer still there -----------------------------------------------------------------------------------

    def data_received(self, data: bytes, component: int) -> None:
        self._heard_now()
        super().data_received(data, component)

    def _heard_now(self) -> None:
        self._heard_at = asyncio.get_running_loop().time()

    async def query_consent(self) -> None:
        """Close when the viewer is silent or gives no consent (RFC 7675). aioice's own needs up to 39 s to notice, and takes
        an answer that comes after more than 0.5 s for none."""
        clock = asyncio.get_running_loop().time
        self._heard_at = self._consent_at = clock()
        next_check = clock() + _spread(CHECK_S)
        while clock() < (end := min(self._heard_at + SILENCE_S, self._consent_at + CONSENT_S)):
            if clock() >= next_check:
                self._ask_consent()
                next_check = clock() + _spread(CHECK_S)
            await asyncio.sleep(max(0.0, min(end, next_check) - clock()))
        self._query_consent_task = None     # `close` must not wait for this task
        await self.close()

    def _ask_consent(self) -> None:
        pair = self._nominated.get(1)
        if pair is None:
            return
        of_old_pair = self._old_pair is not None and self._old_pair[0] is pair
        credentials = self._old_pair[1] if self._old_pair is not None and of_old_pair else self.credentials
        request = self.build_request(pair, nominate=False)
        request.attributes["USERNAME"] = f"{credentials.remote_username}:{credentials.local_username}"
        password = credentials.remote_password.encode()
        request.add_message_integrity(password)
        open_checks = pair.protocol.transactions
        open_checks[request.transaction_id] = _ConsentCheck(self, request, pair, password)
        self._consent_checks.append((open_checks, request.transaction_id))
        if len(self._consent_checks) > OPEN_CHECKS:
            oldest, transaction_id = self._consent_checks.popleft()
            oldest.pop(transaction_id, None)
        pair.protocol.send_stun(request, pair.remote_addr)

    def consent_given(self) -> None:
        self._heard_at = self._consent_at = asyncio.get_running_loop().time()

    async def close(self) -> None:
        if self._checking is not None:
            self._checking.cancel()
        await super().close()


class _Protocol(StunProtocol):
    def datagram_received(self, data: bytes | str, addr: tuple[Any, ...]) -> None:
        # Anybody can send a broken STUN message; aioice's parser raises more than the ValueError that it expects of itself.
        with contextlib.suppress(struct.error, IndexError, KeyError):
            super().datagram_received(data, addr)


class _ConsentCheck(stun.Transaction):
    """A binding request that is sent once and may be answered as long as consent lasts, however slow the network is."""

    def __init__(self, connection: IceConnection, request: stun.Message, pair: CandidatePair, password: bytes) -> None:
        super().__init__(request, pair.remote_addr, pair.protocol, integrity_key=password)
        self._connection, self._pair, self._password = connection, pair, password

    def response_received(self, message: stun.Message, addr: tuple[str, int]) -> None:
        if (message.message_class == stun.Class.RESPONSE and addr == self._pair.remote_addr
                and message.check_message_integrity(self._password)):
            self._connection.consent_given()


def _host_candidate(component: int, address: str, port: int) -> Candidate:
    return Candidate(foundation=candidate_foundation("host", "udp", address), component=component, transport="udp",
                     priority=candidate_priority(component, "host"), host=address, port=port, type="host")


def _respond(request: stun.Message, addr: tuple[str, int], protocol: StunProtocol, password: str) -> None:
    response = stun.Message(message_method=stun.Method.BINDING, message_class=stun.Class.RESPONSE,
                            transaction_id=request.transaction_id)
    response.attributes["XOR-MAPPED-ADDRESS"] = addr
    response.add_message_integrity(password.encode())
    protocol.send_stun(response, addr)


def _spread(seconds: float) -> float:
    return seconds * (0.8 + 0.4 * random.random())
