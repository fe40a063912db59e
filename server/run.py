"""Run the service in this process."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
from collections.abc import Callable, Coroutine, Iterator
from typing import Literal

import uvicorn

from server.app import create_app
from server.config import ConfigError, Settings
from server.memory import give_back_memory, settle

logger = logging.getLogger(__name__)

GRACE_S = 1                 # for requests in progress when the service ends
MAX_WEBSOCKET_MESSAGE = 64 << 10
LOG_FORMAT = "%(asctime)s %(levelname)-7s %(name)s: %(message)s"


def configure_logging(level: int = logging.INFO) -> None:
    logging.basicConfig(level=level, format=LOG_FORMAT)
    for chatty in ("aiortc", "aioice", "uvicorn"):
        logging.getLogger(chatty).setLevel(max(level, logging.WARNING))


async def serve(settings: Settings, *, started: Callable[[str], None] | None = None,
                stop: asyncio.Event | None = None) -> None:
    """Serve until `stop` is set, a SIGINT or SIGTERM comes, or the task is cancelled; then end everything.

    Args:
        started: told the base URL once requests are answered.

    Raises:
        ConfigError: the address cannot be listened on.
    """
    stop = stop or asyncio.Event()
    listener = _listen(settings.host, settings.port)
    config = uvicorn.Config(
        create_app(settings), lifespan="on", log_config=None, access_log=False, server_header=False,
        timeout_graceful_shutdown=GRACE_S, ws_max_size=MAX_WEBSOCKET_MESSAGE, ws_per_message_deflate=False,
        root_path=settings.root_path, forwarded_allow_ips=list(settings.trusted_proxies))
    server = _Server(config)
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    giving_back = asyncio.create_task(give_back_memory())
    try:
        with _signals(stop):
            await _first_of(serving, server.has_started.wait())
            settle()
            if started is not None and server.started:
                started(_base_url(settings.host, listener))
            await _first_of(serving, stop.wait())
    finally:
        giving_back.cancel()
        server.should_exit = True
        await serving
        listener.close()


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.has_started = asyncio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.has_started.set()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Signals are ours: uvicorn would raise them again at the end, and the exit status would not be 0."""
        yield


async def _first_of(serving: asyncio.Task[None], event: Coroutine[None, None, Literal[True]]) -> None:
    waiting = asyncio.create_task(event)
    try:
        await asyncio.wait([serving, waiting], return_when=asyncio.FIRST_COMPLETED)
    finally:
        waiting.cancel()


@contextlib.contextmanager
def _signals(stop: asyncio.Event) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    caught: list[signal.Signals] = []
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            # Outside the main thread there are no signal handlers; the caller has `stop` then.
            with contextlib.suppress(ValueError, RuntimeError):
                loop.add_signal_handler(number, stop.set)
                caught.append(number)
        yield
    finally:
        for number in caught:
            loop.remove_signal_handler(number)


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ConfigError(f"cannot listen on {host} port {port}: {reason}, expected a free address") from None
    return listener


def _base_url(host: str, listener: socket.socket) -> str:
    port = listener.getsockname()[1]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{shown}:{port}"
