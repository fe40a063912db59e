"""Offers of all kinds: which sections are served, and that nothing else than OfferError comes out of the parsers."""

from __future__ import annotations

import asyncio
import re

import httpx
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.sdp import SessionDescription
from conftest import Served
from hypothesis import given, settings
from hypothesis import strategies as st
from test_rest_scene import assert_problem
from test_whep import OFFER_TYPE
from whep_viewer import WhepViewer

from server.delivery.ice_fragment import parse_fragment
from server.delivery.sdp_offer import CodecError, OfferError, parse_offer

FINGERPRINT = ":".join(["AB"] * 32)
CANDIDATE = "a=candidate:1 1 udp 2130706431 192.0.2.1 40000 typ host"


def transport(username: str) -> list[str]:
    return [f"a=ice-ufrag:{username}", f"a=ice-pwd:{username * 6}", f"a=fingerprint:sha-256 {FINGERPRINT}", "a=setup:actpass",
            "a=rtcp-mux"]


VIDEO = ["a=rtpmap:96 VP8/90000", "a=rtpmap:102 H264/90000",
         "a=fmtp:102 level-asymmetry-allowed=1;packetization-mode=1;profile-level-id=42e01f"]
AUDIO = ["a=rtpmap:111 opus/48000/2"]


def section(first: str, mid: str, *lines: str) -> list[str]:
    return [f"m={first}", "c=IN IP4 0.0.0.0", f"a=mid:{mid}", *lines]


def offer(*sections: list[str], bundle: str | None = None) -> str:
    mids = [line.removeprefix("a=mid:") for one in sections for line in one if line.startswith("a=mid:")]
    group = f"a=group:BUNDLE {bundle if bundle is not None else ' '.join(mids)}"
    head = ["v=0", "o=- 1 2 IN IP4 127.0.0.1", "s=-", "t=0 0", *([group] if bundle != "" else [])]
    return "".join(f"{line}\r\n" for part in (head, *sections) for line in part)


def video(mid: str = "1", *lines: str, port: int = 9, direction: str = "recvonly", codecs: list[str] = VIDEO) -> list[str]:
    return section(f"video {port} UDP/TLS/RTP/SAVPF 96 102", mid, f"a={direction}", *codecs, *lines)


def audio(mid: str = "0", *lines: str, port: int = 9, codecs: list[str] = AUDIO) -> list[str]:
    return section(f"audio {port} UDP/TLS/RTP/SAVPF 111", mid, "a=recvonly", *codecs, *lines)


def data(mid: str, *lines: str) -> list[str]:
    return section("application 9 UDP/DTLS/SCTP webrtc-datachannel", mid, "a=sctp-port:5000", *lines)


def test_sound_is_served_beside_the_picture() -> None:
    parsed = parse_offer(offer(audio("0", *transport("aaaa")), video("1", *transport("bbbb"))))
    assert (parsed.sound, parsed.codec, parsed.served, parsed.head, parsed.username) == (
        True, "h264", (0, 1), ("audio", "0"), "aaaa")


@pytest.mark.parametrize("sound", [
    audio("0", *transport("aaaa"), codecs=["a=rtpmap:111 PCMU/8000"]), audio("0", *transport("aaaa"), port=0),
    [line for line in audio("0", *transport("aaaa")) if line != "a=recvonly"] + ["a=sendonly"]])
def test_sound_that_cannot_be_served_is_rejected_and_the_picture_comes(sound: list[str]) -> None:
    parsed = parse_offer(offer(sound, video("1", *transport("bbbb"))))
    assert (parsed.sound, parsed.served, parsed.head, parsed.username) == (False, (1,), ("video", "1"), "bbbb")


def test_sections_that_are_not_bundled_with_the_picture_are_left_out() -> None:
    parsed = parse_offer(offer(audio("0", *transport("aaaa")), video("1", *transport("bbbb")), bundle=""))
    assert (parsed.sound, parsed.served) == (False, (1,))


