"""The whole service as a real process, and the words to talk to it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import httpx
from processes import Process, free_port, wait_for

READY_WITHIN_S = 60.0       # a cold worker compiles its shaders first, on a machine with other work to do
LIVE_WITHIN_S = 30.0


class Service:
    """`mr360 serve` on a free port. `url` is its base URL, without a slash at the end."""

    def __init__(self, folder: Path, *arguments: str, environment: dict[str, str] | None = None) -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.process = Process(
            [sys.executable, "-m", "server.cli", "serve", "--host", "127.0.0.1", "--port", str(self.port), *arguments],
            folder / f"service-{self.port}.log", {"MR360_ASSETS_DIR": str(folder / "assets"), **(environment or {})})
        self.http = httpx.Client(base_url=self.url, timeout=10.0, trust_env=False)

    @property
    def log(self) -> Path:
        return self.process.log

    def wait_ready(self) -> None:
        def ready() -> bool:
            assert self.process.running(), f"the service ended:\n{self.process.output()[-3000:]}"
            try:
                return self.http.get("/readyz").status_code == 200
            except httpx.TransportError:
                return False

        wait_for("ready service", ready, READY_WITHIN_S)

    def request(self, method: str, path: str, body: Any = None, expect: int | None = None, **more: Any) -> Any:
        """The JSON of the answer, None if it has none. AssertionError for a status that is not `expect` (or 2xx)."""
        answer = self.http.request(method, path, json=body, **more)
        as_expected = answer.is_success if expect is None else answer.status_code == expect
        assert as_expected, f"{method} {path} gave {answer.status_code}, expected {expect or '2xx'}: {answer.text}"
        return answer.json() if answer.content and "json" in answer.headers["content-type"] else None

    def pull(self, source: str | None, wait: bool = True) -> None:
        """Point the stream `live`, which is always there, to a source."""
        self.request("PATCH", "/api/streams/live", {"source": source})
        if wait:
            self.wait_live("live")

    def create_stream(self, name: str, source: str | None, wait: bool = True) -> None:
        self.request("POST", "/api/streams", {"name": name, "source": source})
        if wait:
            self.wait_live(name)

    def stream(self, name: str = "live") -> dict[str, Any]:
        found: dict[str, Any] = self.request("GET", f"/api/streams/{name}")
        return found

    def stats(self, name: str = "live") -> dict[str, Any]:
        found: dict[str, Any] = self.request("GET", f"/api/streams/{name}/stats")
        return found

    def wait_state(self, name: str, *states: str, seconds: float = LIVE_WITHIN_S) -> dict[str, Any]:
        last: dict[str, Any] = {}

        def reached() -> bool:
            last.update(self.stream(name))
            return last["state"] in states

        try:
            wait_for(f"state {' or '.join(states)} of {name!r}", reached, seconds)
        except AssertionError as error:
            raise AssertionError(f"{error}, it is {last}\n{self.process.output()[-3000:]}") from None
        return last

    def wait_live(self, name: str = "live", seconds: float = LIVE_WITHIN_S) -> dict[str, Any]:
        return self.wait_state(name, "live", seconds=READY_WITHIN_S + seconds)

    def place(self, name: str = "live", **placed: Any) -> None:
        self.request("POST", f"/api/streams/{name}/objects", placed)

    def stop(self) -> None:
        """Ctrl-C: must end with status 0 within 3 s and leave no process behind."""
        self.http.close()
        status = self.process.stop(3.0)
        assert status == 0, f"exit status {status} after Ctrl-C:\n{self.process.output()[-3000:]}"
