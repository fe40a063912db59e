"""Loss, delay, outages, narrow links and viewers that vanish: each viewer in a network of its own.

`make test` uses a small picture; with BENCH_NETWORKS=full (`make bench-networks`) it is 2048×1024 at 30 frames/s and 10 Mbit/s, for
as long as the requirements say, and the figures are printed.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from media_servers import Publisher
from network_namespace import Network, NetworkUnavailableError
from network_relay import Link
from network_viewer import NetworkViewer, network_viewer
from playwright.sync_api import Playwright, sync_playwright
from processes import Process, free_port, wait_for
from running_service import Service

from server.demo.clip import demo_clip
from server.demo.sample_scene import sample_scene

pytestmark = [pytest.mark.e2e, pytest.mark.alone]

FULL = os.environ.get("BENCH_NETWORKS") == "full"
SETTLED_S = 3.0
LOSSY, DELAY_MS = 0.02, 40.0
LEAST_DECODED, LONGEST_FREEZE_S = 0.97, 1.0
OUTAGE_S, BACK_WITHIN_S = 5.0, 2.0
STEPS_DOWN_WITHIN_S = 8.0
GONE_WITHIN_S = 30.0


@dataclass(frozen=True)
class Scale:
    """What is sent, for how long it is watched, and the link that is too narrow for it."""

    width: int
    fps: int
    bitrate_bps: int
    lossy_s: float
    narrow_bps: float
    narrow_s: float


SCALE = Scale(2048, 30, 10_000_000, 20.0, 3e6, 20.0) if FULL else Scale(1024, 15, 3_000_000, 16.0, 1.0e6, 8.0)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service on every address of this machine, showing a noisy camera: its bitrate is what it may be."""
    folder = tmp_path_factory.mktemp("networks")
    camera = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    service = Service(folder, "--host", "0.0.0.0", "--source", camera.replace("rtmp:", "rtmp-listen:"),
                      environment={"MR360_BITRATE_BPS": str(SCALE.bitrate_bps)})
    publisher = None
    try:
        service.wait_ready()
        service.request("PUT", "/api/streams/live/scene", sample_scene())
        publisher = Publisher(demo_clip(SCALE.width, SCALE.fps, still=not FULL, noisy=True), camera, folder / "camera.log")
        service.wait_live()
        yield service
    finally:
        if publisher is not None:
            publisher.process.kill()
        print(f"--- {service.log.name}\n{service.process.output()[-3000:]}")
        service.stop()


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as running:
        yield running


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    with contextlib.ExitStack() as stack:
        try:
            found = stack.enter_context(Network(tmp_path))
        except NetworkUnavailableError as error:
            pytest.skip(str(error))
        yield found


@pytest.fixture
def remote(playwright: Playwright, network: Network, live: Service) -> Iterator[NetworkViewer]:
    """Chromium behind `network`, which still behaves well, with a picture."""
    with network_viewer(playwright, f"http://{network.near}:{live.port}", network) as viewer:
        viewer.wait_playing()
        yield viewer


