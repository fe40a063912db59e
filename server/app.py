"""The ASGI application. Its lifespan owns the service and everything the service starts."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from fastapi import Depends, FastAPI
from starlette.middleware.cors import CORSMiddleware

from server.config import Settings
from server.routes import assets, health, live, outputs, pages, playback, problems, scenes, streams, whep
from server.routes.access import check_access
from server.service import Service

DESCRIPTION = ("Live 360-degree video as backdrop and light source for virtual objects, streamed to WebXR. WebSockets: "
               "/api/streams/{stream}/lights and /api/streams/{stream}/events. Errors are RFC 9457 problem JSON.")


def create_app(settings: Settings) -> FastAPI:
    """The service as an ASGI application; it runs between the start and the end of its lifespan."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        service = Service(settings)
        app.state.service = service
        service.start()
        try:
            yield
        finally:
            await service.close()

    app = FastAPI(title="mr360", version=package_version(), description=DESCRIPTION, lifespan=lifespan,
                  docs_url=None, redoc_url=None, redirect_slashes=False)
    problems.install(app)
    if settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware, allow_origins=settings.allowed_origins,
            allow_methods=["GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "If-Match"],
            expose_headers=["Accept-Patch", "Accept-Post", "ETag", "Link", "Location", "Retry-After", "WWW-Authenticate"])
    # the others say for themselves what needs a token
    guarded, others = (streams, scenes, live, assets, outputs, playback), (whep, health, pages)
    for routes in guarded:
        app.include_router(routes.router, dependencies=[Depends(check_access)])
    for routes in others:
        app.include_router(routes.router)
    app.state.routes = [route for routes in (*guarded, *others) for route in routes.router.routes]
    return app


def package_version() -> str:
    try:
        return version("mr360")
    except PackageNotFoundError:    # run from a checkout that is not installed
        return "0+unknown"
