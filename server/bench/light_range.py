"""How much of the true light is left after a camera has clipped it: LDR frames made from radiance maps, against the maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb, srgb_from_linear
from renderer.frame import RgbFrame
from renderer.light.inverse_tone_mapping import OFFSET, SLOPE, WEIGHTS, radiance_from_linear
from server.bench.light_reference import light_irradiance, random_normals, reference_irradiance
from server.bench.light_tables import Maps, rms
from server.bench.pipelines import Pipelines

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
MIDDLE_GREY = 0.2       # linear; where the exposure puts the frame's median luminance
BT709 = np.array([0.2126, 0.7152, 0.0722])
# the maps whose main light can be scored by its direction, after the asset manifest
WITH_A_LIGHT = ("blender_sunrise", "o3d_brightday", "blender_city", "blender_interior", "blender_studio", "o3d_nightlights")


def camera_frame(radiance: Array32) -> RgbFrame:
    """What a camera would have shown of a map: exposed for the median, sRGB, clipped at white, 8 bits."""
    exposure = MIDDLE_GREY / max(float(np.median(radiance @ BT709)), 1e-9)
    return RgbFrame(np.round(255 * srgb_from_linear(np.clip(radiance * exposure, 0.0, 1.0))).astype(np.uint8))


def papers_on_display(signal: Array) -> Array:
    """Iorns & Rhee eq. 1 to 3 on the display signal, as it is printed."""
    return np.asarray(signal * (SLOPE * (signal @ WEIGHTS) ** 10 + OFFSET)[..., None])


def papers_on_linear(signal: Array) -> Array:
    """The same with all of it on linear light: what the renderer does."""
    return radiance_from_linear(linear_from_srgb(signal))


def papers_on_both(signal: Array) -> Array:
    """Linear colour, k from the display signal of its luminance."""
    linear = linear_from_srgb(signal)
    return np.asarray(linear * (SLOPE * srgb_from_linear(linear @ WEIGHTS) ** 10 + OFFSET)[..., None])


READINGS: dict[str, Callable[[Array], Array]] = {
    "display": papers_on_display, "linear": papers_on_linear,
    "mixed": papers_on_both, "none": linear_from_srgb}


def dynamic_range_table(pipelines: Pipelines, maps: Maps) -> Iterator[str]:
    """Irradiance from the LDR frame against that of the map, each scaled to fit best: a camera's exposure is not known."""
    yield "irradiance of an LDR frame against the true map, rms %: ours; the papers' operator on the display signal; on linear"
    yield "light; on linear light with k from the display signal; no operator. Clipped: of the sphere"
    yield f"{'map':26}{'clipped':>9}{'ours':>7}" + "".join(f"{name:>9}" for name in READINGS)
    normals, errors, scorable = random_normals(), [], []
    for name, radiance in maps:
        if name.endswith(".hdr"):
            continue    # the same captures again
        expected, frame = reference_irradiance(radiance, normals), camera_frame(radiance)
        signal = frame.rgb / 255.0
        row = [_scaled_error(light_irradiance(pipelines.light(frame), normals), expected)]
        row += [_scaled_error(reference_irradiance(operator(signal).astype(np.float32), normals), expected)
                for operator in READINGS.values()]
        errors.append(row)
        if name.split(".")[0] in WITH_A_LIGHT:
            scorable.append(row)
        yield f"{name:26}{100 * _clipped_share(frame):8.1f}%{100 * row[0]:7.1f}" + "".join(f"{100 * e:9.1f}" for e in row[1:])
    for label, rows in (("median of all", errors), ("median of those with a light to score", scorable)):
        if rows:
            middle = 100 * np.median(rows, axis=0)
            yield f"{label:35}{middle[0]:7.1f}" + "".join(f"{value:9.1f}" for value in middle[1:])


def _scaled_error(found: Array, expected: Array) -> float:
    scale = float((found * expected).sum() / max(float((found**2).sum()), 1e-300))
    return rms(scale * found - expected) / rms(expected)


def _clipped_share(frame: RgbFrame) -> float:
    height = frame.rgb.shape[0]
    weights = np.sin((np.arange(height) + 0.5) / height * np.pi)
    return float(weights @ (frame.rgb.min(axis=2) == 255).mean(axis=1) / weights.sum())
