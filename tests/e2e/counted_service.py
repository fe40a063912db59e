"""`mr360` that tells what it holds: `counted_service.py FILE ARGUMENTS…` writes a JSON object into FILE at each SIGUSR2.

`tasks`, `descriptors`, `threads`, `objects` (that the garbage collector knows), `heap_mb` (in use, as the C library tells) and
`resident_mb`, after a full collection.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import json
import os
import signal
import sys
import threading
from pathlib import Path

from server.cli import main
from server.memory import _Mallinfo


def holdings() -> dict[str, float]:
    gc.unfreeze()               # what the service has set aside at its start counts too
    gc.collect()
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = _Mallinfo
    heap = libc.mallinfo2()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {"tasks": len(asyncio.all_tasks(asyncio.get_running_loop())), "descriptors": len(os.listdir("/proc/self/fd")),
            "threads": threading.active_count(), "objects": len(gc.get_objects()),
            "heap_mb": (heap.uordblks + heap.hblkhd) / 1e6, "resident_mb": pages * os.sysconf("SC_PAGE_SIZE") / 1e6}


def _write(*_: object) -> None:
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(holdings()))
    partial.replace(file)


if __name__ == "__main__":
    file = Path(sys.argv[1])
    signal.signal(signal.SIGUSR2, _write)
    sys.exit(main(sys.argv[2:]))
