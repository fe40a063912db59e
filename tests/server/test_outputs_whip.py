"""WHIP by its real process, into a real WebRTC receiver."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from aioice import stun
from encoded_stream import SIZE, EncodedStream
from test_outputs_recording import until
from whip_receiver import TOKEN, WhipReceiver

from server.outputs import output as output_module
from server.outputs.output import Output
from server.outputs.spec import OutputSpec
from server.outputs.whip_http import ice_servers


@asynccontextmanager
async def pushing(stream: EncodedStream, url: str, *, networks: tuple[str, ...] | None = None,
                  **spec: Any) -> AsyncIterator[Output]:
    made = OutputSpec.model_validate({"id": "sfu", "kind": "whip", "url": url, "token": TOKEN, **spec})
    output = Output(made, stream, recordings_dir="/", networks=networks, changed=lambda: None)
    output.source_changed("live", None, stream.input)
    output.start()
    try:
        yield output
    finally:
        await output.stop()


async def test_pictures_and_sound_arrive_and_keyframes_can_be_asked_for() -> None:
    async with WhipReceiver() as sfu, EncodedStream(sound=True) as stream:
        async with pushing(stream, f"{sfu.url}/whip/live") as output:
            await until(lambda: len(sfu.pictures) > 20 and sfu.loudest > 0.3)
            assert output.live
            assert {picture.shape for picture in sfu.pictures} == {SIZE[::-1]}
            assert any(picture.mean() > 200 for picture in sfu.pictures)
            before = stream.keyframe_requests
            await sfu.ask_for_keyframe()
            await until(lambda: stream.keyframe_requests > before)
            await until(lambda: output.frames > 20 and output.bytes_out > 1000)
        assert sfu.deleted == 1
    offer, = sfu.offers
    assert "H264" in offer
    assert "VP8" not in offer
    assert offer.count("a=sendonly") == 2
    assert "a=setup:actpass" in offer
    assert offer.count("a=group:BUNDLE 0 1") == 1


async def test_a_session_that_the_server_ends_is_made_again() -> None:
    async with WhipReceiver() as sfu, EncodedStream() as stream, pushing(stream, f"{sfu.url}/redirect/2") as output:
        await until(lambda: len(sfu.pictures) > 3)
        await sfu.drop()
        await until(lambda: output.state == "retrying")
        assert output.detail == "the WebRTC connection has ended"
        sfu.pictures.clear()
        await until(lambda: len(sfu.pictures) > 3 and output.live)
        assert output.restarts == 1


def test_ice_servers_in_link_headers() -> None:
    turn = '<turn:127.0.0.1:9?transport=udp>; rel="ice-server"; username="u"; credential="c"; credential-type="password"'
    server, = ice_servers([turn])
    assert (server.urls, server.username, server.credential) == ("turn:127.0.0.1:9?transport=udp", "u", "c")
    both = ice_servers([f'<stun:a.example:3478>; rel="ice-server", {turn}', '</x>; rel="help"', "<turn:b.example>; rel=other"])
    assert [one.urls for one in both] == ["stun:a.example:3478", "turn:127.0.0.1:9?transport=udp"]


class StunServer(asyncio.DatagramProtocol):
    """Tells who asks under which address it is seen."""

    def __init__(self) -> None:
        self.asked = 0

    def connection_made(self, transport: Any) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, address: Any) -> None:
        self.asked += 1
        request = stun.parse_message(data)
        answer = stun.Message(request.message_method, stun.Class.RESPONSE, request.transaction_id)
        answer.attributes["XOR-MAPPED-ADDRESS"] = address[:2]
        self._transport.sendto(bytes(answer), address)


async def test_the_answer_s_ice_servers_are_used_when_the_first_try_reaches_nobody() -> None:
    transport, stun_server = await asyncio.get_running_loop().create_datagram_endpoint(StunServer, local_addr=("127.0.0.1", 0))
    port = transport.get_extra_info("sockname")[1]
    try:
        async with (WhipReceiver(link=f'<stun:127.0.0.1:{port}>; rel="ice-server"', unreachable_answers=1) as sfu,
                    EncodedStream() as stream, pushing(stream, f"{sfu.url}/whip/live") as output):
            await until(lambda: len(sfu.pictures) > 3)
            assert len(sfu.offers) == 2
            assert stun_server.asked > 0
            assert sfu.deleted == 1, "the session that did not connect"
            assert output.restarts == 0
    finally:
        transport.close()


@pytest.mark.parametrize(("path", "token", "state", "detail"), [
    ("/whip/live", "of-somebody-else", "failed-config", "the WHIP endpoint answered 401, the token is missing or wrong"),
    ("/whip/live", None, "failed-config", "the WHIP endpoint answered 401, the token is missing or wrong"),
    ("/refuse/403", TOKEN, "failed-config", "the WHIP endpoint answered 403, the token does not entitle to this"),
    ("/refuse/404", TOKEN, "failed-config", "the WHIP endpoint answered 404, no such endpoint"),
    ("/refuse/409", TOKEN, "retrying", "the WHIP endpoint answered 409, another session is there"),
    ("/refuse/503", TOKEN, "retrying", "the WHIP endpoint answered 503, it is at capacity"),
    ("/refuse/200", TOKEN, "failed-config", "the WHIP endpoint answered 200, expected 201"),
    ("/redirect/9", TOKEN, "failed-config", "the WHIP endpoint redirects more than 5 times"),
])
async def test_refusals(path: str, token: str | None, state: str, detail: str) -> None:
    async with WhipReceiver() as sfu, EncodedStream() as stream, pushing(stream, sfu.url + path, token=token) as output:
        await until(lambda: output.state == state)
        assert output.detail == detail
        assert not len(stream.tracks.fanout("full/h264")), "nothing is encoded for an output that is not connected"


async def test_retry_after_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "BACKOFF_S", (60.0, 60.0))
    async with WhipReceiver() as sfu, EncodedStream() as stream, pushing(stream, f"{sfu.url}/refuse/503") as output:
        await until(lambda: output.restarts == 1)       # the server said 1 s


async def test_a_redirection_leads_only_where_outputs_may_go() -> None:
    """The address itself was checked when the output was made; it is looked up anew for each connection."""
    async with (WhipReceiver() as sfu, EncodedStream() as stream,
                pushing(stream, f"{sfu.url}/whip/live", networks=("10.0.0.0/8",)) as output):
        await until(lambda: output.state == "failed-config")
        assert "127.0.0.1" in str(output.detail)
        assert "source_networks" in str(output.detail)
        assert sfu.offers == []


async def test_nobody_there_is_retried_ever_more_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "BACKOFF_S", (0.1, 0.4))
    async with EncodedStream() as stream, pushing(stream, "http://127.0.0.1:9/whip/live") as output:
        await until(lambda: output.restarts >= 2)
        assert output.state == "retrying"
        assert output.detail == "no answer of the WHIP endpoint: connection refused"
