"""What a viewer has been sent lately, for retransmission: per frame, the shared payloads; nothing is copied."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

KEPT_S = 1.5        # NACKs come within a few round trips; what is older the viewer skips by a keyframe


@dataclass(slots=True)
class SentFrame:
    """`first` is the sequence number of its first packet, not cut to 16 bits."""

    first: int
    payloads: list[bytes]
    timestamp: int      # RTP, 32 bits
    sent_at: float      # monotonic seconds


class SentFrames:
    """The frames of the last `KEPT_S` seconds, however many packets they are."""

    def __init__(self) -> None:
        self._frames: deque[SentFrame] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, frame: SentFrame) -> None:
        self._frames.append(frame)
        while self._frames[0].sent_at < frame.sent_at - KEPT_S:
            self._frames.popleft()

    def find(self, sequence_number: int) -> tuple[SentFrame, int] | None:
        """The frame with that packet, and which of its packets it is; newest first, as NACKs ask for what is new.

        Args:
            sequence_number: the packet's, 16 bits.
        """
        for frame in reversed(self._frames):
            index = (sequence_number - frame.first) & 0xFFFF
            if index < len(frame.payloads):
                return frame, index
        return None
