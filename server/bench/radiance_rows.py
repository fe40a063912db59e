"""The radiance map: inverse tone mapping and reduction of a camera's frame, against the same in float64, pixel by pixel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from renderer.frame import YuvFrame
from renderer.light.inverse_tone_mapping import radiance_from_linear
from renderer.light.radiance_map import RadianceMapStage, Way, cells_of_texel, map_size, packed_pixels
from renderer.light.ring_sampling import RingSource
from renderer.light.specular import resample
from renderer.panorama import PanoramaTextures
from server.bench.effort import Effort
from server.bench.frames import linear_from_yuv, yuv_from_linear
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative, timed
from server.bench.worlds import worlds

Array = NDArray[np.float64]
STAGE = "radiance map"
MEASURE = ("texels of the map of a camera's frame, less the mean by solid angle of its tone mapped pixels in float64; in units "
           "of the map's rms. The papers' map is the whole frame as half floats with mip levels, compared where a level is as "
           "large")
VARIANTS: tuple[tuple[str, Mark, Way | None, bool, int], ...] = (
    ("", "default", None, True, 1), ("half the size", "", None, True, 2), ("fragment shader", "", Way.FRAGMENT, True, 1),
    ("compute shader", "", Way.COMPUTE, True, 1), ("fragment shader, exact decoding", "", Way.FRAGMENT, False, 1))


def radiance_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    for world in worlds(effort.size, effort.worlds):
        frame = yuv_from_linear(world.shown)
        exact = radiance_from_linear(linear_from_yuv(frame))
        for params, mark, way, packed, divisor in VARIANTS:
            if way is Way.COMPUTE and not cells_of_texel(frame.size, map_size(frame.size), packed_pixels(YuvFrame, frame.size))[0]:
                continue
            yield _reduced(pipelines, frame, exact, world.name, effort, params, mark, way, packed, divisor)
        yield _papers(pipelines, frame, exact, world.name, effort)
        expected = resample(exact, *map_size(frame.size)[::-1])
        constant = np.broadcast_to(exact.mean(axis=(0, 1)), expected.shape)
        yield Row(STAGE, "constant", world.name, relative(constant, expected), mark="null")


def _reduced(pipelines: Pipelines, frame: YuvFrame, exact: Array, scene: str, effort: Effort, params: str, mark: Mark,
             way: Way | None, packed: bool, divisor: int) -> Row:
    """Our fused reduction; OpenGL without `packed` planes decodes each pixel with roots, as exactly as mirrors do."""
    context = pipelines.context
    panorama = PanoramaTextures(context, YuvFrame, frame.size, packed_pixels(YuvFrame, frame.size) if packed else 0)
    width, height = map_size(frame.size)
    stage = RadianceMapStage(context, panorama, (width // divisor, height // divisor), way)

    def work() -> NDArray[np.floating]:
        panorama.show(frame)
        return stage.run().rgb

    times, found = timed(work, effort.per_world), work()
    stage.release()
    panorama.release()
    return Row(STAGE, "fused", scene, relative(found, resample(exact, height // divisor, width // divisor)), times,
               f"{width // divisor}x{height // divisor} {params}".strip(), mark)


def _papers(pipelines: Pipelines, frame: YuvFrame, exact: Array, scene: str, effort: Effort) -> Row:
    context = pipelines.context
    panorama = PanoramaTextures(context, YuvFrame, frame.size)
    width, height = map_size(frame.size)
    source = RingSource(context, panorama, (width, height))
    kept = np.ones((height, width), np.float32)

    def work() -> None:
        panorama.show(frame)
        source.fill(kept, 0.0)
        context.gl.finish()

    times = timed(work, effort.per_world)
    level = int(np.log2(frame.size[0] / width))
    found = np.frombuffer(source.texture.read(level=level), np.float16).reshape(height, width, 4)[..., :3].astype(np.float64)
    source.release()
    panorama.release()
    return Row(STAGE, "full HDR + mips", scene, relative(found, resample(exact, height, width)), times,
               f"{frame.size[0]}x{frame.size[1]}", "paper")


