"""A viewer without a screen: joins a stream over WHEP, receives every frame and decodes the keyframes.

`python -m server.demo.viewer WHEP_URL` runs until SIGINT or SIGTERM and writes one JSON object a line on stdout:
`{"state", "frames", "keyframes", "width", "height", "timestamp", "time"}`, with `state` the peer connection's, `frames` whole
ones received so far, `keyframes` those decoded, `timestamp` the newest frame's RTP time since the first one (90 kHz) and
`time` the monotonic clock in seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
import time
import urllib.error
import urllib.request
from typing import Any
from urllib.parse import urljoin

import av
from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCPeerConnection,
    RTCRtpReceiver,
    RTCSessionDescription,
)
from aiortc.mediastreams import MediaStreamError

from server.delivery.aiortc_hooks import decode_with
from server.demo.keyframe_decoder import KeyframeDecoder

REQUEST_LIMIT_S = 10.0
REPORT_EVERY_S = 0.5


class ViewerError(RuntimeError):
    """The session could not be made; the text says why."""


class Viewer:
    """One WHEP session. What decodes is the process's affair: `decode_with`."""

    def __init__(self, url: str) -> None:
        self.keyframes = 0
        self.size = (0, 0)
        self._url = url
        self._session_url: str | None = None
        self._receiving: asyncio.Task[None] | None = None
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))

    @property
    def state(self) -> str:
        return str(self._peer.connectionState)

    @property
    def peer(self) -> RTCPeerConnection:
        return self._peer

    async def start(self) -> None:
        """Make the session. Raises ViewerError."""
        transceiver = self._peer.addTransceiver("video", direction="recvonly")
        known = RTCRtpReceiver.getCapabilities("video")
        codecs = known.codecs if known else []
        transceiver.setCodecPreferences([codec for codec in codecs if codec.mimeType in ("video/H264", "video/rtx")])
        self._peer.on("track", self._on_track)
        await self._peer.setLocalDescription(await self._peer.createOffer())
        answer, location = await asyncio.to_thread(_post_offer, self._url, self._peer.localDescription.sdp)
        self._session_url = urljoin(self._url, location)
        await self._peer.setRemoteDescription(RTCSessionDescription(answer, "answer"))

    async def stop(self) -> None:
        if self._session_url is not None:
            await asyncio.to_thread(_delete, self._session_url)
        await self._peer.close()
        if self._receiving is not None:
            self._receiving.cancel()
            await asyncio.gather(self._receiving, return_exceptions=True)

    def check(self) -> None:
        """Raises ViewerError when nothing can come any more, or whatever broke the receiving."""
        if self._receiving is not None and self._receiving.done():
            self._receiving.result()
            raise ViewerError("the stream has ended")
        if self.state in ("failed", "closed"):
            raise ViewerError(f"the connection is {self.state}")

    def _on_track(self, track: MediaStreamTrack) -> None:
        self._receiving = asyncio.create_task(self._receive(track))

    async def _receive(self, track: MediaStreamTrack) -> None:
        with contextlib.suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                assert isinstance(frame, av.VideoFrame)
                self.keyframes += 1
                self.size = (frame.width, frame.height)


def _post_offer(url: str, offer: str) -> tuple[str, str]:
    request = urllib.request.Request(url, offer.encode(), {"Content-Type": "application/sdp"}, method="POST")
    try:
        with urllib.request.urlopen(request, timeout=REQUEST_LIMIT_S) as answer:
            return answer.read().decode(), answer.headers["Location"]
    except urllib.error.HTTPError as error:
        with error:
            text = error.read(2000).decode(errors="replace")
        raise ViewerError(f"{url} answered {error.code}, expected 201: {text}") from None
    except OSError as error:
        raise ViewerError(f"{url} cannot be reached: {error}") from None


def _delete(session_url: str) -> None:
    with contextlib.suppress(OSError):      # the service may already be gone
        urllib.request.urlopen(urllib.request.Request(session_url, method="DELETE"), timeout=1).close()


async def watch(url: str) -> None:
    """View `url` and report on stdout until a signal comes. Raises ViewerError."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    decoder = KeyframeDecoder()
    decode_with(lambda _codec: decoder)
    viewer = Viewer(url)
    try:
        await viewer.start()
        while not stop.is_set():
            print(json.dumps(_progress(viewer, decoder)), flush=True)
            viewer.check()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), REPORT_EVERY_S)
    finally:
        await viewer.stop()


def _progress(viewer: Viewer, decoder: KeyframeDecoder) -> dict[str, Any]:
    return {"state": viewer.state, "frames": decoder.units, "keyframes": viewer.keyframes, "width": viewer.size[0],
            "height": viewer.size[1], "timestamp": decoder.timestamp, "time": time.monotonic()}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.demo.viewer", description="a WHEP viewer without a screen")
    parser.add_argument("url", help="http://HOST:PORT/whep/STREAM")
    try:
        asyncio.run(watch(parser.parse_args().url))
    except ViewerError as error:
        print(f"viewer: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
