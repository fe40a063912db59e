"""What an output is asked to be: the resource's writable part, as REST and the settings give it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal
from urllib.parse import unquote, unquote_plus, urlsplit

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from server.source_url import MAX_URL_LENGTH, SourceUrlError, masked

Kind = Literal["rtmp", "rtsp", "whip", "record"]

SCHEMES: dict[str, Kind] = {"rtmp": "rtmp", "rtmps": "rtmp", "rtsp": "rtsp", "rtsps": "rtsp",
                            "whip+http": "whip", "whip+https": "whip"}
PLAYBACK_SCHEMES = ("http", "https", "rtsp", "rtsps", "rtmp", "rtmps", "srt")
MASK = "***"
LONGEST_SHOWN_PATH_PART = 20        # what is longer is likely a key: Cloudflare's WHIP URLs carry theirs in the path

_EXPECTED_SCHEMES = f"expected one of {', '.join(SCHEMES)}, or http or https with kind whip"
_PATH_PART = re.compile(rf"(?<=/)[^/?#]{{{LONGEST_SHOWN_PATH_PART + 1},}}(?=[/?#]|$)")
_PATH_PARAMETER = re.compile(r"(?<=;)[^;/]+")


def _token(value: Any) -> Any:
    """Checked here, because pydantic's own message would show the value."""
    if value is not None and not (isinstance(value, str) and re.fullmatch(r"[A-Za-z0-9._~+/=-]{1,4096}", value)):
        raise ValueError("expected a bearer token of RFC 6750: letters, digits and . _ ~ + / = -")
    return value


def _url(value: Any) -> Any:
    if value is not None and not isinstance(value, str):
        raise ValueError("expected a URL as text")
    return value


class PlaybackEntry(BaseModel):
    """Where people watch what goes out there. Shown to everybody."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    protocol: Annotated[str, Field(pattern=r"^[a-z0-9-]{1,16}$")]       # whep, hls, rtsp, rtmp, …
    url: Annotated[str, Field(max_length=MAX_URL_LENGTH)]
    rendition: Annotated[str, Field(pattern=r"^[a-z0-9-]{1,16}$")] | None = None

    @model_validator(mode="after")
    def _usable(self) -> PlaybackEntry:
        parts = _split(self.url, "playback url")
        if parts.scheme not in PLAYBACK_SCHEMES:
            raise ValueError(f"playback url scheme is {parts.scheme!r}, expected one of {', '.join(PLAYBACK_SCHEMES)}")
        if "@" in parts.netloc:
            raise ValueError("playback url has credentials, expected none: everybody sees it")
        if self.protocol == "whep" and parts.scheme not in ("http", "https"):
            raise ValueError(f"playback url scheme is {parts.scheme!r}, expected http or https for whep")
        return self


class OutputSpec(BaseModel):
    """One way out of a stream."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    kind: Kind
    url: Annotated[str | None, BeforeValidator(_url), Field(
        description="rtmp, rtmps, rtsp, rtsps, whip+http or whip+https; http and https with kind whip")] = None
    prefix: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
                                 description="of a recording's file name")] | None = None
    rendition: Annotated[str | None, Field(max_length=64, description="by default the best one")] = None
    token: Annotated[str | None, BeforeValidator(_token), Field(description="bearer token for WHIP; never shown")] = None
    playback: Annotated[tuple[PlaybackEntry, ...], Field(max_length=8)] = ()
    enabled: bool = True

    @model_validator(mode="before")
    @classmethod
    def _kind_of_url(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("url"), str):
            return data
        scheme, separator, rest = data["url"].partition("://")
        kind = kind_of(data["url"])
        if kind is None and "kind" not in data:
            raise ValueError(f"url scheme is {scheme[:20]!r}, {_EXPECTED_SCHEMES}" if separator else "url is no URL, "
                             "expected SCHEME://HOST/PATH")
        url = f"{scheme.lower().removeprefix('whip+')}{separator}{rest}"
        return {**data, "url": url, "kind": data.get("kind", kind)}

    @model_validator(mode="after")
    def _consistent(self) -> OutputSpec:
        if self.token is not None and self.kind != "whip":
            raise ValueError(f"token is for kind whip, the kind is {self.kind}")
        if self.kind == "record":
            if self.prefix is None or self.url is not None:
                raise ValueError("a recording has no url but a prefix, the beginning of its file names")
        else:
            _check_url(self.kind, self.url)
            if self.prefix is not None:
                raise ValueError(f"prefix is for kind record, the kind is {self.kind}")
        return self

    def check_rendition(self, names: Sequence[str]) -> None:
        """`names`: of the service's ladder. Raises ValueError when the rendition asked for is none of them."""
        if self.rendition is not None and self.rendition not in names:
            raise ValueError(f"rendition is {self.rendition!r}, expected one of {', '.join(names)}")

    @property
    def shown_url(self) -> str | None:
        """The URL without credentials and stream key."""
        return None if self.url is None else masked_output_url(self.url)

    def conceal(self, text: str) -> str:
        """The text, which may quote the URL or parts of it, without this output's secrets."""
        secrets = {form for secret in self._secrets() for form in (secret, unquote(secret), unquote_plus(secret)) if form}
        if secrets:
            longest_first = sorted(secrets, key=len, reverse=True)
            text = re.sub("|".join(map(re.escape, longest_first)), MASK, text, flags=re.IGNORECASE)     # reasons are lower case
        return masked(text)

    def _secrets(self) -> Iterator[str]:
        """As they are written in the URL."""
        yield self.token or ""
        if self.url is not None:
            parts = urlsplit(self.url)
            yield from (parts.username or "", parts.password or "", parts.fragment)
            parameters = _parameters(parts.query) + _parameters(";".join(_PATH_PARAMETER.findall(parts.path)))
            yield from (value if separator else name for name, separator, value in parameters)
            yield from _PATH_PART.findall(parts.path)
            if self.kind == "rtmp":
                yield _path_parts(parts.path)[-1]


