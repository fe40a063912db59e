"""The process of a WHIP output: a WebRTC peer that sends the stream to an SFU (RFC 9725)."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from aiortc import RTCBundlePolicy, RTCConfiguration, RTCIceServer, RTCPeerConnection, RTCSessionDescription
from aiortc.exceptions import InvalidAccessError, InvalidStateError, OperationError

from server.delivery import aiortc_hooks
from server.delivery.fanout import EncodedFrame
from server.outputs.networks import check_network
from server.outputs.server_link import PULSE_S, OutputFailedError, failed_message
from server.outputs.whip_http import MAX_REDIRECTIONS, Answer, Redirection, delete_session, post_offer
from server.outputs.whip_sender import PushedFeed, add_feeds
from server.worker.messages import Message, ProtocolError, encode_message, read_message

CONNECT_LIMIT_S = 8.0
CLOSE_LIMIT_S = 0.5
READ_BUFFER_BYTES = 1 << 20


async def push(start: Message, connection: socket.socket) -> None:
    """Until the server says `stop` or goes away, or the output fails, of which the server is told."""
    aiortc_hooks.install()      # not `ice`: a client asks STUN and TURN servers about itself, which the service's ICE does not
    connection.setblocking(False)
    reader, writer = await asyncio.open_unix_connection(sock=connection, limit=READ_BUFFER_BYTES)
    await _Push(start, reader, writer).run()


class _Push:
    def __init__(self, start: Message, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._url, self._token = str(start["url"]), start["token"]
        self._networks = start["networks"]
        self._sound = bool(start["sound"])
        self._reader, self._writer = reader, writer
        self._frames = self._bytes = 0
        self._session_url: str | None = None
        self._connection: RTCPeerConnection | None = None
        self._feeds: dict[str, PushedFeed] = {}

    async def run(self) -> None:
        """Whatever comes first: the server's end, the connection's end, an error."""
        steps = [asyncio.create_task(step) for step in (self._serve(), self._receive(), self._beat())]
        try:
            done, _ = await asyncio.wait(steps, return_when=asyncio.FIRST_COMPLETED)
            error = next((task.exception() for task in steps if task in done), None)
            if error is not None:
                failure = error if isinstance(error, OutputFailedError) else OutputFailedError(f"error inside: {error!r}")
                self._send(failed_message(failure))
        finally:
            for task in steps:
                task.cancel()
            await asyncio.gather(*steps, return_exceptions=True)
            self._report()
            await asyncio.gather(self._leave(), self._writer.drain(), return_exceptions=True)

    async def _serve(self) -> None:
        """Connect, and stay until the connection ends. Raises OutputFailedError."""
        ended = await self._connect(())
        self._send({"type": "ready"})
        self._send({"type": "live", "detail": None})
        await ended.wait()
        raise OutputFailedError("the WebRTC connection has ended")

    async def _connect(self, ice_servers: Sequence[RTCIceServer]) -> asyncio.Event:
        """Returns an event that is set when the connection ends.

        The endpoint names its ICE servers in its answer (RFC 9725), aiortc takes them before the offer: they are used in a second
        try, for those whom the first one did not connect.
        """
        connected, ended = asyncio.Event(), asyncio.Event()
        connection = RTCPeerConnection(RTCConfiguration(iceServers=list(ice_servers), bundlePolicy=RTCBundlePolicy.MAX_BUNDLE))
        self._connection = connection
        self._feeds = add_feeds(connection, self._request_keyframe, sound=self._sound)

        def state_changed() -> None:
            if connection.connectionState == "connected":
                connected.set()
            elif connection.connectionState in ("failed", "closed"):
                ended.set()

        connection.on("connectionstatechange", state_changed)
        await connection.setLocalDescription(await connection.createOffer())
        answer = await self._negotiate(str(connection.localDescription.sdp))
        try:
            await connection.setRemoteDescription(RTCSessionDescription(answer.sdp, "answer"))
        except (InvalidAccessError, InvalidStateError, OperationError, ValueError, KeyError, AttributeError, IndexError) as error:
            raise OutputFailedError(f"the WHIP endpoint's answer cannot be used: {error}", hopeless=True) from None
        await _first_of(connected, ended, limit_s=CONNECT_LIMIT_S)
        if connected.is_set():
            return ended
        if answer.ice_servers and not ice_servers:
            await self._leave()
            return await self._connect(answer.ice_servers)
        raise OutputFailedError("no WebRTC connection comes about: no ICE candidates reach each other")

    async def _negotiate(self, offer: str) -> Answer:
        url = self._url
        for _ in range(MAX_REDIRECTIONS + 1):
            await self._check(url)
            result = await asyncio.to_thread(post_offer, url, self._token, offer)
            if isinstance(result, Answer):
                self._session_url = result.session_url
                return result
            assert isinstance(result, Redirection)
            url = result.url
        raise OutputFailedError(f"the WHIP endpoint redirects more than {MAX_REDIRECTIONS} times", hopeless=True)

    async def _check(self, url: str) -> None:
        """Also where the endpoint redirects to: it must not lead the service into its own network."""
        if urlsplit(url).scheme not in ("http", "https"):
            raise OutputFailedError(f"the WHIP endpoint leads to the scheme {urlsplit(url).scheme!r}, expected http or https",
                                    hopeless=True)
        await check_network(url, self._networks)

    async def _leave(self) -> None:
        session_url, self._session_url = self._session_url, None
        connection, self._connection = self._connection, None
        if session_url is not None:
            with contextlib.suppress(OutputFailedError):
                await self._check(session_url)
                await asyncio.to_thread(delete_session, session_url, self._token)
        if connection is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_LIMIT_S):
                    await connection.close()

    async def _receive(self) -> None:
        """Until the server says `stop` or goes away."""
        try:
            while True:
                message, payload = await read_message(self._reader)
                if message["type"] == "stop":
                    return
                if message["type"] in ("picture", "sound"):
                    self._pass_on(message, payload)
        except (asyncio.IncompleteReadError, ConnectionError, ProtocolError):
            return

    def _pass_on(self, message: Message, payload: bytes) -> None:
        is_picture = message["type"] == "picture"
        feed = self._feeds.get(message["type"])
        if feed is None:
            return
        feed.push(EncodedFrame(payload, int(message["timestamp"]), keyframe=bool(message.get("keyframe", True)),
                               decoded_at=float(message.get("decoded_at", 0.0))))
        self._frames += is_picture
        self._bytes += len(payload)

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(PULSE_S)
            self._report()

    def _report(self) -> None:
        self._send({"type": "progress", "frames": self._frames, "bytes": self._bytes})

    def _request_keyframe(self) -> None:
        self._send({"type": "keyframe"})

    def _send(self, message: Message) -> None:
        self._writer.write(encode_message(message))


async def _first_of(*events: asyncio.Event, limit_s: float) -> None:
    waits = [asyncio.create_task(event.wait()) for event in events]
    await asyncio.wait(waits, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
    for wait in waits:
        wait.cancel()
