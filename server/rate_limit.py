"""How often one address may ask for something costly: a token bucket each."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable

MAX_ADDRESSES = 10_000


class RateLimit:
    """`burst` at once, `per_second` for ever. Loopback is not limited: behind it stands a proxy with everybody."""

    def __init__(self, burst: int, per_second: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._burst = burst
        self._per_second = per_second
        self._clock = clock
        self._spent: OrderedDict[str, tuple[float, float]] = OrderedDict()     # address: spent, when that was; newest last

    def take(self, address: str) -> float:
        """Count one request. Returns 0, or the seconds after which the next one will be answered."""
        if _is_loopback(address):
            return 0.0
        now = self._clock()
        spent, at = self._spent.pop(address, (0.0, now))
        spent = max(0.0, spent - (now - at) * self._per_second)
        allowed = spent + 1.0 <= self._burst
        self._spent[address] = (spent + 1.0 if allowed else spent, now)
        if len(self._spent) > MAX_ADDRESSES:
            self._spent.popitem(last=False)
        return 0.0 if allowed else (spent + 1.0 - self._burst) / self._per_second


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:      # a Unix socket
        return True
