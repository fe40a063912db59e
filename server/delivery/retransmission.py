"""How much may be sent again: on a link that is full, answering every NACK would fill it even more."""

from __future__ import annotations

SHARE = 0.35            # of the media's own bytes; 2 % loss with retries needs a tenth of that
LARGEST_BYTES = 400_000


class RetransmissionAllowance:
    """A bucket that sent media fills and retransmissions empty."""

    def __init__(self) -> None:
        self._bytes = float(LARGEST_BYTES) / 4

    def media_sent(self, count: int) -> None:
        self._bytes = min(self._bytes + SHARE * count, LARGEST_BYTES)

    def take(self, count: int) -> bool:
        """Whether so many bytes may be sent again."""
        if self._bytes < count:
            return False
        self._bytes -= count
        return True
