"""The HTTP of a WHIP client (RFC 9725): offer, redirections, what refusals mean, and the way out. Blocking calls."""

from __future__ import annotations

import contextlib
import http.client
import re
import urllib.error
import urllib.request
from dataclasses import dataclass
from email.message import Message as Headers
from http import HTTPStatus
from typing import IO, Any
from urllib.parse import urljoin, urlsplit

from aiortc import RTCIceServer

from server.outputs.server_link import OutputFailedError

REQUEST_LIMIT_S = 8.0
DELETE_LIMIT_S = 0.8
MAX_ANSWER_BYTES = 256 << 10
MAX_REDIRECTIONS = 5
MAX_RETRY_AFTER_S = 300.0
# Refusals that the same request will meet again. 409 is not among them: the last session may still be there.
HOPELESS = (400, 401, 402, 403, 404, 405, 406, 410, 415, 422)

_LINK = re.compile(r"<([^>]*)>((?:\s*;\s*[\w-]+\s*=\s*(?:\"[^\"]*\"|[^,;\s]*))*)")
_PARAMETER = re.compile(r";\s*([\w-]+)\s*=\s*(?:\"([^\"]*)\"|([^,;\s]*))")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a WHIP endpoint answered: SDP, the session's URL (None: it gave none) and the ICE servers to use."""

    sdp: str
    session_url: str | None
    ice_servers: tuple[RTCIceServer, ...]


@dataclass(frozen=True, slots=True)
class Redirection:
    url: str


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """urllib would make a GET of it; RFC 9725 wants the same POST again, and each new address checked."""

    def redirect_request(self, request: urllib.request.Request, file: IO[bytes], code: int, message: str, headers: Any,
                         new_url: str) -> None:
        return None


_opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), _NoRedirects)


def post_offer(url: str, token: str | None, offer: str) -> Answer | Redirection:
    """One POST. Raises OutputFailedError."""
    request = urllib.request.Request(url, offer.encode(), _headers(token) | {"Content-Type": "application/sdp"}, method="POST")
    try:
        with _opener.open(request, timeout=REQUEST_LIMIT_S) as response:
            if response.status != HTTPStatus.CREATED:
                raise OutputFailedError(f"the WHIP endpoint answered {response.status}, expected 201", hopeless=True)
            sdp = response.read(MAX_ANSWER_BYTES + 1)
            headers: Headers = response.headers
    except urllib.error.HTTPError as error:
        with error:
            return _refused(url, error)
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise OutputFailedError(f"no answer of the WHIP endpoint: {_reason(error)}") from None
    if len(sdp) > MAX_ANSWER_BYTES:
        raise OutputFailedError(f"the WHIP endpoint's answer is longer than {MAX_ANSWER_BYTES} bytes", hopeless=True)
    location = headers.get("Location")
    return Answer(sdp.decode(errors="replace"), urljoin(url, location) if location else None,
                  ice_servers(headers.get_all("Link", [])))


def delete_session(url: str, token: str | None) -> None:
    """Say goodbye; a server that does not answer finds out by itself."""
    with contextlib.suppress(OSError, ValueError, http.client.HTTPException):
        request = urllib.request.Request(url, headers=_headers(token), method="DELETE")
        _opener.open(request, timeout=DELETE_LIMIT_S).close()


def ice_servers(links: list[str]) -> tuple[RTCIceServer, ...]:
    """Those among `Link` headers, RFC 9725 section 4.6."""
    found = []
    for url, parameters in (match.groups() for link in links for match in _LINK.finditer(link)):
        values = {name.lower(): quoted or plain for name, quoted, plain in _PARAMETER.findall(parameters)}
        if values.get("rel") == "ice-server" and url.startswith(("stun:", "turn:", "turns:")):
            found.append(RTCIceServer(url, username=values.get("username"), credential=values.get("credential")))
    return tuple(found)


def _refused(url: str, error: urllib.error.HTTPError) -> Redirection:
    if error.code in (HTTPStatus.TEMPORARY_REDIRECT, HTTPStatus.PERMANENT_REDIRECT):
        target = urljoin(url, error.headers.get("Location", ""))
        if urlsplit(url).scheme == "https" and urlsplit(target).scheme != "https":
            raise OutputFailedError("the WHIP endpoint redirects from https to elsewhere, expected https", hopeless=True)
        return Redirection(target)
    why = {401: ", the token is missing or wrong", 403: ", the token does not entitle to this", 404: ", no such endpoint",
           409: ", another session is there", 503: ", it is at capacity"}.get(error.code, "")
    raise OutputFailedError(f"the WHIP endpoint answered {error.code}{why}", hopeless=error.code in HOPELESS,
                            retry_after_s=_retry_after_s(error.headers.get("Retry-After")))


def _retry_after_s(value: str | None) -> float | None:
    if value is None or not value.strip().isdigit():
        return None
    return min(float(value), MAX_RETRY_AFTER_S)


def _headers(token: str | None) -> dict[str, str]:
    # Also to where it redirects: RFC 9725 has endpoints spread their load that way, and the operator trusts the endpoint.
    return {"Authorization": f"Bearer {token}"} if token else {}


def _reason(error: Exception) -> str:
    cause = getattr(error, "reason", error)
    return str(getattr(cause, "strerror", None) or cause or type(cause).__name__).lower()
