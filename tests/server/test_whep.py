"""WHEP with a real aiortc client against a running service."""

# ruff: noqa: ASYNC212 - the service is another process, a blocking request to it is quick

from __future__ import annotations

import asyncio
import re
import time

import httpx
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection
from conftest import Served, start_service, stop_service, wait_for
from test_rest_scene import assert_problem
from whep_viewer import WhepViewer, hide_addresses

OFFER_TYPE = {"Content-Type": "application/sdp"}
FRAGMENT_TYPE = {"Content-Type": "application/trickle-ice-sdpfrag"}


async def new_offer(kind: str = "video", direction: str = "recvonly") -> str:
    connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    try:
        connection.addTransceiver(kind, direction=direction)
        await connection.setLocalDescription(await connection.createOffer())
        return str(connection.localDescription.sdp)
    finally:
        await connection.close()


async def test_a_viewer_sees_the_stream(served: Served, client: httpx.Client) -> None:
    async with WhepViewer(served.url) as viewer:
        frames = [await viewer.next_frame() for _ in range(30)]
        assert {(frame.width, frame.height) for frame in frames} == {(512, 256)}
        assert client.get("/api/streams/live").json()["viewers"] == 1
        stats = client.get("/api/streams/live/stats").json()
        assert stats["packets_delivered"] >= 30
        assert stats["dropped_after_encoder"] == 0
        assert stats["latency_ms"]["p50"] > 0
    wait_for(lambda: client.get("/api/streams/live").json()["viewers"] == 0, "the viewer has left")


async def test_answer_is_h264_only_send_only_with_its_candidates(served: Served, client: httpx.Client) -> None:
    started = time.monotonic()
    response = client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE)
    assert time.monotonic() - started < 4.5, "gathering waited for a STUN server"
    assert response.status_code == 201
    assert response.headers["content-type"] == "application/sdp"
    assert response.headers["accept-patch"] == "application/trickle-ice-sdpfrag"
    codecs = {line.split()[1] for line in response.text.splitlines() if line.startswith("a=rtpmap:")}
    assert codecs == {"H264/90000", "rtx/90000"}
    assert "a=sendonly" in response.text
    assert "a=candidate:" in response.text
    assert "a=end-of-candidates" in response.text
    location = response.headers["location"]
    assert location.startswith("/whep/live/")
    assert len(location.removeprefix("/whep/live/")) >= 32
    assert client.delete(location).status_code == 200
    assert_problem(client.delete(location), 404, "no such WHEP session")


async def test_rtp_timestamps_match_the_light_messages(served: Served, client: httpx.Client) -> None:
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        announced = set()
        for _ in range(5):
            response = await viewer.http.get("/api/streams/live/lights")
            announced.add(response.json()["rtp_timestamp"] & 0xFFFFFFFF)
            await viewer.next_frame()
        for _ in range(5):
            await viewer.next_frame()
        assert announced <= {packet.timestamp for packet in viewer.rtp}


async def test_viewers_share_one_encoder_and_one_that_joins_late_starts_at_once(served: Served,
                                                                               client: httpx.Client) -> None:
    async with WhepViewer(served.url) as first:
        await first.next_frame()
        async with WhepViewer(served.url) as second:
            for _ in range(10):
                await asyncio.gather(first.next_frame(), second.next_frame())
            assert client.get("/api/streams/live").json()["viewers"] == 2
            stamps = [{packet.timestamp for packet in viewer.rtp} for viewer in (first, second)]
            assert len(stamps[0] & stamps[1]) >= 5
        for _ in range(5):
            await first.next_frame()


async def test_a_keyframe_request_reaches_the_shared_encoder(served: Served) -> None:
    """The encoder makes a keyframe every 2 s by itself; the one asked for comes sooner after the last."""
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        await viewer.new_keyframe()
        await asyncio.sleep(0.6)        # past the encoder's rate limit
        await viewer.receiver._send_rtcp_pli(viewer.rtp[0].ssrc)
        await viewer.new_keyframe()
        before, after = viewer.keyframe_timestamps()[-2:]
        assert (after - before) & 0xFFFFFFFF < 1.7 * 90_000


