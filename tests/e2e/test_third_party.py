"""Other people's WHEP clients, on a page of another origin, in Chromium: @eyevinn/webrtc-player and whip-whep."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from aioice.ice import get_host_addresses
from node_package import NODE_MODULES, common_js
from playwright.sync_api import Page, Request
from processes import wait_for
from running_service import Service

pytestmark = pytest.mark.e2e

TOKEN = "token-of-third-parties"
PAGE = b"<!doctype html><meta charset=utf-8><title>a player</title><video id=video muted autoplay playsinline></video>"
DECODED = """
async () => {
  let decoded = 0;
  for (const peer of window.peers) {
    for (const report of (await peer.getStats()).values()) {
      if (report.type === 'inbound-rtp' && report.kind === 'video') decoded += report.framesDecoded;
    }
  }
  return decoded;
}
"""
# The clients keep their peer connections to themselves.
REMEMBER_PEERS = """
window.peers = [];
window.RTCPeerConnection = class extends RTCPeerConnection {
  constructor(...args) { super(...args); window.peers.push(this); }
};
"""


class _Player(http.server.BaseHTTPRequestHandler):
    files: dict[str, tuple[str, bytes]]

    def do_GET(self) -> None:
        kind, body = self.files.get(self.path, ("", b""))
        self.send_response(200 if kind else 404)
        self.send_header("Content-Type", kind or "text/plain")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def player_origin() -> Iterator[str]:
    """A web server with the clients, of another origin than the service."""
    files = {"/": ("text/html", PAGE), "/eyevinn.js": ("text/javascript", common_js("@eyevinn/webrtc-player").encode()),
             "/whep.js": ("text/javascript", (NODE_MODULES / "whip-whep" / "whep.js").read_bytes())}
    handler = type("Player", (_Player,), {"files": files})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def open_service(known_source: Path, player_origin: str) -> Iterator[Service]:
    """It allows the players' origin, and wants a token. One address, for whip-whep 1.2.0 cannot take two from a restart."""
    here = get_host_addresses(use_ipv4=True, use_ipv6=False)[0]
    config = known_source.parent / "third-party.toml"
    config.write_text(f'allowed_origins = ["{player_origin}"]\nice_networks = ["{here}/32"]\n'
                      f'tokens = [{{ token = "{TOKEN}", may = ["view", "control"] }}]\n')
    running = Service(known_source.parent, "--source", str(known_source), "--config", str(config))
    running.http.headers["Authorization"] = f"Bearer {TOKEN}"
    try:
        running.wait_ready()
        yield running
    finally:
        running.stop()


@pytest.fixture
def player(page: Page, player_origin: str) -> Callable[[], Page]:
    def open_() -> Page:
        page.add_init_script(REMEMBER_PEERS)
        page.goto(player_origin)
        return page

    return open_


def wait_playing(page: Page, frames: int = 30) -> None:
    wait_for(f"{frames} decoded frames", lambda: page.evaluate(DECODED) >= frames, 30)
    wait_for("picture in the video element", lambda: page.evaluate("document.getElementById('video').videoWidth === 2048"), 10)


def answers(page: Page, method: str) -> list[tuple[Request, int]]:
    """Requests of the method from now on, with the status of their answer; the list grows."""
    seen: list[tuple[Request, int]] = []
    page.on("response", lambda response: response.request.method == method and seen.append((response.request, response.status)))
    return seen


def wait_gone(service: Service) -> None:
    wait_for("end of the session", lambda: service.stream()["viewers"] == 0, 5)     # long before it would time out


