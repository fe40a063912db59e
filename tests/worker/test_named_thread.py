"""The operating system's name of a thread."""

from __future__ import annotations

import threading
from pathlib import Path

from server.worker.named_thread import NamedThread


def test_the_system_knows_the_name() -> None:
    seen: list[str] = []

    def look() -> None:
        seen.append(Path(f"/proc/self/task/{threading.get_native_id()}/comm").read_text().strip())

    thread = NamedThread(target=look, name="a name longer than the kernel's")
    thread.start()
    thread.join()
    assert seen == ["a name longer t"]
