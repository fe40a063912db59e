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
        if is_loopback(address):
            return 0.0
        address, now = shared_network(address), self._clock()
        spent, at = self._spent.pop(address, (0.0, now))
        spent = max(0.0, spent - (now - at) * self._per_second)
        allowed = spent + 1.0 <= self._burst
        self._spent[address] = (spent + 1.0 if allowed else spent, now)
        if len(self._spent) > MAX_ADDRESSES:
            self._spent.popitem(last=False)
        return 0.0 if allowed else (spent + 1.0 - self._burst) / self._per_second


def is_loopback(address: str) -> bool:
    """Also of a Unix socket, which has no address."""
    try:
        return _parsed(address).is_loopback
    except ValueError:
        return True


def shared_network(address: str) -> str:
    """What stands for one household or one bad client: an IPv4 address, the /64 of an IPv6 one."""
    try:
        parsed = _parsed(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((parsed, 64), strict=False)) if parsed.version == 6 else str(parsed)


def _parsed(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An IPv4 client of an IPv6 socket is an IPv4 client. Raises ValueError."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    return (parsed.version == 6 and parsed.ipv4_mapped) or parsed
