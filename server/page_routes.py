"""The web pages, from the `web` package, and the reference of the API."""

from __future__ import annotations

import re
from http import HTTPStatus
from importlib.resources import files

from fastapi import APIRouter, Request, Response

from server.api_reference import STYLE, STYLE_PATH, api_reference
from server.dependencies import StreamDep
from server.problems import Problem, shown

CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; media-src 'self' blob: mediastream:; "
                               "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "Permissions-Policy": "xr-spatial-tracking=(self), accelerometer=(self), gyroscope=(self)",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_FILE_NAME = re.compile(r"(?=.{1,100}$)[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*(\.[a-z]+)")

router = APIRouter(include_in_schema=False)


@router.get("/")
async def index() -> Response:
    return _web_file("index.html")


@router.get("/view/{stream}")
async def view(stream: StreamDep) -> Response:
    return _web_file("view.html")


@router.get("/control/{stream}")
async def control(stream: StreamDep) -> Response:
    return _web_file("control.html")


@router.get("/web/{name}")
async def web_file(name: str) -> Response:
    return _web_file(name)


@router.get("/docs")
async def docs(request: Request) -> Response:
    return Response(api_reference(request.app.openapi()), media_type=CONTENT_TYPES[".html"], headers=HEADERS)


@router.get(STYLE_PATH)
async def docs_style() -> Response:
    return Response(STYLE, media_type=CONTENT_TYPES[".css"], headers=HEADERS)


def _web_file(name: str) -> Response:
    matched = _FILE_NAME.fullmatch(name)
    content_type = CONTENT_TYPES.get(matched[2]) if matched else None
    file = files("web") / name
    if content_type is None or not file.is_file():
        raise Problem(HTTPStatus.NOT_FOUND, f"no page {shown(name)}")
    return Response(file.read_bytes(), media_type=content_type, headers=HEADERS)
