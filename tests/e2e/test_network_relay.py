"""The bad network itself: what it is told to do with packets, it does."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from network_namespace import Network, NetworkUnavailableError
from network_relay import Link

pytestmark = [pytest.mark.e2e, pytest.mark.alone]

# Sends back what comes, and says when it is there.
ECHO = """
import socket, sys
echo = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
echo.bind((sys.argv[1], 0))
print(echo.getsockname()[1], flush=True)
while True:
    data, sender = echo.recvfrom(2000)
    echo.sendto(data, sender)
"""


class Echo:
    """A socket here and one in the namespace that answers."""

    def __init__(self, network: Network) -> None:
        self.network = network
        command = network.command(sys.executable, "-c", ECHO, network.far)
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self._address = (network.far, int(self._process.stdout.readline()))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((network.near, 0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)

    def round_trips_ms(self, count: int, every_s: float, size: int = 1000, wait_s: float = 0.5) -> list[float]:
        """Of those packets that come back."""
        sent, found = {}, []
        end = time.monotonic() + count * every_s + wait_s
        due = time.monotonic()
        while time.monotonic() < end:
            if len(sent) < count and time.monotonic() >= due:
                sent[len(sent)] = time.monotonic()
                self._socket.sendto((len(sent) - 1).to_bytes(4, "big").ljust(size, b"."), self._address)
                due += every_s
            self._socket.settimeout(max(0.0005, min(due - time.monotonic(), 0.05) if len(sent) < count else 0.05))
            try:
                answer = self._socket.recv(2000)
            except TimeoutError:
                continue
            found.append(1e3 * (time.monotonic() - sent[int.from_bytes(answer[:4], "big")]))
        return found

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._socket.close()


@pytest.fixture
def echo(tmp_path: Path) -> Iterator[Echo]:
    with contextlib.ExitStack() as stack:
        try:
            network = stack.enter_context(Network(tmp_path))
        except NetworkUnavailableError as error:
            pytest.skip(str(error))
        yield stack.enter_context(contextlib.closing(Echo(network)))


def test_a_good_network_loses_nothing(echo: Echo) -> None:
    assert len(echo.round_trips_ms(500, 0.001)) == 500


def test_delay(echo: Echo) -> None:
    before = np.median(echo.round_trips_ms(50, 0.005))
    echo.network.behave(Link(delay_ms=40.0), Link(delay_ms=20.0))
    assert np.median(echo.round_trips_ms(50, 0.005)) - before == pytest.approx(60.0, abs=10.0)


def test_loss(echo: Echo) -> None:
    echo.network.behave(Link(loss=0.1))
    count = len(echo.round_trips_ms(2000, 0.0005, size=200))
    assert count == pytest.approx(1800, abs=60), "10 % of 2000, within four standard deviations and a half"
    assert echo.network.behave()["down"]["lost"] == pytest.approx(2000 - count, abs=5), "but for what the kernel itself sends"


def test_rate_and_its_queue(echo: Echo) -> None:
    """Eight times what the link can carry: the rest is lost, and nothing waits much longer than the queue is long."""
    echo.network.behave(Link(rate_bps=1e6, queue_ms=100.0))
    began = time.monotonic()
    came = echo.round_trips_ms(1000, 0.001, size=972)       # 1000 bytes with headers, 125 of them a second at 1 Mbit/s
    took_s = time.monotonic() - began
    assert 60 < len(came) <= 125 * (took_s + 0.1) + 2, "more than the link carries"
    overflowed = echo.network.behave()["down"]["overflowed"]
    assert len(came) + overflowed == pytest.approx(1000, abs=5), "but for what the kernel itself sends"
    assert 80.0 < np.percentile(came, 90) < 250.0


def test_a_cut_lasts_until_it_is_mended(echo: Echo) -> None:
    echo.network.cut()
    assert not echo.round_trips_ms(20, 0.005)
    echo.network.behave()
    assert len(echo.round_trips_ms(20, 0.005)) == 20


def test_it_costs_little_at_ten_megabits(echo: Echo) -> None:
    echo.network.behave(Link(delay_ms=20.0, loss=0.001), Link(delay_ms=20.0))
    before, began = echo.network.relay_cpu_seconds, time.monotonic()
    echo.round_trips_ms(2000, 0.001, size=1200)
    assert (echo.network.relay_cpu_seconds - before) / (time.monotonic() - began) < 0.25
