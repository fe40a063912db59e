"""Tokens, TURN credentials, limits and edges: a service of its own with these settings."""

# ruff: noqa: ASYNC212 - the service is another process, a blocking request to it is quick

from __future__ import annotations

import asyncio
import base64
import hmac
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from aioice.ice import get_host_addresses
from conftest import Served, start_service, stop_service, wait_for
from test_rest_scene import assert_problem
from test_whep import OFFER_TYPE, new_offer
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from server.auth import AuthError, ForbiddenError, Right, Token, Tokens, bearer
from server.config import ConfigError, load_settings
from server.rate_limit import RateLimit, is_loopback, shared_network
from server.turn import turn_credentials

VIEWER, OTHER, CREW = "viewer-token-0123456789", "other-token-01234567890", "crew-token-012345678901"
SECRET = "the-secret-of-the-turn-server"
CONFIG = f"""
tokens = [
    {{ token = "{VIEWER}", may = ["view"], streams = ["live"] }},
    {{ token = "{OTHER}", may = ["view", "control"], streams = ["stage"] }},
    {{ token = "{CREW}", may = ["view", "control"] }},
]
turn = {{ urls = ["turn:turn.example:3478", "turns:turn.example:443?transport=tcp"], secret = "{SECRET}", ttl_s = 600 }}
allowed_origins = ["https://player.example"]
"""


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory, panorama: Path) -> Iterator[Served]:
    config = tmp_path_factory.mktemp("config") / "mr360.toml"
    config.write_text(CONFIG)
    served = start_service("--config", str(config), "--source", str(panorama), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get("/readyz").status_code == 200, "the service is ready", 60)
        yield served
    finally:
        stop_service(served)


@pytest.fixture
def anybody(guarded: Served) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=guarded.url, timeout=30) as client:
        yield client


def by(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


# --- who may what ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "path"), [
    ("GET", "/api/streams"), ("GET", "/api/streams/live"), ("GET", "/api/streams/live/scene"), ("GET", "/api/assets"),
    ("PUT", "/api/streams/live/scene"), ("POST", "/api/streams"), ("DELETE", "/api/streams/live/objects/x"), ("GET", "/metrics"),
    ("POST", "/api/assets"), ("GET", "/api/streams/live/lights"), ("GET", "/api/streams/none"), ("POST", "/whep/live"),
    ("POST", "/whep/none")])
def test_nothing_without_a_known_token(anybody: httpx.Client, method: str, path: str) -> None:
    for headers in ({}, by("guess"), {"Authorization": f"Basic {CREW}"}, {"Authorization": "Bearer"}):
        refused = anybody.request(method, path, headers=headers, json={"name": "b"} if method in ("POST", "PUT") else None)
        assert_problem(refused, 401, "token")
        assert refused.headers["www-authenticate"] == "Bearer"


def test_what_needs_no_token(anybody: httpx.Client) -> None:
    for path in ("/healthz", "/readyz", "/", "/view/live", "/control/live", "/web/view.js", "/docs", "/openapi.json"):
        assert anybody.get(path).status_code == 200, path


def test_a_viewer_may_view_its_stream_and_nothing_else(anybody: httpx.Client) -> None:
    assert anybody.get("/api/streams/live/scene", headers=by(VIEWER)).status_code == 200
    assert anybody.get("/metrics", headers=by(VIEWER)).status_code == 200
    assert_problem(anybody.put("/api/streams/live/scene", json={}, headers=by(VIEWER)), 403, "may not control stream 'live'")
    assert_problem(anybody.post("/api/streams", json={"name": "b"}, headers=by(VIEWER)), 403, "may not control")
    assert_problem(anybody.get("/api/streams/live", headers=by(OTHER)), 403, "may not view stream 'live'")
    assert_problem(anybody.post("/whep/live", headers=by(OTHER)), 403, "may not view stream 'live'")
    assert_problem(anybody.post("/api/streams", json={"name": "b"}, headers=by(OTHER)), 403, "may not control")
    assert [stream["name"] for stream in anybody.get("/api/streams", headers=by(VIEWER)).json()] == ["live"]
    assert anybody.get("/api/streams", headers=by(OTHER)).json() == []


