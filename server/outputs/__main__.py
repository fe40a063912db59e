"""The process of one output: `python -m server.outputs --fd N`, started by the server with one end of a socket pair.

One process is one connection or one file: whatever ends it, the server starts the next. So nothing of FFmpeg's is ever used
again after an error, and a call that never returns is ended with the process.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import sys

from server.worker.messages import Message, receive_message


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.outputs")
    parser.add_argument("--fd", type=int, required=True)
    connection = socket.socket(fileno=parser.parse_args().fd)
    logging.basicConfig(level=logging.CRITICAL, stream=sys.stderr)      # what there is to say goes to the server, which masks it
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # Ctrl-C reaches the whole group; the server stops us
    start, _ = receive_message(connection)
    _run(start, connection)
    return 0


def _run(start: Message, connection: socket.socket) -> None:
    # Each imports what it needs and nothing more: a process is started for every try.
    if start["kind"] == "whip":
        import asyncio

        from server.outputs.whip import push

        asyncio.run(push(start, connection))
    else:
        from server.outputs.muxer import mux

        mux(start, connection)


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)    # a thread may sit in a call of FFmpeg's
