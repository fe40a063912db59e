"""The synthetic camera's loop as an H.264 file, encoded once and kept, so that publishing it is only remuxing."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from tqdm import tqdm

from server.demo.camera import DIM_NOISE_CODES, LOOP_SECONDS, NOISE_CODES, STILL_SECONDS, Camera, Planes

VERSION = 4     # raise it when the picture changes: the files of older versions are then not used any more
BITRATE_BPS, NOISY_BITRATE_BPS = 12e6, 20e6     # at 2048×1024 and 30 fps


def demo_clip(width: int, fps: int, still: bool = False, noisy: bool = False) -> Path:
    """Path of an MP4 of LOOP_SECONDS at width × width / 2, made on first use (about a minute at 2048).

    `still`: of STILL_SECONDS under a sun that does not move. `noisy`: so noisy that an encoder uses all of 10 Mbit/s at 2048×1024;
    of the usual clip it uses 4.

    Raises ValueError for a geometry that cannot be made, OSError when the cache folder cannot be written.
    """
    if not 1 <= fps <= 120:
        raise ValueError(f"fps is {fps}, expected 1 to 120")
    path = _cache_folder() / f"{'still' if still else 'demo'}{'-noisy' if noisy else ''}-{width}-{fps}-{VERSION}.mp4"
    if path.exists():
        return path
    camera = Camera(width, DIM_NOISE_CODES if noisy else NOISE_CODES)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        _encode(camera, fps, still, NOISY_BITRATE_BPS if noisy else BITRATE_BPS, partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "mr360"


def _encode(camera: Camera, fps: int, still: bool, bitrate_bps: float, path: Path) -> None:
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps, options={
            # fastdecode: the service decodes this on the cores that also render, 4 ms a frame in place of 13
            "preset": "veryfast", "tune": "fastdecode", "bf": "0", "g": str(fps), "sc_threshold": "0"})
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        stream.bit_rate = int(bitrate_bps * (camera.width / 2048) ** 2 * (fps / 30) ** 0.5)
        context = stream.codec_context
        context.thread_type = "FRAME"   # one slice a frame, as cameras do, and the next frame is drawn meanwhile
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        drawn, seconds = (camera.still_frames(fps), STILL_SECONDS) if still else (camera.frames(fps), LOOP_SECONDS)
        frames = tqdm(drawn, total=seconds * fps, desc="demo camera", unit="frame", disable=None)
        for index, planes in enumerate(frames):
            container.mux(stream.encode(_frame(planes, index, fps)))
        container.mux(stream.encode(None))


def _frame(planes: Planes, index: int, fps: int) -> av.VideoFrame:
    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, "yuv420p")
    for plane, pixels in zip(frame.planes, planes, strict=True):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)     # type: ignore[call-overload]
        rows[: pixels.shape[0], : pixels.shape[1]] = pixels
    frame.pts, frame.time_base = index, Fraction(1, fps)
    frame.colorspace, frame.color_range = Colorspace.ITU709, ColorRange.MPEG
    frame.color_primaries, frame.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    return frame
