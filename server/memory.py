"""The memory of the server's process: short collections while viewers watch, and what they needed given back when they have left.

A viewer's packets, kept to be sent again, are megabytes of small blocks. glibc keeps what is freed of them, so that the process
would stay as large as its largest audience ever made it.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import os
from collections.abc import Callable
from pathlib import Path

CHECK_EVERY_S = 5.0
WORTH_BYTES = 4_000_000


def settle() -> None:
    """Take what has been made so far out of all later collections: one of modules and schemas stops the process for a tenth of a
    second, and nothing of them is ever freed."""
    gc.collect()
    gc.freeze()


async def give_back_memory() -> None:
    """Return free heap to the system again and again, until cancelled. Ends at once where the C library is not glibc."""
    try:
        libc = ctypes.CDLL(None)
        mallinfo: Callable[[], _Mallinfo] = libc.mallinfo2
        libc.mallinfo2.restype = _Mallinfo
        trim: Callable[[int], int] = libc.malloc_trim
    except (OSError, AttributeError):
        return
    after_last = 0
    while True:
        await asyncio.sleep(CHECK_EVERY_S)
        if mallinfo().fordblks > WORTH_BYTES and _resident_bytes() > after_last + WORTH_BYTES:
            await asyncio.to_thread(trim, 0)
            after_last = _resident_bytes()


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class _Mallinfo(ctypes.Structure):
    """What mallinfo2(3) gives, in bytes; `fordblks` is free."""

    _fields_ = (("arena", ctypes.c_size_t), ("ordblks", ctypes.c_size_t), ("smblks", ctypes.c_size_t), ("hblks", ctypes.c_size_t),
                ("hblkhd", ctypes.c_size_t), ("usmblks", ctypes.c_size_t), ("fsmblks", ctypes.c_size_t),
                ("uordblks", ctypes.c_size_t), ("fordblks", ctypes.c_size_t), ("keepcost", ctypes.c_size_t))
