"""What the kernel knows of a process: its memory, and which of its threads used the processor."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_NUMBERED = re.compile(r"[-:]?\d+$")
_MEMORY = re.compile(r"^(VmRSS|VmHWM):\s+(\d+) kB$", re.MULTILINE)


class ProcessGoneError(RuntimeError):
    """There is no such process any more."""


@dataclass(frozen=True)
class Memory:
    """Resident megabytes (10^6 bytes) of a process: now, and the most there ever were."""

    now_mb: float
    peak_mb: float


def memory_of(pid: int) -> Memory:
    """Raises ProcessGoneError."""
    found = {name: int(kilobytes) * 1024 / 1e6 for name, kilobytes in _MEMORY.findall(_read(PROC / str(pid) / "status"))}
    if len(found) < 2:
        raise ProcessGoneError(f"process {pid} has ended")
    return Memory(found["VmRSS"], found["VmHWM"])


def child_of(parent: int, word: str) -> int:
    """The process that `parent` started with `word` among its arguments. Raises ProcessGoneError when there is none."""
    for folder in PROC.iterdir():
        try:
            if folder.name.isdigit() and int(_after_name(folder / "stat")[1]) == parent and word in _arguments(folder):
                return int(folder.name)
        except ProcessGoneError:
            continue
    raise ProcessGoneError(f"process {parent} has no child {word!r}")


class ThreadClock:
    """Which threads of a process use the processor, from the making of this object on. Raises ProcessGoneError."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._before, self._started = self._threads(), time.monotonic()

    def cores(self) -> dict[str, float]:
        """Processor seconds a second by thread, the busiest first. `main` is the first thread; of threads with numbered names
        (`llvmpipe-0`) the sum. What a thread used that has ended meanwhile is lost."""
        seconds = time.monotonic() - self._started
        total: dict[str, float] = {}
        for thread, (name, used) in self._threads().items():
            total[name] = total.get(name, 0.0) + (used - self._before.get(thread, ("", 0.0))[1]) / seconds
        return dict(sorted(total.items(), key=lambda item: -item[1]))

    def _threads(self) -> dict[int, tuple[str, float]]:
        found = {}
        for folder in _listed(PROC / str(self._pid) / "task"):
            try:
                name = "main" if int(folder.name) == self._pid else _NUMBERED.sub("", _read(folder / "comm").strip())
                fields = _after_name(folder / "stat")
            except ProcessGoneError:
                continue        # the thread alone
            found[int(folder.name)] = (name, (int(fields[11]) + int(fields[12])) / _TICKS_PER_S)
        return found


class OtherWork:
    """What the machine does beside this process and the given ones, from the making of this object on."""

    def __init__(self, pids: Sequence[int]) -> None:
        self._pids = (os.getpid(), *pids)
        self._before, self._started = self._seconds(), time.monotonic()

    def cores(self) -> float:
        """Processor seconds a second. Raises ProcessGoneError when one of the processes has ended."""
        return max(0.0, (self._seconds() - self._before) / (time.monotonic() - self._started))

    def _seconds(self) -> float:
        user, nice, system, _, _, *interrupts_and_stolen = map(int, _read(PROC / "stat").split("\n", 1)[0].split()[1:9])
        ours = sum(int(ticks) for pid in self._pids for ticks in _after_name(PROC / str(pid) / "stat")[11:13])
        return (user + nice + system + sum(interrupts_and_stolen) - ours) / _TICKS_PER_S


def _after_name(stat: Path) -> list[str]:
    """Fields from the state on: what stands before them may contain spaces."""
    return _read(stat).rpartition(")")[2].split()


def _arguments(folder: Path) -> list[str]:
    return _read(folder / "cmdline").split("\0")


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        raise ProcessGoneError(f"process {folder.parent.name} has ended") from None


def _read(file: Path) -> str:
    try:
        return file.read_text(errors="replace")
    except OSError:
        raise ProcessGoneError(f"{file} cannot be read") from None
