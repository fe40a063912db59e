"""WHEP, draft-ietf-wish-whep: POST an offer, PATCH candidates or restart ICE, DELETE to leave.

The mechanics that it shares with WHIP are those of RFC 9725. With tokens a POST needs the right to view. What comes after it needs
none: nobody else knows the session's URL, 192 random bits.
"""

from __future__ import annotations

import math
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from server.auth import Right
from server.delivery.ice_fragment import MAX_FRAGMENT_BYTES, Fragment, parse_fragment
from server.delivery.media_addresses import NoSocketError
from server.delivery.sdp_offer import MAX_OFFER_BYTES, CodecError, OfferError
from server.delivery.whep import WhepSession
from server.delivery.whep_sessions import RETRY_AFTER_S, TooManyViewersError, UnknownRenditionError
from server.routes.access import AccessDep, check_view
from server.routes.content_negotiation import accepts, media_type
from server.routes.dependencies import ServiceDep, StreamDep
from server.routes.problems import Problem, shown
from server.routes.strict_json import read_body
from server.service import Service

OFFER_TYPE = "application/sdp"
FRAGMENT_TYPE = "application/trickle-ice-sdpfrag"
EXTENSIONS = {"lights": "urn:x-mr360:lights", "events": "urn:x-mr360:events"}      # WebSocket: relation type (README)

router = APIRouter(prefix="/whep", tags=["whep"])


def _rate(service: ServiceDep, request: Request) -> None:
    wait_s = service.offers.take(request.client.host if request.client else "")
    if wait_s:
        raise Problem(HTTPStatus.TOO_MANY_REQUESTS, "too many offers from this address, expected fewer",
                      headers={"Retry-After": str(math.ceil(wait_s))})


def _accept(request: Request) -> None:
    accept = ",".join(request.headers.getlist("accept"))
    if not accepts(accept, OFFER_TYPE):
        raise Problem(HTTPStatus.NOT_ACCEPTABLE, f"accept is {shown(accept)}, expected {OFFER_TYPE} in it")


@router.post("/{stream}", status_code=201, response_class=Response, dependencies=[Depends(check_view), Depends(_rate)],
             openapi_extra={"requestBody": {"required": True, "content": {OFFER_TYPE: {"schema": {"type": "string"}}}}})
async def offer(stream: StreamDep, service: ServiceDep, request: Request,
                rendition: Annotated[str | None, Query(description="send this one whatever happens")] = None,
                at_most: Annotated[str | None, Query(description="the best one that the viewer can decode")] = None) -> Response:
    """Answer an SDP offer. `Location` is the session, its `ETag` is for PATCH, `Link` names ICE servers and WebSockets."""
    text = await _text(request, OFFER_TYPE, MAX_OFFER_BYTES)
    _accept(request)
    try:
        session, answer = await service.whep.open(stream, text, rendition, at_most, request.client.host if request.client else "")
    except CodecError as error:
        raise Problem(HTTPStatus.NOT_ACCEPTABLE, str(error)) from None
    except (OfferError, UnknownRenditionError) as error:
        raise Problem(HTTPStatus.BAD_REQUEST, str(error)) from None
    except (TooManyViewersError, NoSocketError) as error:
        return _elsewhere(service.edge(stream), str(error))
    # Not a relative reference, which would need no prefix: some players take only absolute paths.
    prefix = request.scope.get("root_path", "")
    response = Response(answer, HTTPStatus.CREATED, media_type=OFFER_TYPE, headers={
        "Location": f"{prefix}/whep/{stream.name}/{session.id}", "ETag": session.etag, "Accept-Patch": FRAGMENT_TYPE})
    for name, relation in EXTENSIONS.items():
        response.headers.append("Link", f'<{prefix}/api/streams/{stream.name}/{name}>; rel="{relation}"')
    return _with_ice_servers(response, service)


def _elsewhere(edge: str | None, reason: str) -> Response:
    """307 keeps method and body; the draft allows no other redirection."""
    if edge is None:
        raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, reason, headers={"Retry-After": str(RETRY_AFTER_S)})
    return Response(status_code=HTTPStatus.TEMPORARY_REDIRECT, headers={"Location": edge})


@router.options("/{stream}", status_code=204, response_class=Response)
async def describe(stream: StreamDep, service: ServiceDep, access: AccessDep) -> Response:
    """What the endpoint takes, and for those who may view also the ICE servers to use before the offer is made."""
    response = Response(status_code=HTTPStatus.NO_CONTENT,
                        headers={"Accept-Post": OFFER_TYPE, "Allow": "OPTIONS, GET, HEAD, POST"})
    return _with_ice_servers(response, service) if access.has(Right.VIEW, stream.name) else response


@router.api_route("/{stream}", methods=["GET", "HEAD"], include_in_schema=False)
async def discover(stream: StreamDep) -> Response:
    return Response(media_type=OFFER_TYPE, headers={"Accept-Post": OFFER_TYPE})


@router.patch("/{stream}/{session_id}", status_code=204, response_class=Response, responses={
    200: {"description": "ICE has been restarted", "content": {FRAGMENT_TYPE: {}}}}, openapi_extra={
    "requestBody": {"required": True, "content": {FRAGMENT_TYPE: {"schema": {"type": "string"}}}}})
async def patch_session(stream: StreamDep, session_id: str, service: ServiceDep, request: Request) -> Response:
    """More ICE candidates of the viewer, with the session's ETag in `If-Match`; or new credentials, with `If-Match: *`, that
    restart ICE: the answer has a new ETag and our new credentials and candidates."""
    session = _session(service.whep.find(stream.name, session_id))
    text = await _text(request, FRAGMENT_TYPE, MAX_FRAGMENT_BYTES)
    tag = request.headers.get("if-match")
    if tag is None:
        raise Problem(HTTPStatus.PRECONDITION_REQUIRED, "if-match is missing, expected the session's ETag, or * to restart ICE")
    try:
        return await _patched(session, parse_fragment(text), tag.strip(), service)
    except OfferError as error:
        raise Problem(HTTPStatus.BAD_REQUEST, str(error)) from None


async def _patched(session: WhepSession, fragment: Fragment, tag: str, service: Service) -> Response:
    same_generation = session.is_present_generation(fragment)
    if tag == "*" and (fragment.username is None or not same_generation):
        answer = await session.restart_ice(fragment)
        return _with_ice_servers(Response(answer, media_type=FRAGMENT_TYPE, headers={"ETag": session.etag}), service)
    if tag not in ("*", session.etag):      # some clients send * with every candidate
        raise Problem(HTTPStatus.PRECONDITION_FAILED, f"if-match is {shown(tag)}, expected the session's ETag")
    if not same_generation:
        raise Problem(HTTPStatus.CONFLICT, f"the fragment is of ice-ufrag {shown(fragment.username)}, expected the one in use")
    await session.add_candidates(fragment)
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
    return Response(headers={"Accept-Patch": FRAGMENT_TYPE})


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


def _with_ice_servers(response: Response, service: Service) -> Response:
    for link in service.ice_server_links():
        response.headers.append("Link", link)
    response.headers["Cache-Control"] = "no-store"      # the credentials are of one viewer
    return response
