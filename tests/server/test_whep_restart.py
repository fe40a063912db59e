"""ICE restart over WHEP with a real aiortc viewer: the picture goes on."""

# ruff: noqa: ASYNC212 - the service is another process, a blocking request to it is quick

from __future__ import annotations

import asyncio
import re
import secrets

import httpx
import pytest
from aiortc import rtcicetransport
from aiortc.sdp import candidate_from_sdp
from conftest import Served
from test_rest_scene import assert_problem
from test_whep import FRAGMENT_TYPE
from whep_viewer import WhepViewer

from server.delivery import ice
from server.delivery.media_addresses import MediaAddresses


@pytest.fixture(autouse=True)
def _viewers_that_can_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtcicetransport, "Connection", rtcicetransport.Connection)      # put back at the end
    ice.install(MediaAddresses())


def new_fragment() -> tuple[str, str, str]:
    username, password = secrets.token_hex(4), secrets.token_hex(16)
    return username, password, f"m=video 9 UDP/TLS/RTP/SAVPF 0\r\na=mid:0\r\na=ice-ufrag:{username}\r\na=ice-pwd:{password}\r\n"


async def restart(viewer: WhepViewer) -> httpx.Response:
    """As a browser does it: our new credentials go with the request, the service's come back."""
    username, password, fragment = new_fragment()
    answer = await viewer.http.patch(viewer.session_url, content=fragment, headers=FRAGMENT_TYPE | {"If-Match": "*"})
    assert answer.status_code == 200, answer.text
    agent = ice.connection(viewer.connection)
    agent.restart(value(answer.text, "ice-ufrag"), value(answer.text, "ice-pwd"))
    agent._local_username, agent._local_password = username, password
    for line in re.findall(r"a=candidate:(.*)\r\n", answer.text):
        await agent.add_remote_candidate(rtcicetransport.candidate_to_aioice(candidate_from_sdp(line)))
    return answer


def value(fragment: str, name: str) -> str:
    found = re.search(f"a={name}:(.*)\r\n", fragment)
    assert found, fragment
    return found[1]


async def nominated_anew(viewer: WhepViewer, before: object) -> None:
    agent = ice.connection(viewer.connection)
    async with asyncio.timeout(20):
        while agent._nominated[1] is before:  # noqa: ASYNC110
            await asyncio.sleep(0.02)


async def test_frames_go_on_through_several_restarts(served: Served) -> None:
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        tags = {viewer.etag}
        for _ in range(3):
            before = ice.connection(viewer.connection)._nominated[1]
            answer = await restart(viewer)
            assert answer.headers["content-type"] == "application/trickle-ice-sdpfrag"
            assert "a=candidate:" in answer.text
            tags.add(answer.headers["etag"])
            await nominated_anew(viewer, before)
            count = len(viewer.rtp)
            async with asyncio.timeout(20):
                while len(viewer.rtp) < count + 10:
                    await viewer.next_frame()
        assert len(tags) == 4
        assert viewer.connection.connectionState == "connected"


async def test_after_a_restart_the_old_generation_is_refused(served: Served, client: httpx.Client) -> None:
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        answer = await restart(viewer)
        url, old, new = viewer.session_url, {"If-Match": viewer.etag}, {"If-Match": answer.headers["etag"]}
        late = "a=ice-ufrag:gone\r\nm=video 9 UDP/TLS/RTP/SAVPF 0\r\na=mid:0\r\na=end-of-candidates\r\n"
        assert_problem(client.patch(url, content=late, headers=FRAGMENT_TYPE | old), 412, "if-match")
        assert_problem(client.patch(url, content=late, headers=FRAGMENT_TYPE | new), 409, "ice-ufrag 'gone'")
        unnamed = late.partition("\r\n")[2]
        assert client.patch(url, content=unnamed, headers=FRAGMENT_TYPE | new).status_code == 204
        await viewer.next_frame()


@pytest.mark.parametrize(("fragment", "complaint"), [
    ("m=video 9 UDP/TLS/RTP/SAVPF 0\r\na=mid:0\r\n", "no a=ice-ufrag and a=ice-pwd"),
    ("a=ice-ufrag:abcd\r\n", "no a=ice-ufrag and a=ice-pwd"),
    ("a=ice-ufrag:ab\r\na=ice-pwd:aaaaaaaaaaaaaaaaaaaaaaaa\r\n", "username must satisfy"),
    ("a=ice-ufrag:abcd\r\na=ice-pwd:short\r\n", "password must satisfy"),
])
async def test_a_restart_that_cannot_be_changes_nothing(served: Served, client: httpx.Client, fragment: str,
                                                        complaint: str) -> None:
    async with WhepViewer(served.url) as viewer:
        await viewer.next_frame()
        wrong = client.patch(viewer.session_url, content=fragment, headers=FRAGMENT_TYPE | {"If-Match": "*"})
        assert_problem(wrong, 400, complaint)
        end = client.patch(viewer.session_url, content="a=mid:0\r\na=end-of-candidates\r\n",
                           headers=FRAGMENT_TYPE | {"If-Match": viewer.etag})
        assert end.status_code == 204
        for _ in range(3):
            await viewer.next_frame()