def test_the_crew_may_control(anybody: httpx.Client) -> None:
    assert anybody.put("/api/streams/live/scene", json={}, headers=by(CREW)).status_code == 200
    assert anybody.post("/api/streams", json={"name": "stage"}, headers=by(CREW)).status_code == 201
    assert anybody.get("/api/streams/stage/scene", headers=by(OTHER)).status_code == 200
    assert anybody.delete("/api/streams/stage", headers=by(CREW)).status_code == 204


async def test_a_session_needs_no_token_but_its_url(anybody: httpx.Client) -> None:
    joined = anybody.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE | by(VIEWER))
    assert joined.status_code == 201
    url = joined.headers["location"]
    assert anybody.get(url).status_code == 200
    patched = anybody.patch(url, content="a=end-of-candidates", headers={
        "Content-Type": "application/trickle-ice-sdpfrag", "If-Match": joined.headers["etag"]})
    assert patched.status_code == 204
    assert anybody.delete(url).status_code == 200


async def test_websockets(guarded: Served) -> None:
    url = guarded.url.replace("http", "ws", 1) + "/api/streams/live/events"
    for options in ({}, {"subprotocols": ["bearer.guess"]}, {"additional_headers": by("guess")}):
        with pytest.raises(InvalidStatus) as refused:
            await connect(url, **options)   # type: ignore[arg-type]
        assert refused.value.response.status_code == 401
    async with connect(url, additional_headers=by(VIEWER)) as socket:
        assert json.loads(await asyncio.wait_for(socket.recv(), 20))["type"] == "scene"
    async with connect(url, subprotocols=[f"bearer.{VIEWER}"]) as socket:  # type: ignore[list-item]
        assert socket.subprotocol == f"bearer.{VIEWER}"
        await socket.send(json.dumps({"type": "transform", "id": "x"}))
        async with asyncio.timeout(20):
            while (event := json.loads(await socket.recv()))["type"] != "error":
                pass
        assert event["detail"] == "the token may not control the stream"
    async with connect(url, subprotocols=[f"bearer.{CREW}"]) as socket:  # type: ignore[list-item]
        await socket.send(json.dumps({"type": "transform", "id": "x"}))
        async with asyncio.timeout(20):
            while (event := json.loads(await socket.recv()))["type"] != "error":
                pass
        assert "no object 'x'" in event["detail"]


def test_a_foreign_page_sees_what_it_needs(anybody: httpx.Client) -> None:
    page = {"Origin": "https://player.example"}
    for method in ("POST", "PATCH", "DELETE", "OPTIONS"):
        preflight = anybody.options("/whep/live", headers=page | {
            "Access-Control-Request-Method": method, "Access-Control-Request-Headers": "authorization,content-type,if-match"})
        assert preflight.status_code == 200, method
        allowed = preflight.headers["access-control-allow-headers"].lower()
        assert all(name in allowed for name in ("authorization", "content-type", "if-match"))
    refused = anybody.post("/whep/live", headers=page)
    assert refused.status_code == 401
    assert refused.headers["access-control-allow-origin"] == "https://player.example"
    exposed = refused.headers["access-control-expose-headers"].lower()
    assert all(name in exposed for name in ("etag", "link", "location", "accept-patch", "retry-after"))
    stranger = anybody.options("/whep/live", headers={"Origin": "https://evil.example", "Access-Control-Request-Method": "POST"})
    assert "access-control-allow-origin" not in stranger.headers


def test_tokens_by_themselves() -> None:
    tokens = Tokens([Token(token=VIEWER, may=["view"], streams=["live"]), Token(token=CREW, may=["view", "control"])])
    tokens.check(VIEWER, Right.VIEW, "live")
    tokens.check(VIEWER, Right.VIEW, None)
    for right, stream in ((Right.VIEW, "stage"), (Right.CONTROL, "live"), (Right.CONTROL, None)):
        with pytest.raises(ForbiddenError):
            tokens.check(VIEWER, right, stream)
    tokens.check(CREW, Right.CONTROL, None)
    for wrong in (None, "", CREW + "x", CREW[:-1], "ü\udcff"):
        with pytest.raises(AuthError):
            tokens.check(wrong, Right.VIEW, "live")
    Tokens([]).check(None, Right.CONTROL, "live")
    assert [bearer(header) for header in ("Bearer a", "bearer  a ", "Basic a", "Bearer ", "", None)] == ["a", "a"] + [None] * 4


