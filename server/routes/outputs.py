"""Ways out of a stream: push to RTMP, RTSP and WHIP, record."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from server.merge_patch import merge_patch
from server.outputs.output import Output
from server.outputs.spec import OutputSpec, kind_of
from server.outputs.stream_outputs import DuplicateOutputError, TooManyOutputsError
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, shown
from server.routes.strict_json import StrictJsonRoute
from server.service import Service
from server.source_url import SourceUrlError
from server.stream import Stream

router = APIRouter(prefix="/api/streams/{stream}/outputs", tags=["outputs"], route_class=StrictJsonRoute)


def _output(stream: StreamDep, output: str) -> Output:
    found = stream.outputs.find(output)
    if found is None:
        raise Problem(HTTPStatus.NOT_FOUND, f"no output {shown(output)} of stream {stream.name!r}")
    return found


OutputDep = Annotated[Output, Depends(_output)]


@router.get("")
async def list_outputs(stream: StreamDep) -> list[dict[str, Any]]:
    """All outputs of the stream, without their secrets."""
    return [output.description() for output in stream.outputs]


@router.post("", status_code=201)
async def create_output(stream: StreamDep, spec: OutputSpec, service: ServiceDep, response: Response) -> dict[str, Any]:
    """Create an output; it starts at once, unless `enabled` is false."""
    _check_rendition(spec, stream)
    networks = await _checked(spec, service)
    try:
        output = stream.outputs.add(spec, networks)
    except DuplicateOutputError:
        raise Problem(HTTPStatus.CONFLICT, f"output {shown(spec.id)} exists already, expected a new id") from None
    except TooManyOutputsError as error:
        raise Problem(HTTPStatus.CONFLICT, str(error)) from None
    response.headers["Location"] = f"/api/streams/{stream.name}/outputs/{spec.id}"
    return output.description()


@router.get("/{output}")
async def get_output(output: OutputDep) -> dict[str, Any]:
    """What was asked for, its state (disabled, connecting, live, retrying, failed-config), since when, and what has gone out."""
    return output.description()


@router.patch("/{output}")
async def patch_output(stream: StreamDep, output: OutputDep, patch: dict[str, Any], service: ServiceDep) -> dict[str, Any]:
    """Merge patch (RFC 7396). Anything but `playback` begins a new connection or file; with a new URL the token goes, unless the
    patch has one: it was for the old one."""
    if patch.get("id", output.spec.id) != output.spec.id:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"id is {shown(patch['id'])}, expected none: it does not change")
    before = output.spec.model_dump(mode="json")
    if isinstance(patch.get("url"), str):
        before["token"] = None
        if kind_of(patch["url"]) is not None:
            del before["kind"]      # the new URL says it
    spec = OutputSpec.model_validate(merge_patch(before, patch))
    _check_rendition(spec, stream)
    networks = output.networks if spec.url == output.spec.url else await _checked(spec, service)
    await output.replace(spec, networks)
    return output.description()


@router.delete("/{output}", status_code=204)
async def delete_output(stream: StreamDep, output: OutputDep) -> None:
    """End its connection or finish its file."""
    await stream.outputs.remove(output.spec.id)


def _check_rendition(spec: OutputSpec, stream: Stream) -> None:
    try:
        spec.check_rendition(stream.rendition_names)
    except ValueError as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error),
                      errors=[{"pointer": "/rendition", "detail": str(error)}]) from None


async def _checked(spec: OutputSpec, service: Service) -> tuple[str, ...] | None:
    try:
        return await service.check_rest_output(spec)
    except SourceUrlError as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error), errors=[{"pointer": "/url", "detail": str(error)}]) from None
