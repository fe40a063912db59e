"""A bad network in user space: packets between two TUN devices are delayed, lost, limited in rate, or not let through at all.

Run as a script with the names of the two devices, which it makes: `network_relay.py NEAR FAR`. It says `ready`, then takes one JSON
object a line on stdin, `{"down": LINK, "up": LINK}` (down is from NEAR to FAR), a LINK being `{"delay_ms", "loss", "rate_bps",
"queue_ms", "cut"}`, and answers each line with its counters so far. It ends with its stdin. Losses are the same in every run.

A kernel with netem does the same with `tc`; this also works on kernels without.
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import json
import os
import random
import select
import struct
import sys
import time
from dataclasses import dataclass
from typing import Any

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
LARGEST_PACKET = 65535
MOST_READ = 64              # packets in a row from one device before the other has its turn


@dataclass(frozen=True)
class Link:
    """One direction. `queue_ms` bounds what waits for the rate: a packet that would wait longer is lost."""

    delay_ms: float = 0.0
    loss: float = 0.0
    rate_bps: float = 0.0       # 0: any
    queue_ms: float = 200.0
    cut: bool = False


class Direction:
    """Packets on their way to the device `target`."""

    def __init__(self, target: int, seed: int) -> None:
        self.link = Link()
        self.passed = self.lost = self.overflowed = 0
        self._target, self._random = target, random.Random(seed)
        self._free_at = 0.0         # when the link has sent what it was given
        self._waiting: list[tuple[float, int, bytes]] = []
        self._numbers = itertools.count()

    def take(self, packet: bytes, now: float) -> None:
        link = self.link
        if link.cut or (link.loss and self._random.random() < link.loss):
            self.lost += 1
            return
        sent_at = now
        if link.rate_bps:
            begins = max(self._free_at, now)
            if begins - now > link.queue_ms / 1e3:
                self.overflowed += 1
                return
            sent_at = self._free_at = begins + 8 * len(packet) / link.rate_bps
        if sent_at + link.delay_ms / 1e3 <= now and not self._waiting:
            self._pass(packet)
        else:
            heapq.heappush(self._waiting, (sent_at + link.delay_ms / 1e3, next(self._numbers), packet))

    def release(self, now: float) -> float | None:
        """Let go of what is due. Returns the seconds until the next packet is."""
        while self._waiting and self._waiting[0][0] <= now:
            packet = heapq.heappop(self._waiting)[2]
            if self.link.cut:
                self.lost += 1
            else:
                self._pass(packet)
        return self._waiting[0][0] - now if self._waiting else None

    def counters(self) -> dict[str, int]:
        return {"passed": self.passed, "lost": self.lost, "overflowed": self.overflowed}

    def _pass(self, packet: bytes) -> None:
        try:
            os.write(self._target, packet)
            self.passed += 1
        except OSError:             # the device is down, or has no room
            self.overflowed += 1


def relay(near: int, far: int, commands: int) -> None:
    """Until the end of `commands`."""
    directions = {near: Direction(far, 1), far: Direction(near, 2)}
    down, up = directions[near], directions[far]
    poll = select.poll()
    for descriptor in (near, far, commands):
        poll.register(descriptor, select.POLLIN)
    text = b""
    while True:
        now = time.monotonic()
        due = [left for one in directions.values() if (left := one.release(now)) is not None]
        for descriptor, _ in poll.poll(max(min(due), 0.0) * 1e3 if due else None):
            if descriptor != commands:
                _read(descriptor, directions[descriptor])
                continue
            got = os.read(commands, LARGEST_PACKET)
            if not got:
                return
            *lines, text = (text + got).split(b"\n")
            for line in lines:
                _set(json.loads(line), down, up)


def _read(device: int, direction: Direction) -> None:
    now = time.monotonic()
    for _ in range(MOST_READ):
        try:
            direction.take(os.read(device, LARGEST_PACKET), now)
        except BlockingIOError:
            return


def _set(command: dict[str, Any], down: Direction, up: Direction) -> None:
    for name, direction in (("down", down), ("up", up)):
        if name in command:
            direction.link = Link(**command[name])
    print(json.dumps({"down": down.counters(), "up": up.counters()}), flush=True)


def open_tun(name: str) -> int:
    """A new TUN device, which lives as long as its descriptor. Raises OSError."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    return device


def main() -> None:
    near, far = map(open_tun, sys.argv[1:3])
    print("ready", flush=True)
    relay(near, far, sys.stdin.fileno())


if __name__ == "__main__":
    main()