@pytest.mark.parametrize("setting", [
    {"tokens": [{"token": "short", "may": ["view"]}]}, {"tokens": [{"token": VIEWER, "may": ["look"]}]},
    {"tokens": [{"token": VIEWER, "may": []}]}, {"tokens": VIEWER}, {"tokens": [VIEWER]},
    {"turn": {"urls": ["http://x"], "secret": SECRET}}, {"turn": {"urls": ["turn:x"], "secret": SECRET, "ttl_s": 1}},
    {"turn": SECRET}])
def test_secrets_are_not_shown_when_they_are_wrong(setting: dict[str, object]) -> None:
    for given, environment in ((setting, {}), ({}, {f"MR360_{name.upper()}": json.dumps(value) for name, value in setting.items()}),
                               ({}, {f"MR360_{name.upper()}": f"{{{value}" for name, value in setting.items()})):
        with pytest.raises(ConfigError) as error:
            load_settings(given, environment=environment)
        assert not re.search(f"{VIEWER}|short|{SECRET}", str(error.value)), str(error.value)
    settings = load_settings({"tokens": [{"token": VIEWER, "may": ["view"]}],
                              "turn": {"urls": ["turn:x"], "secret": SECRET}}, None, {})
    assert not re.search(f"{VIEWER}|{SECRET}", repr(settings) + settings.model_dump_json())


# --- TURN ------------------------------------------------------------------------------------------------------------


LINK = re.compile(r'<(?P<url>[^>]+)>; rel="ice-server"; username="(?P<expiry>\d+):(?P<name>\w+)"; '
                  r'credential="(?P<credential>[^"]+)"; credential-type="password"')


def turn_links(response: httpx.Response) -> list[re.Match[str]]:
    matches = [LINK.fullmatch(link) for link in response.headers.get_list("link") if "ice-server" in link]
    assert all(matches), response.headers
    return [match for match in matches if match]


async def test_each_answer_has_turn_credentials_of_its_own(anybody: httpx.Client) -> None:
    answers = [anybody.options("/whep/live", headers=by(VIEWER)),
               anybody.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE | by(VIEWER))]
    names = set()
    for answer in answers:
        links = turn_links(answer)
        assert [link["url"] for link in links] == ["turn:turn.example:3478", "turns:turn.example:443?transport=tcp"]
        for link in links:
            assert 590 < int(link["expiry"]) - time.time() < 610
            username = f"{link['expiry']}:{link['name']}".encode()
            assert base64.b64decode(link["credential"]) == hmac.digest(SECRET.encode(), username, "sha1")
            names.add(username)
        assert answer.headers["cache-control"] == "no-store"
    assert len(names) == 2
    assert not turn_links(anybody.options("/whep/live"))
    anybody.delete(answers[1].headers["location"])


def test_turn_credentials_of_a_known_moment() -> None:
    username, credential = turn_credentials("north", 3600, now=1_700_000_000.9)
    assert username.startswith("1700003600:")
    assert base64.b64decode(credential) == hmac.digest(b"north", username.encode(), "sha1")


# --- limits ----------------------------------------------------------------------------------------------------------


def test_rate_limit_of_an_address() -> None:
    now = [0.0]
    limit = RateLimit(burst=3, per_second=0.5, clock=lambda: now[0])
    assert [limit.take("192.0.2.1") for _ in range(4)] == [0.0, 0.0, 0.0, 2.0]
    assert limit.take("192.0.2.2") == 0.0
    assert all(limit.take(address) == 0.0 for address in ("127.0.0.1", "::1", "") for _ in range(9))
    now[0] = 1.0
    assert limit.take("192.0.2.1") == 1.0
    now[0] = 2.0
    assert limit.take("192.0.2.1") == 0.0
    now[0] = 100.0
    assert [limit.take("192.0.2.1") for _ in range(4)] == [0.0, 0.0, 0.0, 2.0]


