"""A WHIP endpoint of the tests: FastAPI for the signalling, a real aiortc peer that receives and decodes."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import Any

import numpy as np
import uvicorn
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.mediastreams import MediaStreamError
from fastapi import FastAPI, Request, Response

TOKEN = "a-very.secret_token"


class WhipReceiver:
    """`async with WhipReceiver() as sfu:`. `/whip/live` takes a session, `/redirect/N` and `/refuse/STATUS` do what they say."""

    def __init__(self, *, link: str | None = None, unreachable_answers: int = 0) -> None:
        """`unreachable_answers`: so many answers name a candidate at which nobody is."""
        self._unreachable_answers = unreachable_answers
        self.offers: list[str] = []
        self.authorizations: list[str | None] = []
        self.deleted = 0
        self.pictures: list[np.ndarray] = []        # luma
        self.loudest = 0.0
        self.connection: RTCPeerConnection | None = None
        self._link = link
        self._socket = socket.socket()
        self._socket.bind(("127.0.0.1", 0))
        self._server = uvicorn.Server(uvicorn.Config(self._app(), log_config=None, lifespan="off", timeout_graceful_shutdown=1))
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._socket.getsockname()[1]}"

    async def __aenter__(self) -> WhipReceiver:
        self._socket.listen()
        self._server.capture_signals = contextlib.nullcontext       # type: ignore[method-assign]
        self._tasks = [asyncio.create_task(self._server.serve(sockets=[self._socket]))]
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.drop()
        self._server.should_exit = True
        await self._tasks[0]
        for task in self._tasks[1:]:
            task.cancel()
        await asyncio.gather(*self._tasks[1:], return_exceptions=True)
        self._socket.close()

    async def drop(self) -> None:
        """End the session from this side."""
        if self.connection is not None:
            await self.connection.close()

    async def ask_for_keyframe(self) -> None:
        assert self.connection is not None
        receiver = next(one for one in self.connection.getReceivers() if one.track.kind == "video")
        await receiver._send_rtcp_pli(receiver.getSynchronizationSources()[0].source)

    def _app(self) -> FastAPI:
        app = FastAPI()

        @app.post("/whip/live")
        async def offer(request: Request) -> Response:
            self.authorizations.append(request.headers.get("authorization"))
            if self.authorizations[-1] != f"Bearer {TOKEN}":
                return Response(status_code=401, headers={"WWW-Authenticate": "Bearer"})
            assert request.headers["content-type"] == "application/sdp"
            answer = await self._answer((await request.body()).decode())
            headers = {"Location": "../session/1"} | ({"Link": self._link} if self._link else {})
            return Response(answer, 201, headers, "application/sdp")

        @app.delete("/session/1")
        async def leave(request: Request) -> Response:
            assert request.headers.get("authorization") == f"Bearer {TOKEN}"
            self.deleted += 1
            return Response()

        @app.post("/redirect/{times}")
        async def redirect(times: int) -> Response:
            target = f"/redirect/{times - 1}" if times > 1 else "/whip/live"
            return Response(status_code=307 if times % 2 else 308, headers={"Location": target})

        @app.post("/refuse/{status}")
        async def refuse(status: int) -> Response:
            return Response(status_code=status, headers={"Retry-After": "1"} if status == 503 else {})

        return app

    async def _answer(self, offer: str) -> str:
        self.offers.append(offer)
        self.connection = connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        connection.on("track", lambda track: self._tasks.append(asyncio.create_task(self._take(track))))
        await connection.setRemoteDescription(RTCSessionDescription(offer, "offer"))
        await connection.setLocalDescription(await connection.createAnswer())
        sdp = str(connection.localDescription.sdp)
        if len(self.offers) > self._unreachable_answers:
            return sdp
        await connection.close()
        lines = [line for line in sdp.splitlines() if not line.startswith("a=candidate:")]
        index = lines.index("a=end-of-candidates")
        return "\r\n".join([*lines[:index], "a=candidate:1 1 udp 2130706431 127.0.0.1 9 typ host", *lines[index:], ""])

    async def _take(self, track: Any) -> None:
        with contextlib.suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                if track.kind == "video":
                    self.pictures.append(frame.to_ndarray(format="gray"))
                else:
                    self.loudest = max(self.loudest, float(np.abs(frame.to_ndarray()).max()) / 32768)
