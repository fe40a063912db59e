"""What happens now: lights over REST and WebSocket, events and transforms over WebSocket."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable
from http import HTTPStatus
from typing import Any, Literal
from urllib.parse import urlsplit

from fastapi import APIRouter, Depends, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, ConfigDict, ValidationError

from renderer.scene import Id, Rotation, Scale, SceneObject, Vector
from server.auth import Right
from server.event_outbox import Event, EventOutbox
from server.live_scene import UnknownObjectError
from server.routes.access import AccessDep
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, describe_error, shown
from server.routes.strict_json import parse_json
from server.stream import Stream

router = APIRouter(prefix="/api/streams/{stream}", tags=["live"])

_NOT_ALLOWED: Event = {"type": "error", "detail": "the token may not control the stream"}


class Transform(BaseModel):
    """What a headset's controller sends while it holds an object; members that are missing stay as they are."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    type: Literal["transform"]
    id: Id
    position: Vector | None = None
    rotation: Rotation | None = None
    scale: Scale | None = None


def check_origin(websocket: WebSocket, service: ServiceDep) -> None:
    """A foreign web page must not reach the WebSockets: browsers do not ask first, as they do for requests (CORS)."""
    origin = websocket.headers.get("origin")
    allowed = service.settings.allowed_origins
    if origin is None or "*" in allowed or origin in allowed:
        return
    if urlsplit(origin).netloc.lower() != websocket.headers.get("host", "").lower():
        raise Problem(HTTPStatus.FORBIDDEN, f"origin is {shown(origin)}, expected this service's own or one of the "
                      "setting allowed_origins")


@router.get("/lights")
async def get_lights(stream: StreamDep) -> dict[str, Any]:
    """The newest detection."""
    lights = await stream.lights.of_a_frame_now()
    if lights is None:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"no frame has been processed yet, the stream is {stream.state}",
                      headers={"Retry-After": "1"})
    return lights


@router.websocket("/lights", dependencies=[Depends(check_origin)])
async def watch_lights(websocket: WebSocket, stream: StreamDep, access: AccessDep) -> None:
    """One light message per processed frame; a slow client gets the newest."""
    await websocket.accept(access.subprotocol)
    with stream.lights.subscription() as mailbox:

        async def send() -> None:
            while True:
                await websocket.send_text(await mailbox.get())

        await _until_one_ends(send(), _discard_incoming(websocket))


@router.websocket("/events", dependencies=[Depends(check_origin)])
async def watch_events(websocket: WebSocket, stream: StreamDep, access: AccessDep) -> None:
    """The present state, then every change of it. Takes `Transform` messages of those who may control."""
    await websocket.accept(access.subprotocol)
    may_control = access.has(Right.CONTROL, stream.name)
    with stream.event_subscription() as outbox:

        async def send() -> None:
            while True:
                await websocket.send_text(json.dumps(await outbox.get(), separators=(",", ":")))

        await _until_one_ends(send(), _take_transforms(websocket, stream, outbox, may_control))


async def _until_one_ends(*steps: Awaitable[None]) -> None:
    tasks = [asyncio.ensure_future(step) for step in steps]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception) and not isinstance(result, WebSocketDisconnect):
            raise result


async def _discard_incoming(websocket: WebSocket) -> None:
    while (await websocket.receive())["type"] != "websocket.disconnect":
        pass


async def _take_transforms(websocket: WebSocket, stream: Stream, outbox: EventOutbox, may_control: bool) -> None:
    while (message := await websocket.receive())["type"] != "websocket.disconnect":
        error = _apply_transform(message.get("text"), stream) if may_control else _NOT_ALLOWED
        if error is not None:
            outbox.put(error)


def _apply_transform(text: str | None, stream: Stream) -> Event | None:
    """Move the object. Returns the error event to send back if the message is wrong."""
    try:
        if text is None:
            raise ValueError("the message is binary, expected JSON text")
        transform = Transform.model_validate(parse_json(text))
        changes = transform.model_dump(include={"position", "rotation", "scale"}, exclude_none=True)
        placed: SceneObject = stream.live_scene.get(transform.id)
        stream.live_scene.update(placed.model_copy(update=changes))
    except UnknownObjectError as error:
        return {"type": "error", "detail": f"no object {shown(error.args[0])} in stream {stream.name!r}"}
    except ValidationError as error:
        return {"type": "error", "detail": describe_error(error.errors()[0])["detail"]}
    except ValueError as error:
        return {"type": "error", "detail": f"the message cannot be used: {error}"}
    return None