def test_bundle_only_sections_take_the_transport_of_the_first() -> None:
    """RFC 8843 section 7.1.3: they have none of their own in a first offer."""
    parsed = parse_offer(offer(audio("0", *transport("aaaa"), CANDIDATE), video("1", "a=bundle-only", port=0)))
    assert parsed.served == (0, 1)
    assert [media.ice.usernameFragment for media in SessionDescription.parse(parsed.text).media if media.ice] == ["aaaa", "aaaa"]
    behind_data = parse_offer(offer(data("0", *transport("cccc"), CANDIDATE), video("1", "a=bundle-only", port=0)))
    assert (behind_data.served, behind_data.head, behind_data.username) == ((1,), ("video", "1"), "cccc")
    assert CANDIDATE in behind_data.text


def test_vp8_for_who_has_no_h264_of_ours() -> None:
    only_vp8 = video("0", *transport("aaaa"), codecs=VIDEO[:1])
    assert parse_offer(offer(only_vp8)).codec == "vp8"
    baseline_0 = video("0", *transport("aaaa"), codecs=[line.replace("packetization-mode=1", "packetization-mode=0")
                                                        for line in VIDEO])
    assert parse_offer(offer(baseline_0)).codec == "vp8"
    two = parse_offer(offer(only_vp8, video("1", *transport("bbbb"))))
    assert (two.codec, two.served) == ("h264", (1,))


def test_the_answer_has_every_section_of_the_offer_in_its_order() -> None:
    parsed = parse_offer(offer(data("d", *transport("cccc")), audio("0", *transport("aaaa")), video("1", *transport("bbbb")),
                               video("2", *transport("dddd"))))
    answer = parsed.complete(offer(audio("0", *transport("eeee")), video("1", *transport("eeee"))))
    kinds = re.findall(r"m=(\w+) (\d+)", answer)
    assert kinds == [("application", "0"), ("audio", "9"), ("video", "9"), ("video", "0")]
    assert re.findall("a=mid:(.*)\r\n", answer) == ["d", "0", "1", "2"]
    assert "a=group:BUNDLE 0 1\r\n" in answer
    assert answer.count("a=inactive") == 2


@pytest.mark.parametrize(("text", "error", "complaint"), [
    (offer(video("0", *transport("aaaa")[2:])), OfferError, "no a=ice-ufrag"),
    (offer(video("0", *transport("aaaa")[:2], "a=rtcp-mux")), OfferError, "no a=fingerprint"),
    (offer(video("0", *transport("aaaa"), port=0)), OfferError, "no video section"),
    (offer(video("0", *transport("aaaa"), direction="inactive")), OfferError, "no video section"),
    (offer(*[video(str(number), *transport("aaaa")) for number in range(9)]), OfferError, "9 media sections"),
    (offer(video("0", *transport("aaaa"), *[CANDIDATE] * 65)), OfferError, "65 candidates"),
    (offer(video("0", *transport("aaaa"), codecs=["a=rtpmap:96 AV1/90000"])), CodecError, "video/AV1"),
])
def test_what_is_wrong_is_named(text: str, error: type[OfferError], complaint: str) -> None:
    with pytest.raises(error, match=complaint):
        parse_offer(text)


def test_the_mid_of_a_section_may_come_after_its_candidates() -> None:
    """As in a browser's own description."""
    text = f"m=video 9 X 0\r\n{CANDIDATE}\r\na=ice-ufrag:abcd\r\na=mid:0\r\nm=audio 9 X 0\r\na=mid:1\r\n{CANDIDATE}\r\n"
    fragment = parse_fragment(text)
    assert [candidate.sdpMid for candidate in fragment.candidates] == ["0", "1"]
    assert fragment.username == "abcd"
    with pytest.raises(OfferError, match="without a=mid"):
        parse_fragment(text.replace("a=mid:0\r\n", ""))


def test_candidates_that_can_never_be_used_are_left_out() -> None:
    others = [CANDIDATE.replace(" udp ", " tcp "), CANDIDATE.replace(":1 1 ", ":1 2 "), CANDIDATE.replace(" udp ", " UDP ")]
    assert len(parse_fragment("\r\n".join(["a=mid:0", *others])).candidates) == 1


# --- what comes from strangers ---------------------------------------------------------------------------------------

