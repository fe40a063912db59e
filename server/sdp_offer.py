"""What a WHEP client sends: the SDP offer, later fragments with more ICE candidates."""

from __future__ import annotations

from dataclasses import dataclass

from aiortc import RTCIceCandidate
from aiortc.sdp import SessionDescription, candidate_from_sdp

MAX_OFFER_BYTES = 64 << 10
MAX_FRAGMENT_BYTES = 16 << 10
MAX_MEDIA_SECTIONS = 8
MAX_CANDIDATES = 64


class OfferError(ValueError):
    """The offer is no SDP, or not one a viewer can send."""


class CodecError(OfferError):
    """The offer has no codec that we send."""


def check_offer(text: str) -> None:
    """Check that the offer asks for one H.264 video.

    Raises:
        OfferError, CodecError: names what is missing.
    """
    try:
        offer = SessionDescription.parse(text)
    except Exception as error:  # aiortc's parser raises whatever its slicing and int() come upon
        raise OfferError(f"the body is no SDP offer: {error or type(error).__name__}") from None
    if len(offer.media) > MAX_MEDIA_SECTIONS:
        raise OfferError(f"the offer has {len(offer.media)} media sections, expected at most {MAX_MEDIA_SECTIONS}")
    wanted = [media for media in offer.media if media.kind == "video" and media.direction in ("recvonly", "sendrecv")]
    if not wanted:
        raise OfferError("the offer has no video section with a=recvonly")
    codecs = {codec.mimeType for media in wanted for codec in media.rtp.codecs}
    if "video/h264" not in {codec.lower() for codec in codecs}:
        raise CodecError(f"the offer has the video codecs {', '.join(sorted(codecs)) or 'none'}, expected video/H264")


@dataclass(frozen=True, slots=True)
class TrickleFragment:
    """An `application/trickle-ice-sdpfrag` body."""

    username_fragment: str | None
    candidates: tuple[RTCIceCandidate, ...]
    complete: bool


def parse_fragment(text: str) -> TrickleFragment:
    """Raises OfferError."""
    username_fragment, mid, complete = None, None, False
    candidates: list[RTCIceCandidate] = []
    for line in text.splitlines():
        key, _, value = line.strip().partition(":")
        if key == "a=ice-ufrag":
            username_fragment = value
        elif key == "a=mid":
            mid = value
        elif key == "a=end-of-candidates":
            complete = True
        elif key == "a=candidate":
            candidates.append(_candidate(value, mid))
        elif key and not key.startswith(("a=", "m=")):
            raise OfferError(f"the fragment has the line {line[:80]!r}, expected lines with a= and m=")
    if len(candidates) > MAX_CANDIDATES:
        raise OfferError(f"the fragment has {len(candidates)} candidates, expected at most {MAX_CANDIDATES}")
    return TrickleFragment(username_fragment, tuple(candidates), complete)


def _candidate(value: str, mid: str | None) -> RTCIceCandidate:
    try:
        candidate = candidate_from_sdp(value)
    except (AssertionError, ValueError, IndexError):
        raise OfferError(f"the fragment has the candidate {value[:80]!r}, expected the form of RFC 8839") from None
    if mid is None:
        raise OfferError(f"the candidate {value[:80]!r} stands before any a=mid line")
    candidate.sdpMid = mid
    return candidate