async def test_edges_ports_and_too_many_offers(tmp_path_factory: pytest.TempPathFactory) -> None:
    """At capacity viewers are sent on; media stays in its range; who asks too often has to wait."""
    config = tmp_path_factory.mktemp("config") / "mr360.toml"
    config.write_text('max_viewers = 2\nhost = "0.0.0.0"\nudp_ports = "47310-47311"\nadvertised_addresses = ["203.0.113.7"]\n'
                      'edges = ["https://a.example/whep/{stream}", "https://b.example/live"]\n')
    served = start_service("--config", str(config), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        here = get_host_addresses(use_ipv4=True, use_ipv6=False)[0]
        with httpx.Client(base_url=f"http://{here}:{served.url.rpartition(':')[2]}", timeout=30) as client:
            offer = await new_offer()
            answers = [client.post("/whep/live", content=offer, headers=OFFER_TYPE) for _ in range(5)]
            assert [answer.status_code for answer in answers] == [201, 201, 307, 307, 429]
            assert re.findall(r"a=candidate:\S+ 1 udp \d+ (\S+ \d+)", "".join(answer.text for answer in answers)) == [
                "203.0.113.7 47310", "203.0.113.7 47311"]
            edges = {"https://a.example/whep/live", "https://b.example/live"}       # one at random
            assert {answer.headers["location"] for answer in answers[2:4]} <= edges
            assert_problem(answers[4], 429, "too many offers")
            assert int(answers[4].headers["retry-after"]) >= 1
    finally:
        stop_service(served)


async def test_no_free_port_is_503(tmp_path_factory: pytest.TempPathFactory) -> None:
    config = tmp_path_factory.mktemp("config") / "mr360.toml"
    config.write_text('udp_ports = "47320-47320"\n')
    served = start_service("--config", str(config), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            first = client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE)
            assert first.status_code == 201
            refused = client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE)
            assert_problem(refused, 503, "no UDP port from 47320 to 47320 is free")
            assert refused.headers["retry-after"]
            client.delete(first.headers["location"])
            assert client.post("/whep/live", content=await new_offer(), headers=OFFER_TYPE).status_code == 201
    finally:
        stop_service(served)


def test_what_stands_for_one_client() -> None:
    assert shared_network("192.0.2.7") == shared_network("::ffff:192.0.2.7") == "192.0.2.7"
    assert shared_network("2001:db8::1") == shared_network("2001:db8::ffff:1") != shared_network("2001:db8:0:1::1")
    assert is_loopback("::ffff:127.0.0.1")
    assert is_loopback("")
    assert not is_loopback("2001:db8::1%eth0")


async def test_one_address_cannot_hold_all_places_without_connecting(tmp_path_factory: pytest.TempPathFactory) -> None:
    config = tmp_path_factory.mktemp("config") / "mr360.toml"
    config.write_text('max_viewers = 6\nhost = "0.0.0.0"\nroot_path = "/hall"\n')
    served = start_service("--config", str(config), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        here = get_host_addresses(use_ipv4=True, use_ipv6=False)[0]
        with httpx.Client(base_url=f"http://{here}:{served.url.rpartition(':')[2]}", timeout=30) as client:
            offer = await new_offer()
            answers = [client.post("/whep/live", content=offer, headers=OFFER_TYPE) for _ in range(5)]
            assert [answer.status_code for answer in answers] == [201] * 4 + [503]
            assert_problem(answers[4], 503, "4 viewers of this address are not connected yet")
            assert answers[0].headers["location"].startswith("/hall/whep/live/")
            assert "</hall/api/streams/live/lights>" in answers[0].headers["link"]
            assert client.get("/api/streams/live/playback").json()[0]["url"].endswith("/hall/whep/live")
            assert client.delete(answers[0].headers["location"].removeprefix("/hall")).status_code == 200
            assert client.post("/whep/live", content=offer, headers=OFFER_TYPE).status_code == 201
    finally:
        stop_service(served)
