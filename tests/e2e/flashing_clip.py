"""A panorama video whose picture turns white and whose sound beeps when a second begins, and where that is found in a copy."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FPS = 1024, 512, 15
RATE, BLOCK = 48_000, 1024
SECONDS = 20
FLASH_S = 0.2
TOLERANCE_S = 0.045


def write_flashing_clip(path: Path) -> Path:
    with av.open(str(path), "w") as output:
        video: Any = output.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "g": str(FPS)})
        video.width, video.height, video.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        sound: Any = output.add_stream("aac", rate=RATE, layout="stereo")
        first = 0
        for number in range(SECONDS * FPS):
            planes = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
            planes[:HEIGHT] = 235 if _on(number / FPS) else 60
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            output.mux(video.encode(frame))
            while first < (number + 1) * RATE // FPS:       # side by side in the file as in time
                output.mux(sound.encode(_beep(first)))
                first += BLOCK
        output.mux([*video.encode(None), *sound.encode(None)])
    return path


def _on(seconds: float) -> bool:
    return seconds % 1.0 < FLASH_S - 1e-6


def _beep(first: int) -> av.AudioFrame:
    seconds = (first + np.arange(BLOCK)) / RATE
    tone = np.where(seconds % 1.0 < FLASH_S, 0.5 * np.sin(2 * np.pi * 1000 * seconds), 0.0).astype(np.float32)
    frame = av.AudioFrame.from_ndarray(np.stack([tone, tone]), format="fltp", layout="stereo")
    frame.sample_rate, frame.pts, frame.time_base = RATE, first, Fraction(1, RATE)
    return frame


def flashes(pictures: Iterable[tuple[float, float]]) -> list[float]:
    """When the picture turns white, of (seconds, mean luma)."""
    found, before = [], 255.0
    for seconds, luma in pictures:
        if luma > 150 > before:
            found.append(seconds)
        before = luma
    return found


def beeps(sound: Iterable[tuple[float, NDArray[np.float32]]]) -> list[float]:
    """When a beep begins, of (seconds, samples): what is loud after a fifth of a second of quiet."""
    loud = np.concatenate([seconds + np.flatnonzero(np.abs(samples) > 0.1) / RATE for seconds, samples in sound])
    return [float(begin) for begin in loud[1:][np.diff(loud) > 0.2]]


def check_in_sync(container: av.container.InputContainer, seconds: float, *, by_arrival: bool = False) -> None:
    """Decode so long, and hold each flash against its beep; `by_arrival`: the median of them, for a recorder whose time stamps are
    those at which packets reached it."""
    pictures: list[tuple[float, float]] = []
    sound: list[tuple[float, NDArray[np.float32]]] = []
    for frame in container.decode():
        assert frame.time is not None
        if isinstance(frame, av.VideoFrame):
            pictures.append((frame.time, float(frame.to_ndarray(format="gray").mean())))
            if pictures[-1][0] - pictures[0][0] > seconds:
                break
        elif isinstance(frame, av.AudioFrame):
            assert frame.format.is_planar
            assert frame.sample_rate == RATE
            sound.append((frame.time, frame.to_ndarray()[0]))
    seen, heard = flashes(pictures), beeps(sound)
    within = [flash for flash in seen if heard and heard[0] - 0.5 < flash < heard[-1] + 0.5]
    assert len(within) >= 2, f"flashes at {seen}, beeps at {heard}"
    differences = [min((beep - flash for beep in heard), key=abs) for flash in within]
    print("sound after picture, ms:", [round(1000 * difference, 1) for difference in differences])
    measured = [float(np.median(differences))] if by_arrival else differences
    assert max(map(abs, measured)) <= TOLERANCE_S, differences
