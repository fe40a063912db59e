"""Our ICE agent against itself and against aioice's: these tests fail when aiortc or aioice no longer work as the hooks expect."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from ipaddress import ip_network

import pytest
import pytest_asyncio
from aioice import stun
from aioice.candidate import Candidate
from aioice.ice import Connection, get_host_addresses
from aiortc import RTCConfiguration, RTCPeerConnection, rtcicetransport
from aiortc.rtcicetransport import RTCIceGatherer

from server.delivery import ice
from server.delivery.media_addresses import MediaAddresses, NoSocketError, UdpPorts
from server.network_settings import OWN

LIMIT_S = 20.0
HERE = get_host_addresses(use_ipv4=True, use_ipv6=False)[0]


@pytest.fixture(autouse=True)
def _aiortc_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """`install` is for a whole process; the other tests of this one have peers of their own."""
    monkeypatch.setattr(rtcicetransport, "Connection", rtcicetransport.Connection)


async def until(condition: Callable[[], object], limit_s: float = LIMIT_S) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110 - aioice tells nobody
            await asyncio.sleep(0.01)


class Agent:
    """A connection that records what it receives."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.received: list[bytes] = []
        self.reading: asyncio.Task[None] | None = None

    async def read(self) -> None:
        try:
            while True:
                self.received.append(await self.connection.recv())
        except ConnectionError:
            return

    @property
    def pair(self) -> tuple[tuple[str, int], tuple[str, int]]:
        nominated = self.connection._nominated[1]
        return nominated.local_addr, nominated.remote_addr


async def exchange(one: Agent, other: Agent, text: bytes) -> None:
    """A datagram each way arrives."""
    for sender, receiver in ((one, other), (other, one)):
        await sender.connection.send(text)
        await until(lambda receiver=receiver: text in receiver.received)


async def introduce(one: Connection, other: Connection) -> None:
    for connection, peer in ((one, other), (other, one)):
        connection.remote_username, connection.remote_password = peer.local_username, peer.local_password
        for candidate in peer.local_candidates:
            await connection.add_remote_candidate(candidate)
        await connection.add_remote_candidate(None)


@pytest_asyncio.fixture
async def connect() -> AsyncIterator[Callable[..., Awaitable[tuple[Agent, Agent]]]]:
    """Call it with a controlling connection: it and ours, connected and reading."""
    started: list[Agent] = []

    async def connect_(viewer: Connection) -> tuple[Agent, Agent]:
        service = ice.IceConnection(MediaAddresses(networks=(ip_network(f"{HERE}/32"),)), ice_controlling=False)
        agents = Agent(viewer), Agent(service)
        started.extend(agents)
        await asyncio.gather(viewer.gather_candidates(), service.gather_candidates())
        await introduce(viewer, service)
        await asyncio.gather(viewer.connect(), service.connect())
        for agent in agents:
            agent.reading = asyncio.create_task(agent.read())
        return agents

    yield connect_
    for agent in started:
        await agent.connection.close()
        if agent.reading is not None:
            await agent.reading


def restarting_viewer() -> ice.IceConnection:
    return ice.IceConnection(MediaAddresses(networks=(ip_network(f"{HERE}/32"),)), ice_controlling=True)


async def restart_both(viewer: ice.IceConnection, service: ice.IceConnection, candidates: list[Candidate] | None = None) -> None:
    """A restart as the viewer asks for it and the service answers."""
    before = viewer.credentials
    service.restart("viewer" + before.local_username, before.local_password)
    viewer.restart(service.local_username, service.local_password)
    # What a browser does on its own: it chose these names before it asked.
    viewer._local_username, viewer._local_password = "viewer" + before.local_username, before.local_password
    for connection, given in ((viewer, service.local_candidates), (service, candidates or viewer.local_candidates)):
        for candidate in given:
            await connection.add_remote_candidate(candidate)


# --- candidates ------------------------------------------------------------------------------------------------------


async def gathered(addresses: MediaAddresses) -> list[Candidate]:
    connection = ice.IceConnection(addresses, ice_controlling=False)
    await connection.gather_candidates()
    try:
        return connection.local_candidates
    finally:
        await connection.close()


def free_range(size: int) -> range:
    """Ports in a row that nobody uses now."""
    for first in range(42000, 60000, size):
        try:
            for port in range(first, first + size):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                    probe.bind(("0.0.0.0", port))
        except OSError:
            continue
        return range(first, first + size)
    raise AssertionError("no free ports")


async def test_every_candidate_lies_in_the_range_and_the_next_viewer_gets_the_next_port() -> None:
    ports = free_range(3)
    addresses = MediaAddresses(UdpPorts(ports))
    assert [{candidate.port for candidate in await gathered(addresses)} for _ in range(4)] == [
        {ports[0]}, {ports[1]}, {ports[2]}, {ports[0]}]


