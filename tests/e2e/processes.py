"""Real child processes of the end-to-end tests: started with a log, watched, and stopped without leftovers."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

PROJECT = Path(__file__).resolve().parents[2]
MARK = "E2E_PROCESS"        # in the environment of a process and of everything it starts
T = TypeVar("T")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_for(what: str, check: Callable[[], T], seconds: float, pause: float = 0.1) -> T:
    """Call `check` until it returns something true; AssertionError that says what was waited for otherwise."""
    end = time.monotonic() + seconds
    while True:
        value = check()
        if value:
            return value
        assert time.monotonic() < end, f"no {what} within {seconds:g} s"
        time.sleep(pause)


def accepts_connections(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False


class Process:
    """A child in a session of its own, its output in a file."""

    def __init__(self, command: Sequence[str | Path], log: Path, environment: dict[str, str] | None = None) -> None:
        self.log = log
        self.mark = uuid.uuid4().hex
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [str(part) for part in command], cwd=PROJECT, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                start_new_session=True, env={**os.environ, **(environment or {}), MARK: self.mark})

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def signal(self, number: int) -> None:
        if self.running():
            self._process.send_signal(number)

    def wait(self, seconds: float) -> int:
        """The exit status. Raises subprocess.TimeoutExpired."""
        return self._process.wait(seconds)

    def descendants(self) -> set[int]:
        """Every living process that this one started, whatever session it is in."""
        found = set()
        for folder in Path("/proc").iterdir():
            if not folder.name.isdigit() or int(folder.name) == self.pid:
                continue
            with contextlib.suppress(OSError):
                marked = f"{MARK}={self.mark}".encode() in (folder / "environ").read_bytes().split(b"\0")
                if marked and (folder / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                    found.add(int(folder.name))
        return found

    def stop(self, seconds: float = 3.0) -> int:
        """Ctrl-C. Returns the exit status; AssertionError when it takes longer or leaves a process behind."""
        try:
            self.signal(signal.SIGINT)
            try:
                status = self.wait(seconds)
            except subprocess.TimeoutExpired:
                raise AssertionError(f"still running {seconds:g} s after Ctrl-C:\n{self.output()[-3000:]}") from None
            left = self.descendants()
            assert not left, f"left processes {sorted(left)} behind:\n{self.output()[-3000:]}"
            return status
        finally:
            self.kill()

    def kill(self) -> None:
        """End it and everything it started, by force."""
        for pid in self.descendants():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if self.running():
            self._process.kill()
        self._process.wait(5)