@pytest.fixture
def report(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Keep a line of figures; `make bench-networks` prints them and writes them to the file of BENCH_NETWORKS_JSON."""
    def kept(**figures: object) -> None:
        line = json.dumps({"case": request.node.name, "size": f"{SCALE.width}x{SCALE.width // 2}", "fps": SCALE.fps, **figures})
        print(line)
        if file := os.environ.get("BENCH_NETWORKS_JSON"):
            with Path(file).open("a") as lines:
                lines.write(line + "\n")
    return kept


def test_loss_and_delay_cost_few_frames(live: Service, network: Network, remote: NetworkViewer,
                                        report: Callable[..., None]) -> None:
    link = Link(loss=LOSSY, delay_ms=DELAY_MS)
    network.behave(link, link)
    remote.wait(SETTLED_S)
    sent, before, began = fresh_count(live), remote.stats(), time.time()
    remote.wait(SCALE.lossy_s)
    sent, after, ended = fresh_count(live) - sent, remote.stats(), time.time()
    decoded = after["framesDecoded"] - before["framesDecoded"]
    pause_s = remote.longest_pause_s(began, ended)
    report(decoded=decoded, sent=sent, share=round(decoded / sent, 4), longest_pause_ms=round(1e3 * pause_s),
           freezes=after["freezeCount"] - before["freezeCount"],
           frozen_s=round(after["totalFreezesDuration"] - before["totalFreezesDuration"], 3),
           packets_lost=after["packetsLost"] - before["packetsLost"], nacks=after["nackCount"] - before["nackCount"],
           retransmitted=after.get("retransmittedPacketsReceived", 0) - before.get("retransmittedPacketsReceived", 0),
           plis=after["pliCount"] - before["pliCount"], width=after["frameWidth"], relay=network.behave(link, link))
    assert after["packetsReceived"] - before["packetsReceived"] > 0.5 * sent
    assert decoded >= LEAST_DECODED * sent
    assert pause_s <= LONGEST_FREEZE_S


def test_an_outage_ends_with_the_network(live: Service, network: Network, remote: NetworkViewer,
                                         report: Callable[..., None]) -> None:
    remote.wait(SETTLED_S)
    network.cut()
    cut_at = time.time()
    remote.wait(OUTAGE_S)
    network.behave()
    mended_at = time.time()
    with contextlib.suppress(AssertionError):
        wait_for("picture after the outage", lambda: remote.frames()[-1][0] > mended_at, 15)
    remote.wait(1.0)
    back = [at for at, _ in remote.frames() if at > mended_at]
    report(back_ms=round(1e3 * (back[0] - mended_at)) if back else None, sessions=remote.sessions, frames_since=len(back))
    assert not [at for at, _ in remote.frames() if cut_at + 1.0 < at < mended_at], "the network was not cut"
    assert back, f"no picture 15 s after the outage, the client is {remote.state}"
    assert back[0] - mended_at <= BACK_WITHIN_S
    assert remote.sessions == 1, "a new session was made"
    assert len(back) >= 0.5 * SCALE.fps, "one picture came back, but not the stream"


def test_a_narrow_link_gets_a_smaller_rendition_and_nobody_else_does(
        live: Service, playwright: Playwright, network: Network, remote: NetworkViewer, report: Callable[..., None]) -> None:
    if live.http.get("/api/streams/live/viewers").status_code == 404:
        pytest.xfail("viewers are not listed, and their renditions do not adapt yet")
    with network_viewer(playwright, live.url) as second, network_viewer(playwright, live.url) as third:
        others = [second, third]
        for viewer in others:
            viewer.wait_playing()
        network.behave(Link(rate_bps=SCALE.narrow_bps, queue_ms=300.0), Link())
        narrowed_at = time.time()
        wait_for("smaller picture behind the narrow link", lambda: remote.stats()["frameWidth"] < SCALE.width, STEPS_DOWN_WITHIN_S)
        stepped_s = time.time() - narrowed_at
        listed = live.request("GET", "/api/streams/live/viewers")
        remote.wait(SETTLED_S)
        sent, before, began = fresh_count(live), remote.stats(), time.time()
        remote.wait(SCALE.narrow_s)
        sent, after, ended = fresh_count(live) - sent, remote.stats(), time.time()
        widths = [[width for at, width in viewer.frames() if at > began] for viewer in others]
        pause_s = remote.longest_pause_s(began, ended)
        decoded = after["framesDecoded"] - before["framesDecoded"]
        report(stepped_down_ms=round(1e3 * stepped_s), width=after["frameWidth"], decoded=decoded, sent=sent,
               longest_pause_ms=round(1e3 * pause_s), others_widths=[sorted(set(one)) for one in widths],
               others_frames=[len(one) for one in widths], viewers=listed, relay=network.behave())
    assert pause_s <= LONGEST_FREEZE_S
    assert after["framesDecoded"] - before["framesDecoded"] >= 0.9 * sent
    for one in widths:
        assert set(one) == {SCALE.width}
        assert len(one) >= 0.8 * sent


@pytest.mark.skipif(not FULL, reason="half a minute; test_sessions.py kills viewers too, without a network")
def test_viewers_that_vanish_are_gone(live: Service, network: Network, tmp_path: Path, report: Callable[..., None]) -> None:
    """One is killed, and one loses its network; neither says goodbye."""
    wait_for("leaving of earlier viewers", lambda: live.stream()["viewers"] == 0, GONE_WITHIN_S)
    base = f"http://{network.near}:{live.port}/whep/live"
    killed = Process([sys.executable, "-m", "server.demo.viewer", base], tmp_path / "killed.log")
    severed = Process(network.command(sys.executable, "-m", "server.demo.viewer", base), tmp_path / "severed.log")
    try:
        for viewer in (killed, severed):
            wait_for("picture", lambda viewer=viewer: f'"width": {SCALE.width}' in viewer.output(), 30)
        assert live.stream()["viewers"] == 2
        gone_at: list[float] = []
        began = time.monotonic()
        killed.signal(signal.SIGKILL)
        network.cut()
        while len(gone_at) < 2 and time.monotonic() < began + GONE_WITHIN_S + 10:
            left = int(live.stream()["viewers"])
            gone_at += [time.monotonic() - began] * (2 - left - len(gone_at))
            time.sleep(0.25)
        report(gone_s=[round(seconds, 1) for seconds in gone_at])
        assert len(gone_at) == 2, f"{2 - len(gone_at)} viewers are still there"
        assert gone_at[-1] <= GONE_WITHIN_S
    finally:
        killed.kill()
        severed.kill()


def fresh_count(service: Service) -> int:
    """Frames encoded, read when the worker has just told them: it does so twice a second."""
    before = service.stats()["frames_encoded"]
    return int(wait_for("new statistics", lambda: (count := service.stats()["frames_encoded"]) != before and count, 5.0, 0.02))
