"""WHEP, draft-ietf-wish-whep: POST an offer, PATCH candidates, DELETE to leave."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import APIRouter, Request, Response

from server.delivery.sdp_offer import MAX_FRAGMENT_BYTES, MAX_OFFER_BYTES, CodecError, OfferError, parse_fragment
from server.delivery.whep import RETRY_AFTER_S, TooManyViewersError, WhepSession
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, shown
from server.routes.strict_json import media_type, read_body

OFFER_TYPE = "application/sdp"
FRAGMENT_TYPE = "application/trickle-ice-sdpfrag"

router = APIRouter(prefix="/whep", tags=["whep"])


@router.post("/{stream}", status_code=201, response_class=Response, openapi_extra={
    "requestBody": {"required": True, "content": {OFFER_TYPE: {"schema": {"type": "string"}}}}})
async def offer(stream: StreamDep, service: ServiceDep, request: Request) -> Response:
    """Answer an SDP offer. `Location` is the session, its `ETag` is for PATCH."""
    text = await _text(request, OFFER_TYPE, MAX_OFFER_BYTES)
    try:
        session, answer = await service.whep.open(stream, text)
    except CodecError as error:
        raise Problem(HTTPStatus.NOT_ACCEPTABLE, str(error)) from None
    except OfferError as error:
        raise Problem(HTTPStatus.BAD_REQUEST, str(error)) from None
    except TooManyViewersError as error:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error), headers={"Retry-After": str(RETRY_AFTER_S)}) from None
    response = Response(answer, HTTPStatus.CREATED, media_type=OFFER_TYPE, headers={
        "Location": f"/whep/{stream.name}/{session.id}", "ETag": session.etag, "Accept-Patch": FRAGMENT_TYPE})
    _add_ice_servers(response, service.ice_server_links)
    return response


@router.options("/{stream}", status_code=204, response_class=Response)
async def describe(stream: StreamDep, service: ServiceDep) -> Response:
    """What the endpoint takes, and the ICE servers a client may use before it makes its offer."""
    response = Response(status_code=HTTPStatus.NO_CONTENT,
                        headers={"Accept-Post": OFFER_TYPE, "Allow": "OPTIONS, GET, HEAD, POST"})
    _add_ice_servers(response, service.ice_server_links)
    return response


@router.api_route("/{stream}", methods=["GET", "HEAD"], include_in_schema=False)
async def discover(stream: StreamDep) -> Response:
    return Response(media_type=OFFER_TYPE)


@router.patch("/{stream}/{session_id}", status_code=204, response_class=Response, openapi_extra={
    "requestBody": {"required": True, "content": {FRAGMENT_TYPE: {"schema": {"type": "string"}}}}})
async def trickle(stream: StreamDep, session_id: str, service: ServiceDep, request: Request) -> Response:
    """More ICE candidates of the viewer. `If-Match` carries the session's ETag."""
    session = _session(service.whep.find(stream.name, session_id))
    text = await _text(request, FRAGMENT_TYPE, MAX_FRAGMENT_BYTES)
    tag = request.headers.get("if-match")
    if tag is None:
        raise Problem(HTTPStatus.PRECONDITION_REQUIRED, "if-match is missing, expected the session's ETag")
    if tag == "*":
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, "an ICE restart is not supported, expected a new session")
    if tag != session.etag:
        raise Problem(HTTPStatus.PRECONDITION_FAILED, f"if-match is {shown(tag)}, expected the session's ETag")
    try:
        await session.add_candidates(parse_fragment(text))
    except OfferError as error:
        raise Problem(HTTPStatus.BAD_REQUEST, str(error)) from None
    return Response(status_code=HTTPStatus.NO_CONTENT)


@router.delete("/{stream}/{session_id}", response_class=Response)
async def leave(stream: StreamDep, session_id: str, service: ServiceDep) -> Response:
    """End the session."""
    await _session(service.whep.find(stream.name, session_id)).close("the viewer left")
    return Response()


@router.options("/{stream}/{session_id}", status_code=204, response_class=Response, include_in_schema=False)
async def describe_session(stream: StreamDep, session_id: str) -> Response:
    return Response(status_code=HTTPStatus.NO_CONTENT,
                    headers={"Accept-Patch": FRAGMENT_TYPE, "Allow": "OPTIONS, GET, HEAD, PATCH, DELETE"})


@router.api_route("/{stream}/{session_id}", methods=["GET", "HEAD"], include_in_schema=False)
async def session_exists(stream: StreamDep, session_id: str, service: ServiceDep) -> Response:
    _session(service.whep.find(stream.name, session_id))
    return Response()


def _session(session: WhepSession | None) -> WhepSession:
    if session is None:
        raise Problem(HTTPStatus.NOT_FOUND, "no such WHEP session")
    return session


async def _text(request: Request, expected_type: str, limit: int) -> str:
    if media_type(request) != expected_type:
        raise Problem(HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
                      f"content-type is {shown(media_type(request))}, expected {expected_type}")
    try:
        return (await read_body(request, limit)).decode()
    except UnicodeDecodeError:
        raise Problem(HTTPStatus.BAD_REQUEST, "the body is not UTF-8") from None


def _add_ice_servers(response: Response, links: tuple[str, ...]) -> None:
    for link in links:
        response.headers.append("Link", link)
