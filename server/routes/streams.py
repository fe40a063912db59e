"""Streams: list, create, describe, point to another source, delete; their picture and their numbers."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field

from server.auth import Right
from server.routes.access import AccessDep
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, shown
from server.routes.strict_json import StrictJsonRoute
from server.service import Service
from server.snapshots import SnapshotError
from server.source_url import SourceUrlError
from server.streams import LIVE, DuplicateStreamError, TooManyStreamsError

router = APIRouter(prefix="/api/streams", tags=["streams"], route_class=StrictJsonRoute)


class NewStream(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    source: Annotated[str, Field(description="rtsp, rtsps, rtmp, rtmps or rtmp-listen URL")] | None = None


class StreamPatch(BaseModel):
    """A null source ends the pull; the last picture stays."""

    model_config = ConfigDict(extra="forbid")

    source: str | None = None


@router.get("")
async def list_streams(service: ServiceDep, access: AccessDep) -> list[dict[str, Any]]:
    """All streams that the client may view."""
    return [stream.description() for stream in service.streams if access.has(Right.VIEW, stream.name)]


@router.post("", status_code=201)
async def create_stream(new: NewStream, service: ServiceDep, response: Response) -> dict[str, Any]:
    """Create a stream; its worker starts at once."""
    source = await _checked(new.source, service)
    try:
        stream = service.streams.add(new.name, source)
    except DuplicateStreamError:
        raise Problem(HTTPStatus.CONFLICT, f"stream {shown(new.name)} exists already, expected a new name") from None
    except TooManyStreamsError:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"{service.settings.max_streams} streams exist, the setting "
                      "max_streams", headers={"Retry-After": "60"}) from None
    response.headers["Location"] = f"/api/streams/{stream.name}"
    return stream.description()


@router.get("/{stream}")
async def get_stream(stream: StreamDep) -> dict[str, Any]:
    """Source (credentials masked), state (idle, connecting, live, lost, failed), geometry, viewers, worker."""
    return stream.description()


@router.patch("/{stream}")
async def patch_stream(stream: StreamDep, patch: StreamPatch, service: ServiceDep) -> dict[str, Any]:
    """Pull from another source; null ends the pull."""
    if "source" in patch.model_fields_set:
        stream.set_source(await _checked(patch.source, service))
    return stream.description()


@router.delete("/{stream}", status_code=204)
async def delete_stream(stream: StreamDep, service: ServiceDep) -> None:
    """Disconnect its viewers and end its worker."""
    if stream.name == LIVE:
        raise Problem(HTTPStatus.CONFLICT, f"stream {LIVE!r} always exists, expected a PATCH of its source to null")
    await service.remove_stream(stream)


@router.get("/{stream}/snapshot.jpg", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}})
async def snapshot(stream: StreamDep) -> Response:
    """The newest composite."""
    try:
        picture = await stream.snapshot()
    except SnapshotError as error:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error), headers={"Retry-After": "1"}) from None
    return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-store"})


@router.get("/{stream}/stats")
async def stats(stream: StreamDep) -> dict[str, Any]:
    """Stage times and counters of the worker, and what became of its packets.

    `quality` says what accuracy the worker has given up to keep the frame rate: `level`, the number of steps down in force, by
    `reductions`, each with its value in `settings`; `predicted_error`, relative to the radiance of what is drawn (0: nothing given
    up); `load`, the time that a frame takes, light included, by the time that there is; `decisions` so far, and the last ones with
    their reasons. `light_interval` is the mean number of frames to a reading of the light.
    """
    return stream.stats()


@router.get("/{stream}/viewers")
async def viewers(stream: StreamDep, service: ServiceDep) -> list[dict[str, Any]]:
    """Who watches: rendition, codec, what the viewer's receiver reports (`fraction_lost` of the last second, round-trip time, its
    own `estimate_bps` of its bandwidth), what was sent, sent again, asked for, and lost to slowness (`dropped`)."""
    return [session.describe() for session in service.whep.of(stream)]


async def _checked(source: str | None, service: Service) -> str | None:
    if source is None:
        return None
    try:
        return await service.check_rest_source(source)
    except SourceUrlError as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error),
                      errors=[{"pointer": "/source", "detail": str(error)}]) from None
