"""What a request sends and what it takes (RFC 9110 sections 8.3 and 12.5.1)."""

from __future__ import annotations

from starlette.requests import Request


def media_type(request: Request) -> str:
    """Of the body, without parameters, in lower case; empty if it is not given."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def accepts(accept: str, media_type: str) -> bool:
    """Whether an Accept header takes the media type; an empty one takes everything."""
    qualities: dict[str, float] = {}
    for media_range in accept.lower().split(","):
        name, *parameters = (part.strip() for part in media_range.split(";"))
        quality = next((_number(value[2:]) for value in parameters if value.startswith("q=")), 1.0)
        qualities[name] = max(quality, qualities.get(name, 0.0))
    for name in (media_type, f"{media_type.partition('/')[0]}/*", "*/*"):    # the most specific one counts
        if name in qualities:
            return qualities[name] > 0
    return not accept.strip()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 1.0
