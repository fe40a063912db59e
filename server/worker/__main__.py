"""The process of one stream: `python -m server.worker --fd N`, started by the server with one end of a socket pair."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import sys
import threading
from queue import SimpleQueue

from renderer.frame import YuvFrame
from renderer.gl import Context, GLUnavailableError
from renderer.pipeline import Pipeline
from server.worker.messages import Message, ProtocolError, encode_message, receive_message
from server.worker.named_thread import NamedThread
from server.worker.render_loop import RenderLoop
from server.worker.warm_up import warm_up

logger = logging.getLogger(__name__)
EXIT_FATAL = 3
SEND_BUFFER_BYTES = 4 << 20
SWITCH_INTERVAL_S = 0.0005  # the ingest and encode threads ask for the interpreter often and briefly: 5 ms each time adds up
WARM_UP_SIZE = (256, 128)


class Link:
    """The worker's end of the socket pair: a receiving thread, and sending from any thread."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        self._lock = threading.Lock()
        self.inbox: SimpleQueue[Message] = SimpleQueue()

    def send(self, message: Message, payload: bytes = b"") -> None:
        data = encode_message(message, payload)
        try:
            with self._lock:
                self._socket.sendall(data)
        except OSError:  # the server is gone, and nobody else wants what we make
            os._exit(0)

    def first(self) -> Message:
        return receive_message(self._socket)[0]

    def receive_for_ever(self) -> None:
        try:
            while True:
                self.inbox.put(receive_message(self._socket)[0])
        except (EOFError, OSError, ProtocolError):
            os._exit(0)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.worker")
    parser.add_argument("--fd", type=int, required=True)
    link = Link(parser.parse_args().fd)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the server stops us
    start = link.first()
    try:
        context = Context(require_gpu=bool(start.get("require_gpu")))
    except GLUnavailableError as error:
        link.send({"type": "fatal", "error": str(error)})
        return EXIT_FATAL
    NamedThread(target=link.receive_for_ever, name="receive", daemon=True).start()
    pipeline = Pipeline(context, YuvFrame, WARM_UP_SIZE)
    warm_up(pipeline, WARM_UP_SIZE)
    pipeline.release()
    link.send({"type": "ready", "renderer": context.renderer, "gl_version": context.version})
    loop = RenderLoop(start, context, link.inbox, link.send)
    try:
        loop.run()
    finally:
        loop.close()
    context.release()
    return 0


if __name__ == "__main__":
    status = main()
    logging.shutdown()
    os._exit(status)  # an ingest thread may sit in a read that only its time limit ends
