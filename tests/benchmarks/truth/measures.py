"""Errors against the truth. The truth is traced twice, and squares are taken across both: noise then has no share in the mean."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import flip_evaluator
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from renderer.color import srgb_from_linear
from tests.benchmarks.truth.path_tracer import Traced

Array = NDArray[np.float64]
INSIDE = 0.995       # coverage from which on a pixel is the object's alone
SHADED = 0.98        # ratio below which a pixel is in the shadow


@dataclass(frozen=True)
class Error:
    """A root mean square and the standard error of it that the truth's noise leaves; NaN where nothing was to be compared."""

    value: float
    noise: float

    @staticmethod
    def between(ours: Array, first: Array, second: Array, scale: float = 1.0) -> Error:
        """Of (n, ...) values against two independent estimates of the truth."""
        if not ours.size or scale <= 0:
            return Error(float("nan"), float("nan"))
        product = (ours - first) * (ours - second)
        mean = float(product.mean())
        rms = float(np.sqrt(max(mean, 0.0)))
        # the products' own spread: of a mean of n that are independent from pixel to pixel
        spread = float(((first - second) ** 2).mean()) / 4 / np.sqrt(ours.size) + rms * float(
            np.sqrt(((first - second) ** 2).mean() / 4 / ours.size))
        return Error(rms / scale, float(np.sqrt(mean + spread) - rms) / scale if mean > 0 else float(np.sqrt(spread)) / scale)


@dataclass(frozen=True)
class Comparison:
    """One case: errors of each object by name, of the floor's shadow, of the silhouettes, and the perceived difference."""

    objects: dict[str, Error]
    bias: dict[str, float]
    shadow: Error
    shadow_bias: float
    coverage: float
    flip: float
    flip_of_noise: float


def compare(ours: Array, coverage: Array, panorama: Array, mask: NDArray[np.bool_], names: list[str], first: Traced,
            second: Traced) -> Comparison:
    """`ours` and `panorama` (height, width, 3) radiance, `coverage` (height, width) of ours; traced pixels are those of `mask`."""
    background = panorama[mask]
    truths = [traced.over(background) for traced in (first, second)]
    found, covered = ours[mask], (first.coverage + second.coverage) / 2
    objects, bias = {}, {}
    for index, name in enumerate(names):
        own = covered[:, index] > INSIDE
        mean = float((truths[0][own] + truths[1][own]).mean() / 2) if own.any() else 0.0
        objects[name] = Error.between(found[own], truths[0][own], truths[1][own], mean)
        bias[name] = float((found[own] - (truths[0][own] + truths[1][own]) / 2).mean() / mean) if own.any() and mean > 0 else 0.0
    shadow, shadow_bias = _shadow(found, background, mask, first, second)
    total = covered.sum(axis=1)
    edge = ((total > 0.02) & (total < 0.98)) | ((coverage[mask] > 0.02) & (coverage[mask] < 0.98))
    difference = float(np.abs(coverage[mask] - total)[edge].mean()) if edge.any() else 0.0
    images = [_image(panorama, mask, pixels) for pixels in (found, *truths, (truths[0] + truths[1]) / 2)]
    return Comparison(objects, bias, shadow, shadow_bias, difference, _flip(images[0], images[3], mask, panorama),
                      _flip(images[1], images[2], mask, panorama))


def _shadow(found: Array, background: Array, mask: NDArray[np.bool_], first: Traced, second: Traced) -> tuple[Error, float]:
    """Of the floor's ratio, where either picture has a shadow."""
    floor = (first.floor_share > INSIDE) & (second.floor_share > INSIDE) & (background.min(axis=1) > 1e-4)
    ratios = [traced.floor_ratio / np.maximum(traced.floor_share, 1e-6)[:, None] for traced in (first, second)]
    ours = found / np.maximum(background, 1e-9)
    smooth, weight = np.zeros(mask.shape), np.zeros(mask.shape)
    smooth[mask] = np.where(floor, (ratios[0] + ratios[1]).mean(axis=1) / 2, 0.0)
    weight[mask] = floor
    smooth = gaussian_filter(smooth, 1.5) / np.maximum(gaussian_filter(weight, 1.5), 1e-6)
    inside = floor & ((smooth[mask] < SHADED) | (ours.mean(axis=1) < SHADED))
    if not inside.any():
        return Error(float("nan"), float("nan")), 0.0
    first_half, second_half = ratios[0][inside], ratios[1][inside]
    return (Error.between(ours[inside], first_half, second_half),
            float((ours[inside] - (first_half + second_half) / 2).mean()))


def _image(panorama: Array, mask: NDArray[np.bool_], pixels: Array) -> Array:
    image = panorama.copy()
    image[mask] = pixels
    return image


def display(radiance: Array, panorama: Array) -> Array:
    """(height, width, 3) display signal, exposed for the panorama's median."""
    exposure = 0.25 / max(float(np.median(panorama @ [0.2126, 0.7152, 0.0722])), 1e-4)
    return np.asarray(srgb_from_linear(np.clip(radiance * exposure, 0.0, 1.0)))


def _flip(ours: Array, truth: Array, mask: NDArray[np.bool_], panorama: Array) -> float:
    """Mean LDR-FLIP over the pixels of `mask`, at 67 pixels a degree as the tool has it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found, _, _ = flip_evaluator.evaluate(display(truth, panorama).astype("f4"), display(ours, panorama).astype("f4"), "LDR",
                                              applyMagma=False)
    return float(np.asarray(found).squeeze()[mask].mean())
