"""Bodies of type `application/trickle-ice-sdpfrag` (RFC 8840 section 9): ICE candidates and credentials after the offer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from aiortc import RTCIceCandidate
from aiortc.sdp import candidate_from_sdp, candidate_to_sdp

from server.delivery.sdp_offer import MAX_CANDIDATES, OfferError

MAX_FRAGMENT_BYTES = 16 << 10


@dataclass(frozen=True, slots=True)
class Fragment:
    """What a viewer tells about its ICE agent."""

    candidates: tuple[RTCIceCandidate, ...]
    complete: bool
    username: str | None = None
    """Of the generation of ICE that the candidates belong to."""
    password: str | None = None


def parse_fragment(text: str) -> Fragment:
    """Raises OfferError."""
    mid, complete = None, False
    unnamed: list[RTCIceCandidate] = []     # of the present media section: its mid may come after them
    credentials: dict[str, str] = {}
    candidates: list[RTCIceCandidate] = []
    for line in text.splitlines():
        key, _, value = line.strip().partition(":")
        if key == "a=mid":
            mid = value
            for candidate in unnamed:
                candidate.sdpMid = mid
        elif key in ("a=ice-ufrag", "a=ice-pwd"):
            credentials.setdefault(key, value)      # bundled sections have the same ones
        elif key == "a=end-of-candidates":
            complete = True
        elif key == "a=candidate":
            candidates.append(_candidate(value, mid))
            unnamed += [] if mid else candidates[-1:]
        elif key.startswith("m="):
            mid, unnamed = None, []
        elif key and not key.startswith("a="):
            raise OfferError(f"the fragment has the line {line[:80]!r}, expected lines with a= and m=")
    return Fragment(_checked(candidates), complete, credentials.get("a=ice-ufrag"), credentials.get("a=ice-pwd"))


def _checked(candidates: list[RTCIceCandidate]) -> tuple[RTCIceCandidate, ...]:
    """Those that can be used. Raises OfferError."""
    if len(candidates) > MAX_CANDIDATES:
        raise OfferError(f"the fragment has {len(candidates)} candidates, expected at most {MAX_CANDIDATES}")
    if any(not candidate.sdpMid for candidate in candidates):
        raise OfferError("the fragment has candidates in a media section without a=mid")
    return tuple(one for one in candidates if one.protocol.lower() == "udp" and one.component == 1)


def fragment_text(kind: str, mid: str, username: str, password: str, candidates: Iterable[RTCIceCandidate]) -> str:
    """Our side of a new generation of ICE, as the answer to a restart (RFC 9725 section 4.3.3)."""
    return "".join(f"{line}\r\n" for line in (
        "a=ice-options:trickle", f"m={kind} 9 UDP/TLS/RTP/SAVPF 0", f"a=mid:{mid}", f"a=ice-ufrag:{username}",
        f"a=ice-pwd:{password}", *(f"a=candidate:{candidate_to_sdp(one)}" for one in candidates), "a=end-of-candidates"))


def _candidate(value: str, mid: str | None) -> RTCIceCandidate:
    try:
        candidate = candidate_from_sdp(value)
    except (AssertionError, ValueError, IndexError):
        raise OfferError(f"the fragment has the candidate {value[:80]!r}, expected the form of RFC 8839") from None
    if not 0 <= candidate.port <= 65535:
        raise OfferError(f"the candidate {value[:80]!r} has the port {candidate.port}, expected at most 65535")
    candidate.sdpMid = mid
    return candidate
