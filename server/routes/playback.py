"""Every way to watch a stream."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request

from server.outputs.playback import ways_to_watch
from server.routes.dependencies import ServiceDep, StreamDep

router = APIRouter(prefix="/api/streams/{stream}/playback", tags=["playback"])


@router.get("")
async def list_playback(stream: StreamDep, service: ServiceDep, request: Request) -> list[dict[str, Any]]:
    """`protocol`, `url` and what else is known of each: our WHEP and page, the media servers behind live outputs (`via`), and what
    the settings name. A client takes the first that it can play, or one behind an output to spare this service."""
    return ways_to_watch(stream, str(request.base_url).rstrip("/"), service.settings)
