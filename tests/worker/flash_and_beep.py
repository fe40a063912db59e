"""A clip whose picture flashes white for one frame exactly when a beep begins, once a second; and what finds both again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeAlias

import av
import numpy as np

FPS, WIDTH, HEIGHT = 30, 256, 128
FIRST_S, BEEP_S = 0.5, 0.1
CHUNK = 1024
Packet: TypeAlias = "av.Packet[Any]"


def write_clip(path: Path, *, seconds: float = 3, codec: str = "aac", rate: int = 44100, layout: str = "stereo",
               sound_s: float | None = None, damage: Callable[[int, Packet], Packet | None] = lambda index, packet: packet) -> Path:
    """`sound_s`: how long the sound is, if not as the picture. `damage` gets each packet of sound, with its number, and gives what
    goes into the file in its place."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "tune": "zerolatency", "g": str(FPS)})
        video.width, video.height, video.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        audio = container.add_stream(codec, rate=rate, layout=layout)
        sound, given, written = _beeps(sound_s or seconds, rate), 0, 0
        for index in range(round(seconds * FPS)):
            container.mux(video.encode(_picture(index)))
            while given < min(len(sound), (index + 1) * rate // FPS):
                packets = audio.encode(_piece(sound[given:given + CHUNK], given, rate, layout))
                given += CHUNK
                for packet in packets:
                    kept = damage(written, packet)
                    written += 1
                    if kept is not None:
                        container.mux(kept)
        container.mux(video.encode(None))
        container.mux(audio.encode(None))
    return path


def _beeps(seconds: float, rate: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    since = (np.arange(round(seconds * rate)) / rate - FIRST_S) % 1.0
    return (0.5 * np.sin(2 * np.pi * 1000 * since) * (since < BEEP_S)).astype(np.float32)


def _picture(index: int) -> av.VideoFrame:
    planes = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
    planes[:HEIGHT] = 235 if (index - round(FIRST_S * FPS)) % FPS == 0 else 40
    frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
    frame.pts, frame.time_base = index, Fraction(1, FPS)
    return frame


def _piece(samples: np.ndarray[Any, np.dtype[np.float32]], start: int, rate: int, layout: str) -> av.AudioFrame:
    channels = 1 if layout == "mono" else 2
    frame = av.AudioFrame.from_ndarray(np.stack([samples] * channels), format="fltp", layout=layout)
    frame.sample_rate, frame.pts, frame.time_base = rate, start, Fraction(1, rate)
    return frame


class Receiver:
    """Decodes both tracks. `flashes` and `beeps` are their beginnings, in seconds by time stamps."""

    def __init__(self) -> None:
        self._video = av.CodecContext.create("h264", "r")
        self._audio = av.CodecContext.create("libopus", "r")
        self.flashes: list[float] = []
        self.beeps: list[float] = []
        self.sound_ticks: list[int] = []
        self.picture_ticks: list[int] = []
        self._bright = False
        self._loud_until = -1.0

    def take(self, message: dict[str, Any], payload: bytes) -> None:
        if message["type"] == "packet" and message["track"] == "full/h264":
            self._see(message["timestamp"], payload, is_keyframe=message["keyframe"])
        elif message["type"] == "packet" and message["track"] == "audio/opus":
            assert message["keyframe"] is True
            self._hear(message["timestamp"], payload)

    def skews_ms(self) -> list[float]:
        """Of each flash but the last from the nearest beep; positive where the sound is late."""
        return [1e3 * min((beep - flash for beep in self.beeps), key=abs) for flash in self.flashes[:-1]]

    def _see(self, timestamp: int, payload: bytes, *, is_keyframe: bool) -> None:
        if not self.picture_ticks and not is_keyframe:
            return
        self.picture_ticks.append(timestamp)
        for frame in self._video.decode(av.Packet(payload)):
            bright = bool(frame.to_ndarray()[:HEIGHT].mean() > 140)
            if bright and not self._bright:
                self.flashes.append(timestamp / 90_000)
            self._bright = bright

    def _hear(self, timestamp: int, payload: bytes) -> None:
        self.sound_ticks.append(timestamp)
        for frame in self._audio.decode(av.Packet(payload)):
            samples = frame.to_ndarray().reshape(-1, 2)[:, 0].astype(float)
            loud = np.flatnonzero(np.abs(samples) > 0.1 * (32768 if np.abs(samples).max() > 2 else 1))
            if len(loud):
                begin, end = ((timestamp + int(place)) / 48_000 for place in (loud[0], loud[-1]))
                if begin > self._loud_until + 0.3:
                    self.beeps.append(begin)
                self._loud_until = end


def receive(messages: Iterable[tuple[dict[str, Any], bytes]], flashes: int) -> Receiver:
    """Until so many flashes have come."""
    receiver = Receiver()
    for message, payload in messages:
        receiver.take(message, payload)
        if len(receiver.flashes) == flashes:
            break
    return receiver
