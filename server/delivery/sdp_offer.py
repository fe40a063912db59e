"""A WHEP client's SDP offer: what of it we serve, and our answer to all of it.

aiortc answers every media section of an offer or none. What it is given here are only the sections that get media; the answer
gets the others back as rejected ones (RFC 3264 section 6).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from aiortc import RTCIceCandidate
from aiortc.sdp import MediaDescription, SessionDescription

MAX_OFFER_BYTES = 64 << 10
MAX_MEDIA_SECTIONS = 8
MAX_CANDIDATES = 64             # RFC 8445 section 6.1.2.5 allows 100 pairs

# What a section shares with the one at the head of its bundle, and may leave to it (RFC 8843 section 7.1.3).
_TRANSPORT = ("a=ice-", "a=fingerprint:", "a=setup:", "a=rtcp-mux", "a=candidate:", "a=end-of-candidates")


class OfferError(ValueError):
    """The offer is no SDP, or not one a viewer can send."""


class CodecError(OfferError):
    """The offer has no codec that we send."""


@dataclass(frozen=True, slots=True)
class Offer:
    """An offer that asks for video, cut down to what is served."""

    text: str
    """Without the candidates of `late`."""
    codec: str
    """Of the video that we shall send: `h264` where the viewer takes it, else `vp8`."""
    sound: bool
    """It asks for Opus too."""
    late: tuple[RTCIceCandidate, ...]
    """Browsers hide their address behind an mDNS name, which takes a second when nobody answers to it."""
    head: tuple[str, str]
    """Kind and mid of the section whose transport carries all media."""
    username: str
    """The viewer's ICE user name."""
    sections: tuple[tuple[str, ...], ...]
    """Of the whole offer, in lines."""
    served: tuple[int, ...]
    """Which of these get media."""

    def complete(self, answer: str) -> str:
        """The answer to the whole offer, from the one to `text`."""
        session, answered = _split(answer)
        given = iter(answered)
        whole = [next(given) if number in self.served else _rejected(section) for number, section in enumerate(self.sections)]
        return _joined([session, *whole])


def parse_offer(text: str) -> Offer:
    """Check the offer and take what we serve from it.

    Raises:
        OfferError, CodecError: names what is missing.
    """
    try:
        offer = SessionDescription.parse(text)
    except Exception as error:  # aiortc's parser raises whatever its slicing and int() come upon
        raise OfferError(f"the body is no SDP offer: {error or type(error).__name__}") from None
    session, sections = _split(text)
    if len(sections) > MAX_MEDIA_SECTIONS:
        raise OfferError(f"the offer has {len(sections)} media sections, expected at most {MAX_MEDIA_SECTIONS}")
    if len(sections) != len(offer.media):
        raise OfferError("the body is no SDP offer: its media sections cannot be told apart")
    candidates = sum(len(media.ice_candidates) for media in offer.media)
    if candidates > MAX_CANDIDATES:
        raise OfferError(f"the offer has {candidates} candidates, expected at most {MAX_CANDIDATES}")
    bundle = next(([str(mid) for mid in group.items] for group in offer.group if group.semantic == "BUNDLE"), [])
    video, codec = _video(offer.media, sections)
    sound = _sound(offer.media, sections, bundle, offer.media[video].rtp.muxId)
    served = tuple(sorted({video} if sound is None else {video, sound}))
    cut = _cut(session, sections, offer.media, served, bundle)
    head = _head(SessionDescription.parse(cut).media, bundle)
    if head.ice is None or not head.ice.usernameFragment or not head.ice.password:
        raise OfferError("the offer has no a=ice-ufrag and a=ice-pwd for its video")
    if not head.dtls or not head.dtls.fingerprints:
        raise OfferError("the offer has no a=fingerprint for its video")
    now, late = _without_mdns(cut)
    return Offer(now, codec, sound is not None, late, (head.kind, head.rtp.muxId), head.ice.usernameFragment,
                 tuple(tuple(section) for section in sections), served)