async def test_trickle(served: Served, client: httpx.Client) -> None:
    async with WhepViewer(served.url) as viewer:
        line = next(line for line in viewer.connection.localDescription.sdp.splitlines() if "a=candidate:" in line)
        username = re.search("a=ice-ufrag:(.*)", viewer.connection.localDescription.sdp)[1].strip()  # type: ignore[index]
        fragment = f"a=ice-ufrag:{username}\r\nm=video 9 RTP/AVP 0\r\na=mid:0\r\n{line}\r\na=end-of-candidates\r\n"
        url, tag = viewer.session_url, {"If-Match": viewer.etag}
        taken = client.patch(url, content=fragment, headers=FRAGMENT_TYPE | tag)
        assert taken.status_code == 204
        assert_problem(client.patch(url, content=fragment, headers=FRAGMENT_TYPE), 428, "if-match is missing")
        assert_problem(client.patch(url, content=fragment, headers=FRAGMENT_TYPE | {"If-Match": '"old"'}), 412)
        assert "etag" not in taken.headers
        every_time = client.patch(url, content=fragment, headers=FRAGMENT_TYPE | {"If-Match": "*"})     # as some clients do
        assert every_time.status_code == 204
        other = fragment.replace(username, "other")
        assert_problem(client.patch(url, content=other, headers=FRAGMENT_TYPE | tag), 409, "ice-ufrag 'other'")
        assert_problem(client.patch(url, content=fragment, headers=tag | {"Content-Type": "text/plain"}), 415)
        for bad in ("hello", "a=mid:0\na=candidate:x", "a=mid:0\na=candidate:1 1 udp x 1.2.3.4 5 typ host", line):
            assert_problem(client.patch(url, content=bad, headers=FRAGMENT_TYPE | tag), 400)
        assert_problem(client.patch(url, content="a" * 20_000, headers=FRAGMENT_TYPE | tag), 413)
        assert_problem(client.patch("/whep/live/guess", content=fragment, headers=FRAGMENT_TYPE | tag), 404)
        await viewer.next_frame()


async def test_discovery(client: httpx.Client) -> None:
    options = client.options("/whep/live")
    assert options.status_code == 204
    assert options.headers["accept-post"] == "application/sdp"
    assert client.get("/whep/live").status_code == 200
    assert client.head("/whep/live").headers["content-type"].startswith("application/sdp")


@pytest.mark.parametrize("body", [
    "", "v=0", "hello", "v=0\r\nm=video", "\x00\x01", "m=\r\n" * 50, "v=0\r\no=- 1 1 IN IP4 x\r\n"])
def test_what_is_no_offer_is_400(client: httpx.Client, body: str) -> None:
    assert_problem(client.post("/whep/live", content=body, headers=OFFER_TYPE), 400, "the ")


def test_other_methods_are_405_with_all_those_that_are_allowed(client: httpx.Client) -> None:
    for path, allowed in (("/whep/live", {"GET", "HEAD", "OPTIONS", "POST"}),
                          ("/whep/live/x", {"GET", "HEAD", "OPTIONS", "PATCH", "DELETE"})):
        refused = client.put(path, content="x")
        assert_problem(refused, 405, "PUT is not allowed")
        assert set(refused.headers["allow"].split(", ")) == allowed


async def test_what_the_client_accepts(client: httpx.Client) -> None:
    offer = await new_offer()
    for accept in ("application/json", "text/html, application/sdp;q=0"):
        assert_problem(client.post("/whep/live", content=offer, headers=OFFER_TYPE | {"Accept": accept}), 406, "accept is")
    for accept in ("application/sdp", "*/*", "text/html, application/*;q=0.5", ""):
        taken = client.post("/whep/live", content=offer, headers=OFFER_TYPE | {"Accept": accept})
        assert taken.status_code == 201
        client.delete(taken.headers["location"])


async def test_the_media_type_may_have_parameters_and_any_case(client: httpx.Client) -> None:
    taken = client.post("/whep/live", content=await new_offer(), headers={"Content-Type": "Application/SDP; charset=utf-8"})
    assert taken.status_code == 201
    patched = client.patch(taken.headers["location"], content="a=mid:0\r\na=end-of-candidates", headers={
        "Content-Type": "APPLICATION/trickle-ice-sdpfrag;x=y", "If-Match": taken.headers["etag"]})
    assert patched.status_code == 204
    client.delete(taken.headers["location"])


async def test_a_rendition_that_there_is_not(client: httpx.Client) -> None:
    for query in ("rendition=huge", "at_most=huge"):
        refused = client.post(f"/whep/live?{query}", content=await new_offer(), headers=OFFER_TYPE)
        assert_problem(refused, 400, "rendition is 'huge', expected one of full")


