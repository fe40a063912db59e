"""The only place that reaches into aiortc's private parts. pyproject.toml pins the minor version these were read in.

Each hook has a test in tests/server/test_aiortc_hooks.py that fails when aiortc no longer works that way.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable

from aiortc import MediaStreamTrack, RTCRtpSender, rtcpeerconnection, rtcrtpreceiver
from aiortc.codecs import HEADER_EXTENSIONS
from aiortc.codecs.base import Decoder
from aiortc.rtcdtlstransport import RTCDtlsTransport
from aiortc.rtcrtpparameters import RTCRtpCodecParameters, RTCRtpHeaderExtensionParameters

from server.delivery.feed import FeedTrack
from server.delivery.sender import PLAYOUT_DELAY, PacketSender

# What `PacketSender` overrides or calls; and the private names under which aiortc's own sender keeps what it replaces.
_SENDER_METHODS = {"send", "stop", "getStats", "_handle_rtcp_packet", "_run_rtp", "_run_rtcp", "replaceTrack", "setTransport"}
_TRANSPORT_METHODS = {"_send_rtp", "_register_rtp_sender", "_unregister_rtp_sender", "_get_stats"}


def install() -> None:
    """Have peer connections of this process send `FeedTrack`s by `PacketSender`, all others as ever. Idempotent.

    Raises:
        RuntimeError: aiortc has changed and the sender would fail, or silently do nothing.
    """
    create = vars(rtcpeerconnection.RTCPeerConnection).get("_RTCPeerConnection__createTransceiver")
    makes_senders = create is not None and "RTCRtpSender" in create.__code__.co_names
    takes = list(inspect.signature(RTCRtpSender.__init__).parameters)
    if (not makes_senders or takes != ["self", "trackOrKind", "transport"] or not set(vars(RTCRtpSender)) >= _SENDER_METHODS
            or not set(vars(RTCDtlsTransport)) >= _TRANSPORT_METHODS):
        raise RuntimeError("aiortc's RTCRtpSender has changed, expected version 1.16")
    vars(rtcpeerconnection)["RTCRtpSender"] = _make_sender
    known = HEADER_EXTENSIONS["video"]      # what is offered and answered; numbers are of both kinds of media together
    if all(extension.uri != PLAYOUT_DELAY for extension in known):
        free = max(extension.id for kind in HEADER_EXTENSIONS.values() for extension in kind) + 1
        known.append(RTCRtpHeaderExtensionParameters(id=free, uri=PLAYOUT_DELAY))


def _make_sender(track_or_kind: MediaStreamTrack | str, transport: RTCDtlsTransport) -> RTCRtpSender:
    if isinstance(track_or_kind, FeedTrack):
        return PacketSender(track_or_kind, transport)
    return RTCRtpSender(track_or_kind, transport)


def decode_with(make_decoder: Callable[[RTCRtpCodecParameters], Decoder]) -> None:
    """Have every receiver of this process use decoders of that making.

    Raises:
        RuntimeError: aiortc's receiver has changed.
    """
    if "get_decoder" not in rtcrtpreceiver.decoder_worker.__code__.co_names:
        raise RuntimeError("aiortc's decoder_worker has changed, expected version 1.16")
    vars(rtcrtpreceiver)["get_decoder"] = make_decoder
