"""The web pages, from the `web` package, and the reference of the API."""

from __future__ import annotations

import re
from http import HTTPStatus
from importlib.resources import files

from fastapi import APIRouter, Request, Response

from server.routes.api_reference import STYLE, STYLE_PATH, api_reference
from server.routes.content_negotiation import accepts
from server.routes.dependencies import ServiceDep
from server.routes.problems import Problem, shown
from server.service import Service

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
async def view(stream: str, request: Request, service: ServiceDep) -> Response:
    return _stream_page("view.html", stream, request, service)


@router.get("/control/{stream}")
async def control(stream: str, request: Request, service: ServiceDep) -> Response:
    return _stream_page("control.html", stream, request, service)


@router.get("/web/{name}")
async def web_file(name: str) -> Response:
    return _web_file(name)


@router.get("/docs")
async def docs(request: Request) -> Response:
    return Response(api_reference(request.app.openapi()), media_type=CONTENT_TYPES[".html"], headers=HEADERS)


@router.get(STYLE_PATH)
async def docs_style() -> Response:
    return Response(STYLE, media_type=CONTENT_TYPES[".css"], headers=HEADERS)


def _stream_page(name: str, stream: str, request: Request, service: Service) -> Response:
    """The page also comes when there is no such stream, with status 404: it tells a person in words, and waits for it."""
    if service.streams.find(stream) is not None:
        return _web_file(name)
    vary = {"Vary": "Accept"}
    if not accepts(request.headers.get("accept", ""), "text/html"):
        raise Problem(HTTPStatus.NOT_FOUND, f"no stream {shown(stream)}", headers=vary)
    page = _web_file(name)
    page.status_code = HTTPStatus.NOT_FOUND
    page.headers.update(vary)
    return page


def _web_file(name: str) -> Response:
    matched = _FILE_NAME.fullmatch(name)
    content_type = CONTENT_TYPES.get(matched[2]) if matched else None
    file = files("web") / name
    if content_type is None or not file.is_file():
        raise Problem(HTTPStatus.NOT_FOUND, f"no page {shown(name)}")
    return Response(file.read_bytes(), media_type=content_type, headers=HEADERS)
