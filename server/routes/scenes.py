"""The scene of a stream and its objects."""

from __future__ import annotations

import secrets
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Body, Header, Response

from renderer.scene import Scene, SceneObject
from server.live_scene import DuplicateObjectError, UnknownObjectError
from server.merge_patch import merge_patch
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, shown
from server.routes.strict_json import StrictJsonRoute
from server.service import Service
from server.stream import Stream

router = APIRouter(prefix="/api/streams/{stream}", tags=["scene"], route_class=StrictJsonRoute)

IfMatch = Annotated[str | None, Header()]
JsonObject = Annotated[dict[str, Any], Body()]
# The body is checked by hand (an id may be missing, a patch holds a part), the reference still names its schema.
OBJECT_BODY = {"requestBody": {"required": True, "content": {
    "application/json": {"schema": {"$ref": "#/components/schemas/SceneObject"}}}}}


@router.get("/scene")
async def get_scene(stream: StreamDep, response: Response) -> Scene:
    """The whole scene; `ETag` is for a later PUT."""
    response.headers["ETag"] = stream.live_scene.etag
    return stream.live_scene.scene


@router.put("/scene")
async def put_scene(stream: StreamDep, scene: Scene, service: ServiceDep, response: Response,
                    if_match: IfMatch = None) -> Scene:
    """Replace the whole scene; with `If-Match` only if nobody has changed it since."""
    live = stream.live_scene
    if if_match is not None and if_match != "*" and live.etag not in [tag.strip() for tag in if_match.split(",")]:
        raise Problem(HTTPStatus.PRECONDITION_FAILED, f"if-match is {shown(if_match)}, the scene is at {live.etag}")
    _check_assets(scene, service)
    live.replace(scene)
    response.headers["ETag"] = live.etag
    return live.scene


@router.get("/objects")
async def list_objects(stream: StreamDep) -> list[SceneObject]:
    """All virtual objects."""
    return list(stream.live_scene.scene.objects)


@router.post("/objects", status_code=201, openapi_extra=OBJECT_BODY)
async def add_object(stream: StreamDep, body: JsonObject, service: ServiceDep, response: Response) -> SceneObject:
    """Place an object; without `id` it gets a new one."""
    placed = SceneObject.model_validate({"id": f"object-{secrets.token_hex(4)}", **body})
    _check_assets(Scene(objects=(placed,)), service)
    try:
        stream.live_scene.add(placed)
    except DuplicateObjectError:
        raise Problem(HTTPStatus.CONFLICT, f"id {placed.id!r} is in use, expected a new id or a PATCH") from None
    response.headers["Location"] = f"/api/streams/{stream.name}/objects/{placed.id}"
    return placed


@router.get("/objects/{object_id}")
async def get_object(stream: StreamDep, object_id: str) -> SceneObject:
    """One object."""
    return _object(stream, object_id)


@router.patch("/objects/{object_id}", openapi_extra=OBJECT_BODY)
async def patch_object(stream: StreamDep, object_id: str, body: JsonObject, service: ServiceDep) -> SceneObject:
    """Merge (RFC 7396): null takes a member back to its default."""
    merged = merge_patch(_object(stream, object_id).model_dump(mode="json"), body)
    placed = SceneObject.model_validate(merged)
    if placed.id != object_id:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"id is {placed.id!r}, expected {object_id!r}: it cannot change")
    _check_assets(Scene(objects=(placed,)), service)
    stream.live_scene.update(placed)
    return placed


@router.delete("/objects/{object_id}", status_code=204)
async def delete_object(stream: StreamDep, object_id: str) -> None:
    """Take the object away."""
    _object(stream, object_id)
    stream.live_scene.remove(object_id)


def _object(stream: Stream, object_id: str) -> SceneObject:
    try:
        return stream.live_scene.get(object_id)
    except UnknownObjectError:
        raise Problem(HTTPStatus.NOT_FOUND, f"no object {shown(object_id)} in stream {stream.name!r}") from None


def _check_assets(scene: Scene, service: Service) -> None:
    unknown = service.assets.unknown_in(scene)
    if unknown is not None:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"mesh {unknown!r} is no asset, expected one of "
                      f"{', '.join(service.assets.names()) or 'none, there are no assets'}")
