"""Reads and writes stills: display-coded panoramas as 8-bit R'G'B', radiance maps as linear float."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from renderer.color import srgb_from_linear
from renderer.frame import RadianceFrame, RgbFrame

PANORAMA_SUFFIXES = {".png", ".jpg", ".jpeg"}
RADIANCE_SUFFIXES = {".exr", ".hdr"}
MAX_PIXELS = 16384 * 8192


class ImageError(ValueError):
    """A file that cannot be read or written; the message names it."""


def read_still(path: Path) -> RgbFrame | RadianceFrame:
    """`.png` and `.jpg` are panoramas, `.exr` and `.hdr` radiance maps. Raises ImageError."""
    if not path.is_file():
        raise ImageError(f"input {str(path)!r} does not exist")
    try:
        if path.suffix.lower() in PANORAMA_SUFFIXES:
            with Image.open(path) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise ImageError(f"input {path.name!r} is {image.width}x{image.height}, expected at most {MAX_PIXELS} pixels")
                return RgbFrame(np.asarray(image.convert("RGB")))
        return RadianceFrame(_read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path))
    except ImageError:
        raise
    except Exception as error:  # each library has its own idea of what a broken file raises
        raise ImageError(f"input {path.name!r} does not decode: {str(error).splitlines()[0] if str(error) else error!r}") from None


def _read_exr(path: Path) -> NDArray[np.float32]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
        if any(name not in channels for name in names):
            raise ImageError(f"input {path.name!r} has channels {', '.join(channels)}, expected R, G, B")
        return np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in names], axis=-1)


def _read_hdr(path: Path) -> NDArray[np.float32]:
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        return np.ascontiguousarray(frame.to_ndarray(), dtype=np.float32)


def write_still(path: Path, frame: RgbFrame | RadianceFrame) -> None:
    """A RadianceFrame to `.exr`: linear floats in channels R, G, B as they are, whatever they are; any other frame and suffix:
    8-bit display signal, for which NaN is black and infinity white. Raises ImageError when it cannot be written."""
    try:
        if path.suffix.lower() == ".exr" and isinstance(frame, RadianceFrame):
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"RGB": np.ascontiguousarray(frame.rgb, dtype=np.float32)}).write(str(path))
        elif isinstance(frame, RgbFrame):
            Image.fromarray(frame.rgb).save(path)
        else:
            signal = srgb_from_linear(np.clip(np.nan_to_num(frame.rgb), 0.0, 1.0))
            Image.fromarray(np.round(signal * 255).astype(np.uint8)).save(path)
    except OSError as error:
        raise ImageError(f"output {str(path)!r} cannot be written: {error.strerror or error}") from None
