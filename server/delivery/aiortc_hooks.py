"""The only place that reaches into aiortc's private parts. pyproject.toml pins the minor version these were read in.

Each hook has a test in tests/server/test_aiortc_hooks.py that fails when aiortc no longer works that way.
"""

from __future__ import annotations

from collections.abc import Callable

from aiortc import RTCRtpSender, rtcrtpreceiver, rtcrtpsender
from aiortc.codecs.base import Decoder
from aiortc.rtcrtpparameters import RTCRtpCodecParameters

# NACKed packets older than the history are not sent again. aiortc keeps 128, which is 44 ms at 30 Mbps and less than
# one keyframe of a panorama. A power of two, so that the slots go on when the 16 bit sequence number wraps.
RTP_HISTORY_PACKETS = 2048


def install() -> None:
    """Apply the hooks that hold for the whole process. Idempotent.

    Raises:
        RuntimeError: aiortc's sender has changed and the hooks would silently do nothing.
    """
    used = RTCRtpSender._run_rtp.__code__.co_names
    if not {"uint32_add", "random32", "RTP_HISTORY_SIZE"} <= set(used):
        raise RuntimeError("aiortc's RTCRtpSender has changed, expected version 1.16")
    module = vars(rtcrtpsender)
    module["RTP_HISTORY_SIZE"] = RTP_HISTORY_PACKETS
    # The sender adds a random origin to every timestamp; `uint32_add` is used for nothing else in its module. Without
    # the origin the RTP timestamp of a frame equals `rtp_timestamp` of its light message, for every viewer.
    module["uint32_add"] = _without_origin


def _without_origin(origin: int, timestamp: int) -> int:
    return timestamp & 0xFFFFFFFF


def on_keyframe_request(sender: RTCRtpSender, request: Callable[[], None]) -> None:
    """Call `request` for each PLI and FIR of this viewer: aiortc's own reaction reaches only an encoder of its own.

    Raises:
        RuntimeError: aiortc's sender has changed.
    """
    if "_send_keyframe" not in RTCRtpSender._handle_rtcp_packet.__code__.co_names:
        raise RuntimeError("aiortc's RTCRtpSender has changed, expected version 1.16")
    vars(sender)["_send_keyframe"] = request


def decode_with(make_decoder: Callable[[RTCRtpCodecParameters], Decoder]) -> None:
    """Have every receiver of this process use decoders of that making.

    Raises:
        RuntimeError: aiortc's receiver has changed.
    """
    if "get_decoder" not in rtcrtpreceiver.decoder_worker.__code__.co_names:
        raise RuntimeError("aiortc's decoder_worker has changed, expected version 1.16")
    vars(rtcrtpreceiver)["get_decoder"] = make_decoder