async def test_a_port_in_use_is_passed_over_and_none_left_is_an_error() -> None:
    ports = free_range(2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((HERE, ports[0]))
        addresses = MediaAddresses(UdpPorts(ports))
        first = ice.IceConnection(addresses, ice_controlling=False)
        await first.gather_candidates()
        assert {candidate.port for candidate in first.local_candidates} == {ports[1]}
        second = ice.IceConnection(addresses, ice_controlling=False)
        with pytest.raises(NoSocketError, match=f"no UDP port from {ports[0]} to {ports[1]} is free, the setting udp_ports"):
            await second.gather_candidates()
        await second.close()
        await first.close()
    assert await gathered(addresses)


async def test_advertised_addresses_stand_in_the_place_of_our_own_or_beside_them() -> None:
    told = await gathered(MediaAddresses(advertised=("203.0.113.7",)))
    assert {candidate.host for candidate in told} == {"203.0.113.7"}
    told = await gathered(MediaAddresses(advertised=("203.0.113.7", OWN)))
    assert {"203.0.113.7", HERE} <= {candidate.host for candidate in told}
    by_address = {candidate.host: candidate.port for candidate in told}
    assert len(set(by_address.values())) >= 1
    assert len(told) == len({(candidate.host, candidate.port) for candidate in told})


async def test_only_addresses_in_the_networks_are_used() -> None:
    told = await gathered(MediaAddresses(networks=(ip_network(f"{HERE}/32"),)))
    assert {candidate.host for candidate in told} == {HERE}
    with pytest.raises(NoSocketError, match="ice_networks"):
        await gathered(MediaAddresses(networks=(ip_network("203.0.113.0/24"),)))


async def test_aiortc_makes_our_connection_once_it_is_installed() -> None:
    ports = free_range(1)
    ice.install(MediaAddresses(UdpPorts(ports), advertised=("203.0.113.7",)))
    gatherer = RTCIceGatherer(iceServers=[])
    await gatherer.gather()
    assert isinstance(gatherer._connection, ice.IceConnection)
    assert [(candidate.ip, candidate.port) for candidate in gatherer.getLocalCandidates()] == [("203.0.113.7", ports[0])]
    await gatherer._connection.close()


def test_install_refuses_a_changed_aioice(monkeypatch: pytest.MonkeyPatch) -> None:
    async def other(self: object) -> None:
        return None

    monkeypatch.setattr(Connection, "connect", other)
    with pytest.raises(RuntimeError, match=r"expected aiortc 1\.16 and aioice 0\.13"):
        ice.install(MediaAddresses())


async def test_all_sockets_are_closed_with_the_connection() -> None:
    connection = ice.IceConnection(MediaAddresses(), ice_controlling=False)
    await connection.gather_candidates()
    transports = [protocol.transport for protocol in connection._protocols]
    assert transports
    await connection.close()
    assert all(transport.is_closing() for transport in transports)


# --- restart ---------------------------------------------------------------------------------------------------------


async def test_data_flows_before_during_and_after_each_of_several_restarts(
        connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    viewer, service = await connect(restarting_viewer())
    await exchange(viewer, service, b"first")
    seen = {service.connection.credentials}
    for number in range(4):
        before = service.connection._nominated[1]
        await restart_both(viewer.connection, service.connection)
        await exchange(viewer, service, b"during %d" % number)      # nothing of the new generation has been checked yet
        await until(lambda before=before: service.connection._nominated[1] is not before)
        await exchange(viewer, service, b"after %d" % number)
        seen.add(service.connection.credentials)
    assert len({one.local_username for one in seen}) == len({one.local_password for one in seen}) == 5


async def test_restarts_in_a_row_without_waiting(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    viewer, service = await connect(restarting_viewer())
    old = service.connection._nominated[1]
    for _ in range(3):
        await restart_both(viewer.connection, service.connection)
    await until(lambda: service.connection._nominated[1] is not old)
    await exchange(viewer, service, b"after")


async def test_the_old_pair_is_answered_and_asked_with_its_own_credentials(
        connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    """The service restarts and the viewer, aioice's own agent, knows nothing of it: as before a browser's first new check."""
    plain = Connection(ice_controlling=True)
    viewer, service = await connect(plain)
    pair = plain._nominated[1]
    given = service.connection.credentials
    service.connection.restart("somebody", "x" * 24)
    response, _ = await pair.protocol.request(plain.build_request(pair, nominate=False), pair.remote_addr,
                                              integrity_key=given.local_password.encode(), retransmissions=2)
    assert response.message_class == stun.Class.RESPONSE
    consented = service.connection._consent_at
    service.connection._ask_consent()
    await until(lambda: service.connection._consent_at > consented)
    await exchange(viewer, service, b"still here")


async def test_nobody_else_can_use_earlier_credentials(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    plain = Connection(ice_controlling=True)
    _, service = await connect(plain)
    pair = plain._nominated[1]
    service.connection.restart("somebody", "x" * 24)
    heard = service.connection._heard_at
    with pytest.raises(stun.TransactionTimeout):
        await pair.protocol.request(plain.build_request(pair, nominate=False), pair.remote_addr,
                                    integrity_key=b"y" * 24, retransmissions=1)
    assert service.connection._heard_at == heard


async def test_a_viewer_with_a_new_address(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    viewer, service = await connect(restarting_viewer())
    _, old_address = service.pair
    agent = viewer.connection
    old_protocol, = agent._protocols
    agent._protocols.clear()
    candidates = await agent.get_component_candidates(1, [HERE])     # its old socket answers nothing any more
    agent._local_candidates[:] = candidates
    old_protocol.transport.close()
    await (viewer.reading or asyncio.sleep(0))
    viewer.reading = asyncio.create_task(viewer.read())
    await restart_both(agent, service.connection)
    await until(lambda: service.pair[1] != old_address)
    assert service.pair[1] == (candidates[0].host, candidates[0].port)
    await service.connection.send(b"to the new address")
    await until(lambda: b"to the new address" in viewer.received)


@pytest.mark.parametrize(("username", "password"), [("abc", "x" * 22), ("abcd", "x" * 21), ("ab d", "x" * 22), ("abcd", "")])
async def test_wrong_credentials_change_nothing(connect: Callable[..., Awaitable[tuple[Agent, Agent]]], username: str,
                                                password: str) -> None:
    viewer, service = await connect(Connection(ice_controlling=True))
    before = service.connection.credentials
    with pytest.raises(ValueError, match="satisfy"):
        service.connection.restart(username, password)
    assert service.connection.credentials == before
    await exchange(viewer, service, b"as before")


async def test_restart_of_a_peer_that_has_not_begun() -> None:
    ice.install(MediaAddresses())
    peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    peer.addTransceiver("video", direction="sendonly")
    with pytest.raises(ConnectionError, match="has not begun"):
        ice.restart(peer, "abcd", "x" * 22)
    await peer.close()


# --- is the viewer still there ---------------------------------------------------------------------------------------


def hurry(monkeypatch: pytest.MonkeyPatch, **seconds: float) -> None:
    for name, value in seconds.items():
        monkeypatch.setattr(ice, name.upper(), value)


async def test_a_silent_viewer_is_gone_in_time_and_one_that_only_sends_checks_is_not(
        connect: Callable[..., Awaitable[tuple[Agent, Agent]]], monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, silence_s=1.5, check_s=0.3)
    viewer, service = await connect(Connection(ice_controlling=True))
    await asyncio.sleep(2.5)
    await exchange(viewer, service, b"still here")
    for protocol in viewer.connection._protocols:
        protocol.transport.close()
    died = time.monotonic()
    await asyncio.wait_for(service.reading or asyncio.sleep(0), LIMIT_S)
    assert 1.0 < time.monotonic() - died < 4.0
    assert service.connection._closed


async def test_what_comes_from_anybody_does_not_keep_a_viewer_alive_for_ever(
        connect: Callable[..., Awaitable[tuple[Agent, Agent]]], monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, silence_s=1.5, consent_s=2.5, check_s=0.3)
    viewer, service = await connect(Connection(ice_controlling=True))
    address, _ = service.pair
    for protocol in viewer.connection._protocols:
        protocol.transport.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        died = time.monotonic()
        while not service.connection._closed:
            stranger.sendto(b"\x80" + b"noise" * 10, address)
            await asyncio.sleep(0.1)
            assert time.monotonic() - died < LIMIT_S
    assert time.monotonic() - died > 2.0


async def test_a_late_answer_is_consent(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    """aioice gives up after 0.5 s, which is less than the way through a full queue."""
    plain = Connection(ice_controlling=True)
    _, service = await connect(plain)
    answers: list[tuple[stun.Message, tuple[str, int]]] = []
    protocol = plain._nominated[1].protocol
    send = protocol.send_stun
    protocol.send_stun = lambda message, addr: answers.append((message, addr))      # type: ignore[method-assign]
    before = service.connection._consent_at
    service.connection._ask_consent()
    await until(lambda: answers)
    await asyncio.sleep(1.0)
    assert service.connection._consent_at == before
    send(*answers[0])
    await until(lambda: service.connection._consent_at > before)


async def test_unanswered_checks_do_not_pile_up(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    viewer, service = await connect(Connection(ice_controlling=True))
    for protocol in viewer.connection._protocols:
        protocol.transport.close()
    for _ in range(50):
        service.connection._ask_consent()
    assert sum(len(protocol.transactions) for protocol in service.connection._protocols) <= ice.OPEN_CHECKS


async def test_broken_stun_messages_do_no_harm(connect: Callable[..., Awaitable[tuple[Agent, Agent]]]) -> None:
    viewer, service = await connect(Connection(ice_controlling=True))
    address, _ = service.pair
    complaints: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: complaints.append(context))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for kind, length in ((0x0024, 2), (0x8029, 3), (0x0009, 1), (0x0020, 9), (0x0001, 3), (0x0006, 200), (0x8028, 1)):
            body = struct.pack("!HH", kind, length) + bytes(4)
            stranger.sendto(struct.pack("!HHI12s", 1, len(body), stun.COOKIE, b"x" * 12) + body, address)
    await exchange(viewer, service, b"as before")
    assert not complaints
