"""Source URLs: which ones are accepted from whom, and how they are shown without their credentials."""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import SplitResult, unquote, urlsplit

NETWORK_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "rtmp-listen")
DEFAULT_PORTS = {"rtsp": 554, "rtsps": 322, "rtmp": 1935, "rtmps": 443}
MAX_URL_LENGTH = 2048
RESOLVE_TIMEOUT_S = 3.0

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address
IpNetwork = ipaddress.IPv4Network | ipaddress.IPv6Network

_SECRET_PARAMETER = re.compile(
    r"([?&;][^=&;#]*(?:pass|pwd|token|secret|key|auth|sign?|credential)[^=&;#]*=)[^&;#\s]*", re.IGNORECASE)
_USER_INFO = re.compile(r"(?<=://)[^/?#\s]*@")


class SourceUrlError(ValueError):
    """The text is no source that this caller may use."""


class UnknownHostError(SourceUrlError):
    """The host's name does not resolve, now."""


def masked(text: str) -> str:
    """The URL, or a text with URLs in it, without user names, passwords and secret-looking query values."""
    return _SECRET_PARAMETER.sub(r"\1***", _USER_INFO.sub("***@", text))


def check_command_line_source(source: str) -> str:
    """Accept a network URL, a path or a `file://` URL; files come back as an absolute `file://` URL.

    Raises:
        SourceUrlError: the scheme is unknown, the URL is malformed or the file does not exist.
    """
    if "://" in source and not source.startswith("file://"):
        return check_network_source(source)
    text = unquote(source.removeprefix("file://")) if source.startswith("file://") else source
    path = Path(text).expanduser().absolute()
    if not path.is_file():
        raise SourceUrlError(f"source {source!r} does not exist, expected a file or a URL with scheme "
                             f"{', '.join(NETWORK_SCHEMES)}")
    return path.as_uri()


def is_file_source(source: str | None) -> bool:
    return source is not None and source.startswith("file://")


def check_network_source(source: str) -> str:
    """Accept an RTSP or RTMP URL by its form alone.

    Raises:
        SourceUrlError: names the part that is wrong and what was expected.
    """
    shown = masked(source[:MAX_URL_LENGTH])
    if len(source) > MAX_URL_LENGTH:
        raise SourceUrlError(f"source has {len(source)} characters, expected at most {MAX_URL_LENGTH}")
    if not source.isascii() or not source.isprintable() or " " in source:
        raise SourceUrlError(f"source {shown!r} has blanks or unprintable characters, expected a plain URL")
    parts = _split(source, shown)
    if parts.scheme not in NETWORK_SCHEMES:
        raise SourceUrlError(f"source scheme of {shown!r} is {parts.scheme!r}, expected one of "
                             f"{', '.join(NETWORK_SCHEMES)}")
    if not parts.hostname:
        raise SourceUrlError(f"source {shown!r} names no host, expected {parts.scheme}://HOST/PATH")
    if parts.scheme == "rtmp-listen" and (parts.port is None or len(parts.path.strip("/").split("/")) < 2):
        raise SourceUrlError(f"source {shown!r} is incomplete, expected rtmp-listen://HOST:PORT/APP/KEY")
    return source


def _split(source: str, shown: str) -> SplitResult:
    try:
        parts = urlsplit(source)
        port = parts.port
    except ValueError as error:
        raise SourceUrlError(f"source {shown!r} is no URL: {str(error).lower()}") from None
    if port == 0:
        raise SourceUrlError(f"source {shown!r} has port 0, expected 1 to 65535")
    return parts


async def check_source_network(source: str, allowed: Sequence[IpNetwork]) -> None:
    """Refuse a host outside the public internet and outside the allowed networks (server-side request forgery).

    Raises:
        UnknownHostError: the host does not resolve.
        SourceUrlError: one of its addresses is not allowed.
    """
    parts = urlsplit(source)
    host = parts.hostname or ""
    for address in await _addresses(host, parts.port or DEFAULT_PORTS.get(parts.scheme, 0)):
        inside = any(address in network for network in allowed if network.version == address.version)
        if not inside and not (address.is_global and not address.is_multicast):
            raise SourceUrlError(f"source host {host!r} has the address {address}, expected a public one or one in the "
                                 "setting source_networks")


async def _addresses(host: str, port: int) -> list[IpAddress]:
    try:
        async with asyncio.timeout(RESOLVE_TIMEOUT_S):
            found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise UnknownHostError(f"source host {host!r} does not resolve, expected a known host name") from None
    addresses = [ipaddress.ip_address(str(entry[4][0]).split("%")[0]) for entry in found]
    return [getattr(address, "ipv4_mapped", None) or address for address in addresses]
