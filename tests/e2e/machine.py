"""Who uses the machine: a measurement means something only while nobody else does."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple


class Ticks(NamedTuple):
    """Of the clock so far: of some cores all, those at work, and of some processes."""

    all: int
    busy: int
    own: int


def ticks(cores: Iterable[int], processes: Iterable[int]) -> Ticks:
    """`processes` (ids) that have ended count as nothing."""
    names = {f"cpu{core}" for core in cores}
    lines = [line.split() for line in Path("/proc/stat").read_text().splitlines() if line.split()[0] in names]
    counts = [[int(value) for value in fields[1:9]] for fields in lines]     # user nice system idle iowait irq softirq steal
    everything = sum(map(sum, counts))
    return Ticks(everything, everything - sum(one[3] + one[4] for one in counts), sum(map(_of_process, processes)))


def others_share(before: Ticks, after: Ticks) -> float:
    """Of the cores' time, what processes that are not named have used: 0 to 1."""
    return max(0.0, (after.busy - before.busy - (after.own - before.own)) / max(after.all - before.all, 1))


def _of_process(number: int) -> int:
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])
    return 0