async def test_offers_that_cannot_be_served(client: httpx.Client) -> None:
    offer = await new_offer()
    assert_problem(client.post("/whep/none", content=offer, headers=OFFER_TYPE), 404, "no stream 'none'")
    assert_problem(client.post("/whep/live", content=offer, headers={"Content-Type": "text/plain"}), 415)
    assert_problem(client.post("/whep/live", content=b"\xff\xfe", headers=OFFER_TYPE), 400, "not UTF-8")
    assert_problem(client.post("/whep/live", content="v=0\r\n" + "a" * 70_000, headers=OFFER_TYPE), 413)
    assert_problem(client.post("/whep/live", content=await new_offer("audio"), headers=OFFER_TYPE), 400, "no video")
    assert_problem(client.post("/whep/live", content=await new_offer(direction="sendonly"), headers=OFFER_TYPE), 400)
    without_vp8 = offer.replace("VP8", "AV1")
    for wrong in (without_vp8.replace("H264", "H265"), without_vp8.replace("packetization-mode=1", "packetization-mode=0")):
        assert_problem(client.post("/whep/live", content=wrong, headers=OFFER_TYPE), 406, "packetization-mode=1 or video/VP8")
    assert_problem(client.post("/whep/live", content=offer.replace("a=ice-ufrag", "a=x"), headers=OFFER_TYPE), 400)
    cut = offer[:len(offer) // 2]
    assert client.post("/whep/live", content=cut, headers=OFFER_TYPE).status_code in (400, 406)


async def test_capacity_and_ice_servers(tmp_path_factory: pytest.TempPathFactory) -> None:
    config = tmp_path_factory.mktemp("config") / "mr360.toml"
    config.write_text('max_viewers = 1\nmax_streams = 1\nallowed_origins = ["https://player.example"]\n'
                      '[[ice_servers]]\nurl = "stun:stun.example:3478"\n'
                      '[[ice_servers]]\nurl = "turn:turn.example:3478"\nusername = "u"\ncredential = "c"\n')
    served = start_service("--config", str(config), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            first = client.post("/whep/live", content=await new_offer(),
                                headers=OFFER_TYPE | {"Origin": "https://player.example"})
            links = ['<stun:stun.example:3478>; rel="ice-server"', '<turn:turn.example:3478>; rel="ice-server"; '
                     'username="u"; credential="c"; credential-type="password"']
            sockets = [f'</api/streams/live/{name}>; rel="urn:x-mr360:{name}"' for name in ("lights", "events")]
            assert first.headers.get_list("link") == [*sockets, *links]
            assert first.headers["cache-control"] == "no-store"
            assert client.options("/whep/live").headers.get_list("link") == links
            assert first.headers["access-control-allow-origin"] == "https://player.example"
            assert "location" in first.headers["access-control-expose-headers"].lower()
            preflight = client.options("/whep/live", headers={"Origin": "https://player.example",
                                                              "Access-Control-Request-Method": "POST",
                                                              "Access-Control-Request-Headers": "content-type"})
            assert preflight.headers["access-control-allow-origin"] == "https://player.example"
            refused = client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE)
            assert_problem(refused, 503, "max_viewers")
            assert refused.headers["retry-after"]
            assert_problem(client.post("/api/streams", json={"name": "b"}), 503, "max_streams")
            # The first one never connects: it is reaped and makes room.
            wait_for(lambda: client.get(first.headers["location"]).status_code == 404, "the session is reaped", 30)
            again = client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE)
            assert again.status_code == 201
    finally:
        stop_service(served)


async def test_an_address_that_does_not_resolve_delays_nobody(served: Served, client: httpx.Client) -> None:
    """Browsers hide their address behind an mDNS name. One that nobody knows costs the connection no second."""
    async with WhepViewer(served.url, hide_address=True) as viewer:
        await viewer.next_frame()
    hidden = hide_addresses(await new_offer())
    durations = {}
    for name, offer in (("hidden", hidden), ("plain", await new_offer())):
        began = time.monotonic()
        response = client.post("/whep/live", content=offer, headers=OFFER_TYPE)
        durations[name] = time.monotonic() - began
        assert client.delete(response.headers["location"]).status_code == 200
    assert durations["hidden"] < durations["plain"] + 0.9, durations


async def test_a_viewer_is_listed_with_what_its_receiver_reports(served: Served, client: httpx.Client) -> None:
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        seen = {"rtt_ms": None}
        while seen["rtt_ms"] is None:       # until a receiver report has come
            await viewer.next_frame()
            [seen] = client.get("/api/streams/live/viewers").json()
        assert (seen["state"], seen["rendition"], seen["codec"], seen["sound"]) == ("connected", "full", "h264", False)
        assert (seen["rtp_packets_lost"], seen["fraction_lost"], seen["dropped"]) == (0, 0.0, 0)
        assert seen["rtp_packets_sent"] >= 1
        assert viewer.session_url.rpartition("/")[2] not in str(seen)
    wait_for(lambda: client.get("/api/streams/live/viewers").json() == [], "the viewer has left")
    metrics = dict(line.rsplit(" ", 1) for line in client.get("/metrics").text.splitlines() if not line.startswith("#"))
    assert float(metrics['mr360_rtp_packets_sent_total{stream="live"}']) >= len(viewer.rtp)
    assert float(metrics['mr360_track_takers{stream="live",track="full/h264"}']) == 0
