"""The WebSockets of a running service."""

# ruff: noqa: ASYNC212 - the service is another process, a blocking request to it is quick

from __future__ import annotations

import asyncio
import json
import time
from typing import Any

import httpx
import pytest
from conftest import Served, wait_for
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

LIMIT_S = 20.0
OBJECTS = "/api/streams/live/objects"


def socket_url(served: Served, name: str, stream: str = "live") -> str:
    return f"{served.url.replace('http', 'ws', 1)}/api/streams/{stream}/{name}"


async def receive(socket: ClientConnection) -> dict[str, Any]:
    message: dict[str, Any] = json.loads(await asyncio.wait_for(socket.recv(), LIMIT_S))
    return message


async def receive_type(socket: ClientConnection, kind: str) -> dict[str, Any]:
    while (event := await receive(socket))["type"] != kind:
        pass
    return event


async def test_lights_come_frame_by_frame(served: Served) -> None:
    async with connect(socket_url(served, "lights")) as socket:
        frames = [(await receive(socket))["frame"] for _ in range(10)]
    assert frames == sorted(set(frames))


async def test_nothing_is_rendered_for_nobody(served: Served, client: httpx.Client) -> None:
    async with connect(socket_url(served, "lights")) as socket:
        await receive(socket)

    def resting() -> bool:
        one = client.get("/api/streams/live/stats").json()["frames_rendered"]
        time.sleep(1.2)
        return bool(client.get("/api/streams/live/stats").json()["frames_rendered"] == one)

    wait_for(resting, "rendering stops")


async def test_events_begin_with_the_present_state(served: Served, client: httpx.Client) -> None:
    client.post(OBJECTS, json={"id": "ball", "mesh": "sphere"})
    async with connect(socket_url(served, "events")) as socket:
        scene, source, outputs, viewers = [await receive(socket) for _ in range(4)]
    assert (scene["type"], source["type"], outputs["type"], viewers["type"]) == ("scene", "source", "outputs", "viewers")
    assert outputs["outputs"] == []
    assert scene["scene"] == client.get("/api/streams/live/scene").json()
    assert source["state"] == "live"
    assert viewers["count"] == 0


async def test_events_tell_every_kind_of_change(served: Served, client: httpx.Client) -> None:
    async with connect(socket_url(served, "events")) as socket:
        await receive_type(socket, "viewers")
        client.post(OBJECTS, json={"id": "ball", "mesh": "sphere"})
        event = await receive(socket)
        assert (event["type"], event["id"], event["object"]["mesh"]) == ("object", "ball", "sphere")
        client.delete(f"{OBJECTS}/ball")
        assert (await receive(socket))["object"] is None
        client.put("/api/streams/live/scene", json={"camera_height": 3})
        assert (await receive(socket))["scene"]["camera_height"] == 3


async def test_transforms_move_objects(served: Served, client: httpx.Client) -> None:
    client.post(OBJECTS, json={"id": "ball", "mesh": "sphere", "position": [0, 0, -1]})
    async with connect(socket_url(served, "events")) as one, connect(socket_url(served, "events")) as other:
        await one.send(json.dumps({"type": "transform", "id": "ball", "position": [1, 2, 3], "rotation": [0, 1, 0, 0]}))
        event = await receive_type(other, "object")
        assert event["object"]["position"] == [1, 2, 3]
        assert event["object"]["scale"] == [1, 1, 1]
    assert client.get(f"{OBJECTS}/ball").json()["rotation"] == [0, 1, 0, 0]


@pytest.mark.parametrize(("message", "text"), [
    ('{"type": "transform", "id": "none"}', "no object 'none'"),
    ('{"type": "transform", "id": "ball", "position": [NaN, 0, 0]}', "NaN is no JSON value"),
    ('{"type": "transform", "id": "ball", "position": [1e999, 0, 0]}', "position.0 is inf"),
    ('{"type": "transform", "id": "ball", "scale": [0, 0, 0]}', "scale"),
    ('{"type": "transform", "id": "ball", "mesh": "box"}', "mesh is an unknown key"),
    ('{"type": "delete", "id": "ball"}', "type is 'delete'"),
    ("hello", "the message cannot be used"),
    ("[]", "body is []"),
    (b"\x00", "binary"),
])
async def test_wrong_messages_are_answered_and_change_nothing(served: Served, client: httpx.Client,
                                                              message: str | bytes, text: str) -> None:
    client.post(OBJECTS, json={"id": "ball", "mesh": "sphere"})
    tag = client.get("/api/streams/live/scene").headers["etag"]
    async with connect(socket_url(served, "events")) as socket:
        await socket.send(message)
        assert text in (await receive_type(socket, "error"))["detail"]
    assert client.get("/api/streams/live/scene").headers["etag"] == tag


async def test_a_message_too_large_ends_the_connection_only(served: Served, client: httpx.Client) -> None:
    async with connect(socket_url(served, "events")) as socket:
        await socket.send("x" * 100_000)
        with pytest.raises(ConnectionClosed):
            await receive_type(socket, "nothing has this type")
        assert socket.close_code == 1009
    assert client.get("/healthz").status_code == 200


@pytest.mark.parametrize("name", ["lights", "events"])
async def test_foreign_origins_and_unknown_streams_are_refused_before_the_handshake(served: Served, name: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        await connect(socket_url(served, name), origin="https://evil.example").__aenter__()     # type: ignore[arg-type]
    assert refused.value.response.status_code == 403
    with pytest.raises(InvalidStatus) as refused:
        await connect(socket_url(served, name, "none")).__aenter__()
    assert refused.value.response.status_code == 404
    async with connect(socket_url(served, name), origin=served.url) as socket:      # type: ignore[arg-type]
        await receive(socket)


async def test_a_client_that_never_reads_disturbs_nobody(served: Served, client: httpx.Client) -> None:
    async with connect(socket_url(served, "lights"), max_queue=1) as silent, \
               connect(socket_url(served, "lights")) as reading:
        for _ in range(60):
            await receive(reading)
        assert silent.state.name == "OPEN"