class ConfiguredOutput(OutputSpec):
    """An output of the settings, with the stream that it is of."""

    stream: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")] = "live"

    @property
    def spec(self) -> OutputSpec:
        return OutputSpec.model_validate(self.model_dump(exclude={"stream"}))


class ConfiguredPlayback(PlaybackEntry):
    """A way to watch that holds whatever this service does."""

    stream: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")] = "live"


def kind_of(url: str) -> Kind | None:
    """By the URL's scheme; None when that does not say it."""
    scheme, separator, _ = url.partition("://")
    return SCHEMES.get(scheme.lower()) if separator else None


def masked_output_url(url: str) -> str:
    """Without user name, password, query values, parameters, long path parts and, for RTMP, the stream key and what follows it."""
    parts = urlsplit(url)
    _, credentials, host = parts.netloc.rpartition("@")
    rtmp = parts.scheme in ("rtmp", "rtmps")
    path = "/".join(["", *_path_parts(parts.path)[:-1], MASK]) if rtmp else parts.path
    path = _PATH_PART.sub(MASK, _PATH_PARAMETER.sub(MASK, path))
    query = "&".join(f"{name}={MASK}" if separator else MASK for name, separator, _ in _parameters(parts.query))
    return (f"{parts.scheme}://{MASK + '@' if credentials else ''}{host}{path}"
            f"{'?' + query if query and not rtmp else ''}{'#' + MASK if parts.fragment and not rtmp else ''}")


def _path_parts(path: str) -> list[str]:
    return [part for part in path.split("/") if part]


def _parameters(query: str) -> list[tuple[str, str, str]]:
    """Name, `=` and value, undecoded; without `=` there is only the first."""
    return [parameter.partition("=") for parameter in re.split("[&;]", query) if parameter]


def _check_url(kind: Kind, url: str | None) -> None:
    if url is None:
        raise ValueError(f"url is missing, expected where to push to with kind {kind}")
    parts = _split(url, "url")
    expected = ["http", "https"] if kind == "whip" else [scheme for scheme in SCHEMES if SCHEMES[scheme] == kind]
    if parts.scheme not in expected:
        raise SourceUrlError(f"url scheme is {parts.scheme!r}, expected {' or '.join(expected)} for kind {kind}")
    if kind == "whip" and "@" in parts.netloc:
        raise SourceUrlError("url has a user name or password, expected a token beside it")
    if kind == "rtmp" and len(_path_parts(parts.path)) < 2:
        raise SourceUrlError(f"url is incomplete, expected {parts.scheme}://HOST/APP/KEY")


def _split(url: str, what: str) -> Any:
    """The URL's parts. Messages do not quote it: what is wrong with it may be in a secret."""
    if len(url) > MAX_URL_LENGTH:
        raise SourceUrlError(f"{what} has {len(url)} characters, expected at most {MAX_URL_LENGTH}")
    if not url.isascii() or not url.isprintable() or any(letter in url for letter in ' "<>\\^`{|}'):
        raise SourceUrlError(f"{what} has blanks or characters that no URL has, expected a plain URL")
    if MASK in url:
        raise SourceUrlError(f"{what} is masked with {MASK}, expected the whole of it")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise SourceUrlError(f"{what} is no URL, expected SCHEME://HOST/PATH") from None
    if not parts.hostname or port == 0:
        raise SourceUrlError(f"{what} names no host or port 0, expected SCHEME://HOST/PATH")
    return parts