LINES = st.sampled_from([
    "v=0", "t=0 0", "a=group:BUNDLE 0 1", "a=group:BUNDLE", "m=video 9 UDP/TLS/RTP/SAVPF 96", "m=audio 0 UDP/TLS/RTP/SAVPF 111",
    "m=application 9 UDP/DTLS/SCTP webrtc-datachannel", "m=video", "c=IN IP4 0.0.0.0", "c=x", "a=mid:0", "a=mid:1", "a=recvonly",
    "a=bundle-only", *VIDEO, *AUDIO, *transport("aaaa"), CANDIDATE, CANDIDATE.replace("192.0.2.1", "x.local"),
    CANDIDATE.replace("40000", "99999"), "a=candidate:1", "a=end-of-candidates", "a=ssrc:1", "a=fmtp:1 x", "a=rtcp:x", "a=setup:x",
    "a=extmap:1 urn:x", "a=rtcp-fb:* nack", "a=ice-lite", "a=\u2028m=video", "\x0bm=video 9 X 1", "a=ice-ufrag",
    "a=ssrc-group:FID 1 2"])


@given(st.lists(st.one_of(LINES, st.text(max_size=40))).map("\r\n".join))
@settings(max_examples=400, deadline=None)
def test_any_offer_is_answered_or_refused(text: str) -> None:
    try:
        parsed = parse_offer(text)
        parsed.complete(parsed.text)
    except OfferError:
        pass


@given(st.one_of(LINES, st.text(max_size=40)), st.integers(0, 30), st.booleans())
@settings(max_examples=300, deadline=None)
def test_a_good_offer_with_one_line_more_or_less(line: str, place: int, instead: bool) -> None:
    lines = offer(audio("0", *transport("aaaa"), CANDIDATE), video("1", *transport("aaaa"))).splitlines()
    lines[place:place + instead] = [line]
    try:
        parse_offer("\r\n".join(lines)).complete(offer(audio(), video()))
    except OfferError:
        pass
    except StopIteration:
        pytest.fail("the answer has less sections than were served")


@given(st.lists(st.one_of(LINES, st.text(max_size=40), st.from_regex(r"a=candidate:[\d ]{0,9}udp \d+ \S+ -?\d+ typ \w+"))))
@settings(max_examples=400, deadline=None)
def test_any_fragment_is_read_or_refused(lines: list[str]) -> None:
    try:
        fragment = parse_fragment("\r\n".join(lines))
    except OfferError:
        return
    assert all(0 <= candidate.port <= 65535 and candidate.component == 1 for candidate in fragment.candidates)


# --- with real clients -----------------------------------------------------------------------------------------------


async def test_a_viewer_that_offers_sound_data_and_a_second_picture_sees_the_stream(served: Served) -> None:
    viewer = WhepViewer(served.url)
    viewer.connection.createDataChannel("chat")
    viewer.connection.addTransceiver("audio", direction="recvonly")
    try:
        response = await viewer.http.post("/whep/live", content=await viewer.offer(), headers=OFFER_TYPE)
        assert response.status_code == 201, response.text
        sections = re.findall(r"m=(\w+) (\d+)", response.text)
        assert [(kind, port != "0") for kind, port in sections] == [("video", True), ("audio", True), ("application", False)]
        # aiortc takes no rejected section: it gets the answer without.
        answer = response.text[:response.text.index("m=application")]
        answer += viewer.connection.localDescription.sdp[viewer.connection.localDescription.sdp.index("m=application"):].replace(
            "actpass", "active")
        await viewer.connection.setRemoteDescription(RTCSessionDescription(answer, "answer"))
        for _ in range(3):
            await viewer.next_frame()
    finally:
        await viewer.close()


async def test_offers_without_a_password_or_rtcp_mux_are_refused(client: httpx.Client) -> None:
    connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    connection.addTransceiver("video", direction="recvonly")
    await connection.setLocalDescription(await connection.createOffer())
    text = str(connection.localDescription.sdp)
    await connection.close()
    for line in ("a=ice-pwd:", "a=rtcp-mux", "a=fingerprint:"):
        wrong = re.sub(f"(?m)^{line}.*\r\n", "", text)
        # another thread: the service's client must not hold up this loop
        answer = await asyncio.to_thread(client.post, "/whep/live", content=wrong, headers=OFFER_TYPE)
        assert_problem(answer, 400)
