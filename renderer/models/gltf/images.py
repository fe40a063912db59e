"""A model's textures: decoded once each, and only if their size, which is read first, is within bounds."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from renderer.models.gltf.accessors import Buffers, data_uri
from renderer.models.gltf.document import GltfError, item, printable
from renderer.models.mesh import Texture, Wrap

MAX_TEXTURE_SIZE = 4096
MAX_TEXTURE_BYTES = 256 << 20       # of all textures of a model, decoded
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728


class Images:
    """The pictures of one document."""

    def __init__(self, document: Any, buffers: Buffers) -> None:
        self._document, self._buffers = document, buffers
        self._decoded: dict[int, Texture] = {}
        self._bytes = 0

    def texture(self, index: Any, part: str) -> Texture | None:
        """(height, width, 4) pixels; None for a texture whose only source is in an extension."""
        source = item(self._document.textures, index, "texture", part).source
        if source is None:
            return None
        image = item(self._document.images, source, "image", f"{part}: texture {index}")
        if source not in self._decoded:
            self._decoded[source] = self._image(image, f"image {source}")
        return self._decoded[source]

    def sampling(self, index: Any, part: str) -> tuple[tuple[Wrap, Wrap], bool]:
        """How a texture continues beyond its edges, and whether it is magnified without interpolation."""
        sampler = item(self._document.textures, index, "texture", part).sampler
        if sampler is None:
            return ("repeat", "repeat"), False
        found = item(self._document.samplers, sampler, "sampler", f"{part}: texture {index}")
        wraps = [10497 if wrap is None else wrap for wrap in (found.wrapS, found.wrapT)]
        if not all(wrap in _WRAPS for wrap in wraps):
            raise GltfError(f"sampler {sampler} wraps by {wraps[0]!r} and {wraps[1]!r}, expected "
                            f"{', '.join(map(str, _WRAPS))}")
        return (_WRAPS[wraps[0]], _WRAPS[wraps[1]]), found.magFilter == _NEAREST

    def _image(self, image: Any, part: str) -> Texture:
        data = self._buffers.view(image.bufferView, part)[0] if image.bufferView is not None else data_uri(image.uri or "", part)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self._pixels(data, part)
        except (GltfError, MemoryError):
            raise
        except UnidentifiedImageError:
            raise GltfError(f"{part} is not a PNG or JPEG") from None
        except Image.DecompressionBombError:
            raise GltfError(f"{part} has more pixels than can be decoded, expected at most {MAX_TEXTURE_SIZE} on a side") from None
        except Exception as error:  # Pillow raises whatever its decoding runs into
            raise GltfError(f"{part} cannot be decoded: {printable(str(error), 200)}") from None

    def _pixels(self, data: bytes | memoryview, part: str) -> Texture:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
            width, height = picture.size
            if max(width, height) > MAX_TEXTURE_SIZE:
                raise GltfError(f"{part} is {width}x{height}, expected at most {MAX_TEXTURE_SIZE} on a side")
            self._bytes += 4 * width * height
            if self._bytes > MAX_TEXTURE_BYTES:
                raise GltfError(f"{part} is {width}x{height}, with it the textures take {self._bytes} bytes, expected at most "
                                f"{MAX_TEXTURE_BYTES}")
            if picture.mode.startswith("I"):    # 16 bits, which Pillow would clip to 255
                grey = (np.asarray(picture) >> 8).astype(np.uint8)
                return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=2)
            return np.asarray(picture.convert("RGBA"))
