"""What a report was measured on, without which its times mean nothing."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from renderer.gl import Context

PACKAGES = ("mr360", "numpy", "scipy", "moderngl", "av")


def machine_record(context: Context) -> dict[str, Any]:
    """As at the start; `load_average_end` is for the end."""
    return {"date": datetime.now(UTC).isoformat(timespec="seconds"), "processors": os.cpu_count(), "cpu": _cpu_model(),
            "system": platform.platform(), "renderer": context.renderer, "gl_version": context.version,
            "LP_NUM_THREADS": os.environ.get("LP_NUM_THREADS"),
            "threads": {name: os.environ[name] for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS") if name in os.environ},
            "load_average_start": os.getloadavg()[0],
            "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}}


def machine_figures() -> dict[str, Any]:
    """Of the processors alone, for benchmarks that open no OpenGL themselves."""
    return {"processors": os.cpu_count() or 1, "model": f"{_cpu_model()}, {platform.machine()}",
            "load_average": os.getloadavg()[0], "lp_num_threads": os.environ.get("LP_NUM_THREADS")}


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
