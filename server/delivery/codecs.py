"""Codec preferences for aiortc: what we encode, and retransmission (RTX) beside it."""

from __future__ import annotations

from aiortc import RTCRtpCodecCapability, RTCRtpSender


def with_retransmission(codec: str) -> list[RTCRtpCodecCapability]:
    """The variants of `h264` or `vp8`, H.264 constrained baseline first (what we encode), then RTX."""
    known = RTCRtpSender.getCapabilities("video").codecs
    chosen = [item for item in known if item.mimeType.lower() == f"video/{codec}"]
    chosen.sort(key=lambda item: item.parameters.get("profile-level-id") != "42e01f")
    return chosen + [item for item in known if item.mimeType == "video/rtx"]


def opus() -> list[RTCRtpCodecCapability]:
    return [item for item in RTCRtpSender.getCapabilities("audio").codecs if item.mimeType == "audio/opus"]
