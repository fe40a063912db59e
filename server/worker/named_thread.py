"""Threads that the operating system knows by name too, so that `top -H`, `perf` and the bench tell which of them works."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

LONGEST_NAME = 15   # bytes, of the kernel's


class NamedThread(threading.Thread):
    """Python does it by itself from 3.14 on."""

    def run(self) -> None:
        with contextlib.suppress(OSError):      # no Linux
            Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(self.name[:LONGEST_NAME])
        super().run()
