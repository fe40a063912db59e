"""Models: upload, list, delete."""

from __future__ import annotations

import re
from email.message import Message
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from server.assets import (
    NAME_PATTERN,
    AssetError,
    AssetStorageError,
    AssetTooLargeError,
    DuplicateAssetError,
)
from server.routes.content_negotiation import media_type
from server.routes.dependencies import ServiceDep
from server.routes.problems import Problem, shown

GLB_TYPES = ("model/gltf-binary", "application/octet-stream")

router = APIRouter(prefix="/api/assets", tags=["assets"])


@router.get("")
async def list_assets(service: ServiceDep) -> list[dict[str, Any]]:
    """All models."""
    return [service.assets.describe(name) for name in service.assets.names()]


@router.post("", status_code=201, openapi_extra={
    "requestBody": {"required": True, "content": {GLB_TYPES[0]: {"schema": {"type": "string", "format": "binary"}}}}})
async def upload_asset(request: Request, service: ServiceDep, response: Response,
                       name: Annotated[str | None, Query(pattern=NAME_PATTERN)] = None) -> dict[str, Any]:
    """Store a GLB under `?name=`, or the name in `Content-Disposition`, or a new one; use it as `asset:NAME`."""
    kind = media_type(request)
    if kind not in GLB_TYPES:
        raise Problem(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"content-type is {shown(kind)}, expected {GLB_TYPES[0]}")
    try:
        asset = await service.assets.add(name or _disposition_name(request), request.stream())
    except DuplicateAssetError as error:
        raise Problem(HTTPStatus.CONFLICT, str(error)) from None
    except AssetTooLargeError as error:
        raise Problem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, str(error)) from None
    except AssetError as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from None
    except AssetStorageError as error:
        raise Problem(HTTPStatus.INSUFFICIENT_STORAGE, str(error)) from None
    response.headers["Location"] = f"/api/assets/{asset['name']}"
    return asset


@router.delete("/{name}", status_code=204)
async def delete_asset(name: str, service: ServiceDep) -> None:
    """Delete a model that no scene uses."""
    if not service.assets.exists(name):
        raise Problem(HTTPStatus.NOT_FOUND, f"no asset {shown(name)}")
    for stream in service.streams:
        scene = stream.live_scene.scene
        users = [placed.id for placed in (*scene.objects, *scene.local_scene) if placed.mesh == f"asset:{name}"]
        if users:
            raise Problem(HTTPStatus.CONFLICT, f"asset {name!r} is the mesh of {users[0]!r} in stream {stream.name!r}")
    service.assets.remove(name)


def _disposition_name(request: Request) -> str | None:
    header = request.headers.get("content-disposition")
    if header is None:
        return None
    message = Message()
    message["content-disposition"] = header
    name = (message.get_filename() or "").removesuffix(".glb")
    if not re.match(NAME_PATTERN, name):
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"file name is {shown(name)}, expected {NAME_PATTERN}")
    return name