def test_eyevinn_webrtc_player(player: Callable[[], Page], open_service: Service) -> None:
    page = player()
    page.add_script_tag(url="/eyevinn.js")
    left = answers(page, "DELETE")
    page.evaluate("""async ([url, token]) => {
      const { WebRTCPlayer } = require('@eyevinn/webrtc-player');
      window.player = new WebRTCPlayer({ video: document.getElementById('video'), type: 'whep', iceServers: [] });
      await window.player.load(new URL(url), `Bearer ${token}`);
    }""", [f"{open_service.url}/whep/live", TOKEN])
    wait_playing(page)
    assert open_service.stream()["viewers"] == 1
    kinds = page.evaluate("document.getElementById('video').srcObject.getTracks().map(({ kind }) => kind).sort()")
    assert kinds == ["audio", "video"]
    page.evaluate("window.player.unload()")
    wait_gone(open_service)
    wait_for("answer to its DELETE", lambda: page.wait_for_timeout(50) or left, 5)
    assert [status for _, status in left] == [200]


WHIP_WHEP = """async ([url, token, knowsItsTag]) => {
  const { WHEPClient } = await import('/whep.js');
  const peer = new RTCPeerConnection({ bundlePolicy: 'max-bundle' });
  for (const kind of ['video', 'audio']) peer.addTransceiver(kind, { direction: 'recvonly' });
  const stream = new MediaStream();
  peer.ontrack = ({ track }) => {
    stream.addTrack(track);
    document.getElementById('video').srcObject = stream;
  };
  window.client = new WHEPClient();
  if (knowsItsTag) {     // 1.2.0 takes it from the answer to a restart, but not from the first one
    window.client.onAnswer = (answer) => { window.client.etag = window.tag; return answer; };
    const plain = window.fetch;
    window.fetch = async (...args) => {
      const response = await plain(...args);
      if (response.status === 201) window.tag = response.headers.get('ETag');
      return response;
    };
  }
  await window.client.view(peer, url, token);
}"""


def test_whip_whep(player: Callable[[], Page], open_service: Service) -> None:
    page = player()
    trickled, left = answers(page, "PATCH"), answers(page, "DELETE")
    page.evaluate(WHIP_WHEP, [f"{open_service.url}/whep/live", TOKEN, True])
    wait_playing(page)
    assert trickled
    assert {status for _, status in trickled} == {204}
    assert any("a=candidate:" in (request.post_data or "") for request, _ in trickled)
    page.evaluate("client.stop()")
    wait_gone(open_service)
    wait_for("answer to its DELETE", lambda: page.wait_for_timeout(50) or left, 5)
    assert left[0][1] in (200, 404)     # it closes its connection first, and that is goodbye too


def test_whip_whep_as_it_is_plays_though_it_forgets_the_tag(player: Callable[[], Page], open_service: Service) -> None:
    page = player()
    trickled = answers(page, "PATCH")
    page.evaluate(WHIP_WHEP, [f"{open_service.url}/whep/live", TOKEN, False])
    wait_playing(page)
    assert {status for _, status in trickled} == {428}
    page.evaluate("client.stop()")
    wait_gone(open_service)


def test_whip_whep_restarts_ice(player: Callable[[], Page], open_service: Service) -> None:
    page = player()
    page.evaluate(WHIP_WHEP, [f"{open_service.url}/whep/live", TOKEN, True])
    wait_playing(page)
    restarted = answers(page, "PATCH")
    page.evaluate("client.restart()")
    wait_for("answered restart", lambda: page.wait_for_timeout(50) or 200 in [status for _, status in restarted], 10)
    wait_playing(page, page.evaluate(DECODED) + 60)
    assert page.evaluate("window.peers[0].connectionState") == "connected"
    page.evaluate("client.stop()")
    wait_gone(open_service)


def test_a_page_of_an_origin_that_is_not_allowed_gets_nothing(page: Page, known_service: Service, player_origin: str) -> None:
    page.goto(player_origin)
    said = page.evaluate("""(url) => fetch(url, { method: 'POST', headers: { 'Content-Type': 'application/sdp' }, body: 'v=0' })
      .then(() => 'answered', (error) => error.name)""", f"{known_service.url}/whep/live")
    assert said == "TypeError"
