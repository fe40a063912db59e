"""What routes ask for: the service, a stream by its name."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from server.routes.problems import Problem, shown
from server.service import Service
from server.stream import Stream


def _service(connection: HTTPConnection) -> Service:
    service = connection.app.state.service
    assert isinstance(service, Service)
    return service


ServiceDep = Annotated[Service, Depends(_service)]


def _stream(stream: str, service: ServiceDep) -> Stream:
    found = service.streams.find(stream)
    if found is None:
        raise Problem(HTTPStatus.NOT_FOUND, f"no stream {shown(stream)}")
    return found


StreamDep = Annotated[Stream, Depends(_stream)]
