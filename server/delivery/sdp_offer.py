"""What a WHEP client sends: the SDP offer, later fragments with more ICE candidates."""

from __future__ import annotations

from dataclasses import dataclass

from aiortc import RTCIceCandidate
from aiortc.sdp import MediaDescription, SessionDescription, candidate_from_sdp

MAX_OFFER_BYTES = 64 << 10
MAX_FRAGMENT_BYTES = 16 << 10
MAX_MEDIA_SECTIONS = 8
MAX_CANDIDATES = 64


class OfferError(ValueError):
    """The offer is no SDP, or not one a viewer can send."""


class CodecError(OfferError):
    """The offer has no codec that we send."""


@dataclass(frozen=True, slots=True)
class Offer:
    """An offer that asks for video, without the candidates whose address is yet to be looked up."""

    text: str
    codec: str
    """Of the video that we shall send: `h264` where the viewer takes it, else `vp8`."""
    sound: bool
    """It asks for Opus too."""
    late: TrickleFragment
    """Browsers hide their address behind an mDNS name, which takes a second when nobody answers to it. Never marked as
    complete: without an address of the viewer, ICE has to wait until the viewer's own checks arrive."""


@dataclass(frozen=True, slots=True)
class TrickleFragment:
    """ICE candidates that come after the offer, as in an `application/trickle-ice-sdpfrag` body."""

    candidates: tuple[RTCIceCandidate, ...]
    complete: bool


def parse_offer(text: str) -> Offer:
    """Check the offer and set its mDNS candidates apart.

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
    sound = any(codec.mimeType.lower() == "audio/opus" for media in offer.media
                if media.kind == "audio" and media.direction in ("recvonly", "sendrecv") for codec in media.rtp.codecs)
    text, late = _without_mdns(text, offer)
    return Offer(text, _video_codec(wanted), sound, late)


def _video_codec(wanted: list[MediaDescription]) -> str:
    codecs = [codec for media in wanted for codec in media.rtp.codecs]
    for codec in codecs:        # what aiortc can answer: whole access units cut into packets as it likes
        if codec.mimeType.lower() == "video/h264" and str(codec.parameters.get("packetization-mode")) == "1":
            return "h264"
    if any(codec.mimeType.lower() == "video/vp8" for codec in codecs):
        return "vp8"
    names = ", ".join(sorted({codec.mimeType for codec in codecs})) or "none"
    raise CodecError(f"the offer has the video codecs {names}, expected video/H264 with packetization-mode=1 or video/VP8")


def _without_mdns(text: str, offer: SessionDescription) -> tuple[str, TrickleFragment]:
    late = []
    for media in offer.media:
        for candidate in media.ice_candidates:
            if candidate.ip.endswith(".local"):
                candidate.sdpMid = media.rtp.muxId
                late.append(candidate)
    if not late:
        return text, TrickleFragment((), complete=False)
    now = [line for line in text.splitlines() if line.strip() != "a=end-of-candidates"
           and not (line.startswith("a=candidate:") and ".local " in line)]
    return "\r\n".join(now) + "\r\n", TrickleFragment(tuple(late), complete=False)


def parse_fragment(text: str) -> TrickleFragment:
    """Raises OfferError."""
    mid, complete = None, False
    candidates: list[RTCIceCandidate] = []
    for line in text.splitlines():
        key, _, value = line.strip().partition(":")
        if key == "a=mid":
            mid = value
        elif key == "a=end-of-candidates":
            complete = True
        elif key == "a=candidate":
            candidates.append(_candidate(value, mid))
        elif key and not key.startswith(("a=", "m=")):
            raise OfferError(f"the fragment has the line {line[:80]!r}, expected lines with a= and m=")
    if len(candidates) > MAX_CANDIDATES:
        raise OfferError(f"the fragment has {len(candidates)} candidates, expected at most {MAX_CANDIDATES}")
    return TrickleFragment(tuple(candidates), complete)


def _candidate(value: str, mid: str | None) -> RTCIceCandidate:
    try:
        candidate = candidate_from_sdp(value)
    except (AssertionError, ValueError, IndexError):
        raise OfferError(f"the fragment has the candidate {value[:80]!r}, expected the form of RFC 8839") from None
    if mid is None:
        raise OfferError(f"the candidate {value[:80]!r} stands before any a=mid line")
    candidate.sdpMid = mid
    return candidate
