"""The demo's own viewer as a child: a second WebRTC stack beside Chromium's."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from processes import Process, wait_for


class HeadlessViewer:
    def __init__(self, whep_url: str, log: Path) -> None:
        self.process = Process([sys.executable, "-m", "server.demo.viewer", whep_url], log)

    def progress(self) -> dict[str, Any]:
        """The newest line; see server.demo.viewer."""
        lines = [line for line in self.process.output().split("\n")[:-1] if line.startswith("{")]
        newest: dict[str, Any] = json.loads(lines[-1]) if lines else {"state": "new", "frames": 0, "timestamp": None}
        return newest

    def wait_frames(self, more: int, seconds: float = 30.0) -> dict[str, Any]:
        """Wait until so many more frames have been decoded."""
        wanted = int(self.progress()["frames"]) + more

        def enough() -> bool:
            assert self.process.running(), f"the viewer ended:\n{self.process.output()[-2000:]}"
            return int(self.progress()["frames"]) >= wanted

        wait_for(f"{more} more frames in the viewer", enough, seconds)
        return self.progress()
