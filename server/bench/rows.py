"""One measurement of one method: how long it takes and how far it is from its reference."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mark = Literal["", "default", "paper", "null"]
NOTHING = np.zeros(0)
ALL = "all"


@dataclass(frozen=True)
class Row:
    """`errors`: found less expected, any shape, in units of what the stage says; `times_ms`: of each run, empty where nothing is
    done; `mark`: whether a preset uses it, or it is the row that does nothing; `extra`: figures that only this stage has;
    `condition`: under which methods are compared with each other."""

    stage: str
    method: str
    scene: str
    errors: Array = field(default_factory=lambda: NOTHING)
    times_ms: Array = field(default_factory=lambda: NOTHING)
    params: str = ""
    mark: Mark = ""
    extra: dict[str, float | None] = field(default_factory=dict)
    condition: str = ""

    @property
    def name(self) -> str:
        return " ".join(part for part in (self.method, self.params, self.condition) if part)

    def percentile_ms(self, percent: float) -> float | None:
        return round(float(np.percentile(self.times_ms, percent)), 4) if len(self.times_ms) else None

    @property
    def err_rms(self) -> float | None:
        return float(np.sqrt((self.errors**2).mean())) if self.errors.size else None

    def as_json(self) -> dict[str, Any]:
        size = np.abs(self.errors).ravel()
        found = {"err_rms": self.err_rms, "err_p99": float(np.percentile(size, 99)), "err_max": float(size.max()),
                 "bias": float(self.errors.mean())} if size.size else dict.fromkeys(("err_rms", "err_p99", "err_max", "bias"))
        return {"stage": self.stage, "method": self.method, "params": self.params, "condition": self.condition, "scene": self.scene,
                "mark": self.mark, "ms_p50": self.percentile_ms(50), "ms_p95": self.percentile_ms(95), "timed": len(self.times_ms),
                **found, **self.extra}


def pooled(rows: Iterable[Row]) -> list[Row]:
    """One row a method and condition, over all scenes: all errors and all times together, the mean of the other figures."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.stage, row.method, row.params, row.condition), []).append(row)
    return [replace(group[0], scene=ALL if len(group) > 1 else group[0].scene,
                    errors=np.concatenate([row.errors.ravel() for row in group]),
                    times_ms=np.concatenate([row.times_ms for row in group]), extra=_means([row.extra for row in group]))
            for group in groups.values()]


def _means(given: list[dict[str, float | None]]) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for name in dict.fromkeys(name for one in given for name in one):
        values = [value for one in given if (value := one.get(name)) is not None]
        found[name] = float(np.mean(values)) if values else None
    return found


def relative(found: NDArray[np.floating], expected: NDArray[np.floating]) -> Array:
    """Found less expected, in units of the root mean square of what was expected."""
    return np.asarray((found - expected) / max(float(np.sqrt((np.asarray(expected) ** 2).mean())), 1e-300))


def timed(work: Callable[[], object], repeats: int, warm_up: int = 2) -> Array:
    """Milliseconds of so many runs, after some that do not count."""
    for _ in range(warm_up):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append((time.perf_counter() - start) * 1e3)
    return np.array(times)
