"""The settings that say how viewers' media finds its way: ports, addresses, STUN and TURN servers."""

from __future__ import annotations

import re
import socket
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, SecretStr

OWN = "own"     # among the advertised addresses: the machine's own

_QUOTABLE = r"^[\x21\x23-\x5b\x5d-\x7e]*$"      # inside the quotes of a Link header
IceUrl = Annotated[str, Field(pattern=r"^(stuns?|turns?):[^\s<>\"]+$")]
TurnUrl = Annotated[str, Field(pattern=r"^turns?:[^\s<>\"]+$")]

EdgeUrl = Annotated[str, Field(pattern=r"^https?://[^\s<>\"]+$")]


class IceServer(BaseModel):
    """A STUN or TURN server that viewers are told about in WHEP's `Link` header."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: IceUrl
    username: Annotated[str, Field(pattern=_QUOTABLE)] = ""
    credential: Annotated[str, Field(pattern=_QUOTABLE)] = ""


class Turn(BaseModel):
    """TURN servers that share a secret with the service, as coturn's `use-auth-secret`: viewers get credentials of their own."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    urls: Annotated[tuple[TurnUrl, ...], Field(min_length=1)]
    secret: Annotated[SecretStr, Field(min_length=1)]
    ttl_s: Annotated[int, Field(ge=60, le=86400)] = 3600


def comma_separated(value: Any) -> Any:
    return [item.strip() for item in value.split(",") if item.strip()] if isinstance(value, str) else value


def resolved(value: Any) -> Any:
    """IP addresses as they are, host names as the addresses that they have now."""
    names = comma_separated(value)
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError("expected at least one IP address, host name or own")
    return tuple(dict.fromkeys(address for name in names for address in ([name] if name == OWN else _addresses(name))))


def _addresses(name: str) -> list[str]:
    try:
        return [str(info[4][0]) for info in socket.getaddrinfo(name, None, type=socket.SOCK_DGRAM)]
    except (OSError, UnicodeError):
        raise ValueError(f"address {name!r} cannot be resolved, expected an IP address, a host name or own") from None


def _checked_range(text: str) -> str:
    matched = re.fullmatch(r"([0-9]{1,5})-([0-9]{1,5})", text)
    if not matched or not 1 <= int(matched[1]) <= int(matched[2]) <= 65535:
        raise ValueError("expected FIRST-LAST from 1 to 65535, such as 40000-40100")
    return text


PortRange = Annotated[str, AfterValidator(_checked_range)]