def _head(media: Sequence[MediaDescription], bundle: list[str]) -> MediaDescription:
    return next((one for mid in bundle for one in media if one.rtp.muxId == mid), media[0])


def _video(media: Sequence[MediaDescription], sections: Sequence[Sequence[str]]) -> tuple[int, str]:
    """Which section, and the codec to send."""
    wanted = [number for number, one in enumerate(media) if one.kind == "video" and _receives(one, sections[number])]
    if not wanted:
        raise OfferError("the offer has no video section with a=recvonly")
    for codec, usable in (("h264", _whole_access_units), ("vp8", lambda parameters: True)):
        for number in wanted:
            if any(item.mimeType.lower() == f"video/{codec}" and usable(item.parameters) for item in media[number].rtp.codecs):
                return number, codec
    names = ", ".join(sorted({item.mimeType for number in wanted for item in media[number].rtp.codecs})) or "none"
    raise CodecError(f"the offer has the video codecs {names}, expected video/H264 with packetization-mode=1 or video/VP8")


def _whole_access_units(parameters: Mapping[str, object]) -> bool:
    return str(parameters.get("packetization-mode")) == "1"     # cut into packets as we like


def _sound(media: Sequence[MediaDescription], sections: Sequence[Sequence[str]], bundle: list[str], video: str) -> int | None:
    """The section that takes our sound over the video's transport, if there is one."""
    for number, one in enumerate(media):
        if (one.kind == "audio" and _receives(one, sections[number]) and {one.rtp.muxId, video} <= set(bundle)
                and any(item.mimeType.lower() == "audio/opus" for item in one.rtp.codecs)):
            return number
    return None


def _receives(media: MediaDescription, section: Sequence[str]) -> bool:
    rejected = media.port == 0 and "a=bundle-only" not in section
    return not rejected and (media.direction or "sendrecv") in ("recvonly", "sendrecv")


def _cut(session: list[str], sections: list[list[str]], media: Sequence[MediaDescription], served: Sequence[int],
         bundle: list[str]) -> str:
    """The offer with no other sections than the served ones, each with its transport."""
    mids = [media[number].rtp.muxId for number in served]
    kept = [line for line in session if not line.startswith("a=group:BUNDLE")]
    if bundle:
        kept.append("a=group:BUNDLE " + " ".join(mid for mid in bundle if mid in mids))
    head = next((section for section, one in zip(sections, media, strict=True) if bundle and one.rtp.muxId == bundle[0]), [])
    shared = [line for line in head if line.startswith(_TRANSPORT)]
    whole = []
    for number in served:
        alone = any(line.startswith("a=ice-ufrag:") for line in [*sections[number], *session])
        whole.append([*sections[number], *([] if alone else shared)])
    return _joined([kept, *whole])


def _without_mdns(text: str) -> tuple[str, tuple[RTCIceCandidate, ...]]:
    late = []
    for media in SessionDescription.parse(text).media:
        for candidate in media.ice_candidates:
            if candidate.ip.endswith(".local"):
                candidate.sdpMid = media.rtp.muxId
                late.append(candidate)
    if not late:
        return text, ()
    # Not complete without them: with no address of the viewer's, ICE has to wait until the viewer's own checks arrive.
    kept = [line for line in text.splitlines() if line != "a=end-of-candidates"
            and not (line.startswith("a=candidate:") and ".local " in line)]
    return _joined([kept]), tuple(late)


def _split(text: str) -> tuple[list[str], list[list[str]]]:
    """The lines before the first media section, and those of each media section."""
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("m="):
            parts.append([])
        if line.strip():
            parts[-1].append(line.strip())
    return parts[0], parts[1:]


def _joined(parts: Sequence[Sequence[str]]) -> str:
    return "".join(f"{line}\r\n" for part in parts for line in part)


def _rejected(section: Sequence[str]) -> list[str]:
    kind, _, rest = section[0].removeprefix("m=").split(" ", 2)
    return [f"m={kind} 0 {rest}", "c=IN IP4 0.0.0.0", "a=inactive", *(line for line in section if line.startswith("a=mid:"))]
