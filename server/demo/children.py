"""Child processes of the demo run. Each has a session of its own: Ctrl-C reaches the run only, which ends them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

STOP_WITHIN_S = 2.5


class ChildError(RuntimeError):
    """A child ended although it should run; the text says which and how."""


class Child:
    """`python -m MODULE ARGUMENTS`. Its standard output is a text pipe if `piped`, otherwise ours.

    With `log`, what it writes and does not pipe is appended to that file. `environment` is added to ours.
    """

    def __init__(self, name: str, module: str, arguments: Sequence[str | Path], piped: bool, log: Path | None = None,
                 environment: Mapping[str, str] | None = None) -> None:
        self.name = name
        self._log = log
        with contextlib.ExitStack() as stack:
            written = None if log is None else stack.enter_context(log.open("ab"))
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, arguments)], stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if piped else written, stderr=written, start_new_session=True, text=True,
                env={**os.environ, **(environment or {})})

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def stdout(self) -> IO[str]:
        assert self._process.stdout is not None
        return self._process.stdout

    def check(self) -> None:
        """Raises ChildError when it has ended."""
        status = self._process.poll()
        if status is not None:
            raise ChildError(f"the {self.name} ended by itself with status {status}{self._last_words()}")

    def _last_words(self) -> str:
        lines = [] if self._log is None else self._log.read_text(errors="replace").splitlines()
        return f": {lines[-1]}" if lines else ""

    def interrupt(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def end(self, seconds: float) -> None:
        """Wait so long for it, then end it by force."""
        try:
            self._process.wait(max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def cpu_seconds(self) -> float:
        """Processor time of this process alone, without what it started; 0 where the system does not tell."""
        try:
            fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Children:
    """Context manager: whatever was started in it has ended within STOP_WITHIN_S of leaving it."""

    def __init__(self) -> None:
        self._children: list[Child] = []

    def start(self, name: str, module: str, *arguments: str | Path, piped: bool = False, log: Path | None = None,
              environment: Mapping[str, str] | None = None) -> Child:
        child = Child(name, module, arguments, piped, log, environment)
        self._children.append(child)
        return child

    def stop(self, child: Child) -> None:
        """End one of them now, within STOP_WITHIN_S."""
        self._children.remove(child)
        child.interrupt()
        child.end(STOP_WITHIN_S)

    def check(self) -> None:
        """Raises ChildError when one of them has ended."""
        for child in self._children:
            child.check()

    def __enter__(self) -> Children:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        limit = time.monotonic() + STOP_WITHIN_S
        for child in self._children:
            child.interrupt()
        for child in self._children:
            child.end(limit - time.monotonic())
