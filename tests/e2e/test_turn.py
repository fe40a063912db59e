"""Viewers behind a firewall: a real coturn that shares a secret with the service."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from aioice import turn
from aioice.ice import get_host_addresses
from aioice.stun import TransactionFailed
from aiortc import RTCConfiguration, RTCIceServer, RTCPeerConnection, RTCSessionDescription
from aiortc.rtcconfiguration import RTCIceTransportPolicy
from playwright.sync_api import Page
from processes import Process, free_port, wait_for
from running_service import Service

from server.turn import turn_credentials

pytestmark = pytest.mark.e2e

SECRET = "shared-between-coturn-and-mr360"
HERE = get_host_addresses(use_ipv4=True, use_ipv6=False)[0]


class Coturn:
    """`turnserver` with `use-auth-secret` on this machine's address."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.url = f"turn:{HERE}:{self.port}?transport=udp"
        self.process = Process([
            "turnserver", "-n", "--no-cli", "--no-tls", "--no-dtls", "--use-auth-secret", f"--static-auth-secret={SECRET}",
            "--realm=mr360.example", f"--listening-ip={HERE}", f"--relay-ip={HERE}", f"--listening-port={self.port}",
            "--min-port=48000", "--max-port=48200", "--allow-loopback-peers", "--log-file=stdout", "--simple-log", "--verbose",
            f"--pidfile={folder / 'turnserver.pid'}", f"--userdb={folder / 'turn.db'}"], folder / "coturn.log")
        wait_for("coturn", lambda: "listener opened" in self.process.output().lower(), 10)


@pytest.fixture(scope="module")
def coturn(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Coturn]:
    server = Coturn(tmp_path_factory.mktemp("coturn"))
    yield server
    server.process.kill()


@pytest.fixture(scope="module")
def relayed_service(known_source: Path, coturn: Coturn) -> Iterator[Service]:
    config = known_source.parent / "turn.toml"
    config.write_text(f'turn = {{ urls = ["{coturn.url}"], secret = "{SECRET}", ttl_s = 600 }}\n')
    running = Service(known_source.parent, "--source", str(known_source), "--config", str(config))
    try:
        running.wait_ready()
        yield running
    finally:
        running.stop()


def ice_server(service: Service) -> RTCIceServer:
    """As the service tells it in the Link header of OPTIONS."""
    link = service.http.options("/whep/live").headers["link"]
    url, *parameters = link.split("; ")
    named = {name: value.strip('"') for name, _, value in (parameter.partition("=") for parameter in parameters)}
    return RTCIceServer(url.strip("<>"), named["username"], named["credential"])


async def test_an_aiortc_viewer_sees_the_picture_through_the_relay(relayed_service: Service, coturn: Coturn) -> None:
    viewer = RTCPeerConnection(RTCConfiguration([ice_server(relayed_service)], iceTransportPolicy=RTCIceTransportPolicy.RELAY))
    try:
        receiver = viewer.addTransceiver("video", direction="recvonly").receiver
        await viewer.setLocalDescription(await viewer.createOffer())
        offer = viewer.localDescription.sdp
        assert "typ relay" in offer
        assert "typ host" not in offer
        async with httpx.AsyncClient(base_url=relayed_service.url, trust_env=False) as client:
            answer = await client.post("/whep/live", content=offer, headers={"Content-Type": "application/sdp"})
        assert answer.status_code == 201, answer.text
        await viewer.setRemoteDescription(RTCSessionDescription(answer.text, "answer"))
        for _ in range(30):
            frame = await asyncio.wait_for(receiver.track.recv(), 30)
        assert (frame.width, frame.height) == (2048, 1024)
        relayed = viewer.getTransceivers()[0].receiver.transport.transport._connection._nominated[1]
        assert relayed.local_candidate.type == "relay"
        assert 48000 <= relayed.local_candidate.port <= 48200
    finally:
        await viewer.close()


def test_chromium_sees_the_picture_through_the_relay(relayed_service: Service, page: Page) -> None:
    page.add_init_script("""
        const Peer = RTCPeerConnection;
        window.RTCPeerConnection = class extends Peer {
          constructor(configuration) { super({ ...configuration, iceTransportPolicy: 'relay' }); }
        };""")
    page.goto(f"{relayed_service.url}/view/live")
    wait_for("decoded frames", lambda: page.evaluate("mr360.viewer.frames.count") > 30, 30)
    kinds = page.evaluate("""async () => {
      const stats = [...(await mr360.viewer.whep.peer.getStats()).values()];
      const transport = stats.find(({ type }) => type === 'transport');
      const pair = stats.find(({ id }) => id === transport.selectedCandidatePairId);
      return stats.find(({ id }) => id === pair.localCandidateId).candidateType;
    }""")
    assert kinds == "relay"


async def allocate(port: int, username: str, password: str) -> None:
    transport, _ = await turn.create_turn_endpoint(asyncio.DatagramProtocol, server_addr=(HERE, port), username=username,
                                                   password=password)
    transport.close()


async def test_coturn_takes_our_credentials_until_they_expire(coturn: Coturn) -> None:
    await allocate(coturn.port, *turn_credentials(SECRET, 600))
    expired = turn_credentials(SECRET, 600, now=time.time() - 1200)
    later = f"{int(time.time()) + 600}:{expired[0].partition(':')[2]}"
    for user, password in (expired, turn_credentials("another secret", 600), (later, expired[1])):
        with pytest.raises(TransactionFailed, match="401"):
            await allocate(coturn.port, user, password)
