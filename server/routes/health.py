"""Liveness, readiness, Prometheus."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Depends, Response
from prometheus_client import CONTENT_TYPE_LATEST

from server.routes.access import check_view
from server.routes.dependencies import ServiceDep
from server.routes.problems import Problem

router = APIRouter(tags=["operation"])


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """200 as long as the service answers."""
    return {"status": "alive"}


@router.get("/readyz")
async def readyz(service: ServiceDep) -> dict[str, Any]:
    """200 when the worker of every stream is ready and answers, else 503 with the streams that are not."""
    waiting = {stream.name: stream.detail or "the worker is starting" for stream in service.streams
               if not stream.ready}
    if waiting:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"not ready: {', '.join(sorted(waiting))}",
                      headers={"Retry-After": "1"}, streams=waiting)
    return {"status": "ready", "streams": [stream.name for stream in service.streams]}


@router.get("/metrics", response_class=Response, dependencies=[Depends(check_view)])
async def metrics(service: ServiceDep) -> Response:
    return Response(service.metrics.exposition(service.streams), media_type=CONTENT_TYPE_LATEST)
