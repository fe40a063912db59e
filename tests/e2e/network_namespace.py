"""A viewer's own network: a namespace that reaches the service only through a relay which behaves as badly as it is told."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from network_relay import Link

_numbers = itertools.count(1)


class NetworkUnavailableError(RuntimeError):
    """This process may not make network namespaces; the text says why."""


class Network:
    """`near` is the service's address as seen from inside; `command` starts a program inside."""

    def __init__(self, folder: Path) -> None:
        number = next(_numbers)
        self.name = f"mr360-{os.getpid()}-{number}"
        self._folder = folder
        subnet = 64 + (os.getpid() + number) % 64       # 100.64.0.0/10, carriers' own: nobody else is there
        self.near, self.far = f"100.{subnet}.{number}.1", f"100.{subnet}.{number}.2"
        self._relay: subprocess.Popen[str] | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Network:
        try:
            self._make()
        except (OSError, subprocess.CalledProcessError) as error:
            self._stack.close()
            words = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else str(error)
            raise NetworkUnavailableError(f"no network namespace can be made here: {words}") from None
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _make(self) -> None:
        near, far = (f"m{os.getpid()}-{self.name.rpartition('-')[2]}{end}"[-15:] for end in "nf")
        _ip("netns", "add", self.name)
        self._stack.callback(_ip, "netns", "del", self.name)
        self._relay = subprocess.Popen([sys.executable, str(Path(__file__).with_name("network_relay.py")), near, far],
                                       stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self._stack.callback(self._end_relay)
        assert self._relay.stdout is not None
        if self._relay.stdout.readline() != "ready\n":
            raise OSError(self._relay.stderr.read().strip().splitlines()[-1] if self._relay.stderr else "the relay ended")
        _ip("addr", "add", self.near, "peer", self.far, "dev", near)
        _ip("link", "set", near, "up")
        _ip("link", "set", far, "netns", self.name)
        for words in (("addr", "add", self.far, "peer", self.near, "dev", far), ("link", "set", far, "up"),
                      ("link", "set", "lo", "up"), ("route", "add", "default", "via", self.near)):
            _ip("-n", self.name, *words)

    def _end_relay(self) -> None:
        assert self._relay is not None
        for pipe in (self._relay.stdin, self._relay.stdout, self._relay.stderr):
            if pipe is not None:
                pipe.close()
        self._relay.wait(5)

    def behave(self, down: Link | None = None, up: Link | None = None) -> dict[str, Any]:
        """From now on; perfectly where nothing is given. Returns the relay's counters so far."""
        assert self._relay is not None
        assert self._relay.stdin is not None
        assert self._relay.stdout is not None
        self._relay.stdin.write(json.dumps({"down": asdict(down or Link()), "up": asdict(up or Link())}) + "\n")
        self._relay.stdin.flush()
        counters: dict[str, Any] = json.loads(self._relay.stdout.readline())
        return counters

    def cut(self) -> None:
        """Nothing passes any more, in either direction."""
        self.behave(Link(cut=True), Link(cut=True))

    @property
    def relay_cpu_seconds(self) -> float:
        """Processor time that the relay has used."""
        assert self._relay is not None
        fields = Path(f"/proc/{self._relay.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def command(self, *words: str) -> list[str]:
        """The command line that runs these words inside."""
        return ["ip", "netns", "exec", self.name, *words]

    def wrapper(self, program: str) -> Path:
        """An executable that runs that program inside, with whatever arguments it is given."""
        script = self._folder / f"{self.name}-{Path(program).name}"
        script.write_text(f'#!/bin/sh\nexec {" ".join(self.command(program))} "$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
        return script


@contextlib.contextmanager
def networks(folder: Path, count: int) -> Iterator[list[Network]]:
    """So many. Raises NetworkUnavailableError."""
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(Network(folder)) for _ in range(count)]


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
