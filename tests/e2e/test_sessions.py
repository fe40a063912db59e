"""WHEP sessions with real clients: ICE restarts in Chromium, a network that changes, viewers that are killed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from headless_viewer import HeadlessViewer
from playwright.sync_api import Page
from processes import wait_for
from running_service import Service

pytestmark = pytest.mark.e2e

# A WHEP client of a few lines, made by the draft and not with our own.
CLIENT = """
async (endpoint) => {
  const peer = new RTCPeerConnection({ bundlePolicy: 'max-bundle' });
  const video = document.body.appendChild(document.createElement('video'));
  video.muted = true;
  peer.ontrack = ({ track }) => { video.srcObject = new MediaStream([track]); video.play(); };
  peer.addTransceiver('video', { direction: 'recvonly' });
  await peer.setLocalDescription();
  const answer = await fetch(endpoint, { method: 'POST', headers: { 'Content-Type': 'application/sdp' },
                                         body: peer.localDescription.sdp });
  const session = new URL(answer.headers.get('Location'), endpoint).href;
  await peer.setRemoteDescription({ type: 'answer', sdp: await answer.text() });
  const named = (text, name) => text.match(new RegExp(`a=${name}:(.*)\\r\\n`))[1];
  window.viewer = {
    peer, etags: [answer.headers.get('ETag')],
    async restart() {
      await peer.setLocalDescription(await peer.createOffer({ iceRestart: true }));
      const { sdp } = peer.localDescription;
      const fragment = `a=ice-ufrag:${named(sdp, 'ice-ufrag')}\\r\\na=ice-pwd:${named(sdp, 'ice-pwd')}\\r\\n`;
      const answer = await fetch(session, { method: 'PATCH', body: fragment, headers: {
        'Content-Type': 'application/trickle-ice-sdpfrag', 'If-Match': '*' } });
      if (answer.status !== 200) throw new Error(await answer.text());
      this.etags.push(answer.headers.get('ETag'));
      const text = await answer.text();
      const remote = peer.currentRemoteDescription.sdp.replace(/a=ice-ufrag:.*/g, `a=ice-ufrag:${named(text, 'ice-ufrag')}`)
        .replace(/a=ice-pwd:.*/g, `a=ice-pwd:${named(text, 'ice-pwd')}`);
      await peer.setRemoteDescription({ type: 'answer', sdp: remote });
    },
    async stats() {
      const stats = [...(await peer.getStats()).values()];
      const inbound = stats.find(({ type, kind }) => type === 'inbound-rtp' && kind === 'video');
      const transport = stats.find(({ type }) => type === 'transport');
      const pair = stats.find(({ id }) => id === transport?.selectedCandidatePairId);
      return { decoded: inbound?.framesDecoded ?? 0, freezes: inbound?.freezeCount ?? 0, lost: inbound?.packetsLost ?? 0,
               username: transport?.iceLocalUsernameFragment, changes: transport?.selectedCandidatePairChanges,
               dtls: transport?.dtlsState, local: pair?.localCandidateId, state: peer.connectionState };
    },
  };
}
"""


def stats(page: Page) -> dict[str, object]:
    found: dict[str, object] = page.evaluate("viewer.stats()")
    return found


def wait_decoded(page: Page, more: int) -> None:
    before = int(str(stats(page)["decoded"]))
    wait_for(f"{more} more decoded frames", lambda: int(str(stats(page)["decoded"])) >= before + more, 30)


def test_chromium_restarts_ice_again_and_again(page: Page, known_service: Service) -> None:
    page.goto(f"{known_service.url}/docs")
    page.evaluate(CLIENT, f"{known_service.url}/whep/live")
    wait_decoded(page, 10)
    for _ in range(3):
        before = stats(page)
        page.evaluate("viewer.restart()")
        wait_for("another pair", lambda before=before: stats(page)["local"] != before["local"], 20)
        wait_decoded(page, 30)
    after = stats(page)
    assert after["state"] == after["dtls"] == "connected"
    assert after["lost"] == 0, after
    assert len(set(page.evaluate("viewer.etags"))) == 4
    assert known_service.stream()["viewers"] == 1


def test_restarts_that_overtake_each_other(page: Page, known_service: Service) -> None:
    page.goto(f"{known_service.url}/docs")
    page.evaluate(CLIENT, f"{known_service.url}/whep/live")
    wait_decoded(page, 5)
    page.evaluate("viewer.restart().then(() => viewer.restart()).then(() => viewer.restart())")
    wait_decoded(page, 60)
    assert stats(page)["state"] == "connected"


# --- viewers without goodbye -----------------------------------------------------------------------------------------


def open_files(service: Service) -> int:
    return len(list(Path(f"/proc/{service.process.pid}/fd").iterdir()))


def test_killed_viewers_are_gone_in_time_with_all_that_was_theirs(known_service: Service,
                                                                  viewer: Callable[[str], HeadlessViewer]) -> None:
    first = viewer(known_service.url)
    first.wait_frames(5)
    first.process.stop()
    wait_for("no viewer", lambda: known_service.stream()["viewers"] == 0, 10)
    before = open_files(known_service)
    killed = [viewer(known_service.url) for _ in range(3)]
    for one in killed:
        one.wait_frames(5)
    assert known_service.stream()["viewers"] == 3
    assert open_files(known_service) > before
    for one in killed:
        os.kill(one.process.pid, signal.SIGKILL)
    died = time.monotonic()
    wait_for("end of their sessions", lambda: known_service.stream()["viewers"] == 0, 25)
    print(f"gone after {time.monotonic() - died:.1f} s")
    assert time.monotonic() - died > 8.0, "an outage of 8 s would have ended them"
    assert known_service.request("GET", "/api/streams/live/viewers") == []
    wait_for("sockets closed", lambda: open_files(known_service) <= before, 10)


def test_a_viewer_that_is_silent_for_eight_seconds_goes_on(known_service: Service, viewer: Callable[[str], HeadlessViewer]) -> None:
    watching = viewer(known_service.url)
    watching.wait_frames(5)
    number = known_service.request("GET", "/api/streams/live/viewers")[0]["viewer"]
    watching.process.signal(signal.SIGSTOP)
    time.sleep(8)
    watching.process.signal(signal.SIGCONT)
    watching.wait_frames(30)
    assert [one["viewer"] for one in known_service.request("GET", "/api/streams/live/viewers")] == [number]
