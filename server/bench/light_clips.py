"""Lights followed over clips whose truth is known: where the sun was, and that nothing flickers that did not change."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame
from renderer.light.detection import Light
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.scene import Lighting
from server.bench.light_tables import PAPERS
from server.bench.pipelines import Pipelines
from server.worker.images import read_still
from server.worker.picture import PictureReader, output_size

Array = NDArray[np.float64]
SETTLED_S = 1.0     # births count after that
CONE = np.cos(np.radians(5.0))


def clip_table(pipelines: Pipelines, folder: Path | None) -> Iterator[str]:
    yield "clips: angle from the true main light to the nearest light found, degrees; after the first second, births and deaths,"
    yield "changes of ln power from frame to frame (std, %) and of direction (rms, degrees), of lights that are there all the time"
    yield f"{'clip':34}{'frames':>7}{'with light':>11}{'p50':>7}{'p95':>7}{'births':>8}{'deaths':>8}{'ln power':>10}{'turn':>7}"
    for path in sorted(folder.glob("*.gt.json")) if folder is not None else []:
        truth = json.loads(path.read_text())
        clip = path.with_name(path.name.removesuffix(".gt.json") + ".mp4")
        for name, lighting in ((clip.name, Lighting()), ("    by the papers' threshold", PAPERS)):
            frames = list(_lights(pipelines, clip, lighting))
            yield f"{name:34}{len(frames):7}" + _direction_columns(frames, truth, path.parent) + _stability_columns(frames)


def _lights(pipelines: Pipelines, clip: Path, lighting: Lighting) -> Iterator[tuple[float, tuple[Light, ...]]]:
    reader = pipeline = None
    with av.open(str(clip)) as container:
        for frame in container.decode(video=0):
            reader = reader or PictureReader(output_size(frame.width, frame.height))
            picture = reader.read(frame)
            pipeline = pipeline or pipelines.of(picture)
            moment = float(frame.time or 0.0)
            yield moment, pipeline.analyse(picture, moment, lighting)[0].detection.lights


def _direction_columns(frames: list[tuple[float, tuple[Light, ...]]], truth: dict[str, Any], folder: Path) -> str:
    source = next((place / truth["source"] for place in folder.parents if (place / truth["source"]).is_file()), None)
    still = None if source is None else read_still(source)
    if not isinstance(still, RadianceFrame):
        return f"{'-':>11}{'-':>7}{'-':>7}"
    main, angles = main_light(still.rgb), []
    for (_, lights), given in zip(frames, truth["per_frame"], strict=False):
        wanted = _turned(main, -given["camera_yaw_deg"])
        if lights:
            angles.append(min(float(np.degrees(np.arccos(np.clip(light.direction @ wanted, -1, 1)))) for light in lights))
    shown = [np.percentile(angles, 50), np.percentile(angles, 95)] if angles else [np.nan, np.nan]
    return f"{len(angles):11}{shown[0]:7.2f}{shown[1]:7.2f}"


def main_light(radiance: NDArray[np.float32]) -> Array:
    """Flux centroid of the cone of 5 degrees around the brightest pixel, the asset manifest's definition."""
    height, width = radiance.shape[:2]
    directions = pixel_directions(height, width)
    luminance = radiance @ WEIGHTS
    brightest = directions.reshape(-1, 3)[int(np.argmax(luminance))]
    flux = luminance * solid_angles(height, width) * (directions @ brightest > CONE)
    centre = (flux[..., None] * directions).sum(axis=(0, 1))
    return np.asarray(centre / np.linalg.norm(centre))


def _turned(direction: Array, azimuth_deg: float) -> Array:
    angle = np.radians(azimuth_deg)
    x, y, z = direction
    return np.array([x * np.cos(angle) - z * np.sin(angle), y, x * np.sin(angle) + z * np.cos(angle)])


def _stability_columns(frames: list[tuple[float, tuple[Light, ...]]]) -> str:
    settled = [{light.id: light for light in lights} for moment, lights in frames if moment >= SETTLED_S]
    pairs = list(itertools.pairwise(settled))
    births = sum(len(now.keys() - before.keys()) for before, now in pairs)
    deaths = sum(len(before.keys() - now.keys()) for before, now in pairs)
    always = set.intersection(*(set(lights) for lights in settled)) if settled else set()
    powers = [np.log([float(lights[one].irradiance @ WEIGHTS) for lights in settled]) for one in sorted(always)]
    turns = [np.degrees(np.arccos(np.clip(before[one].direction @ now[one].direction, -1, 1)))
             for one in always for before, now in pairs]
    power = f"{100 * max(float(np.diff(values).std()) for values in powers):10.2f}" if powers else f"{'-':>10}"
    turn = f"{float(np.sqrt(np.mean(np.square(turns)))):7.3f}" if turns else f"{'-':>7}"
    return f"{births:8}{deaths:8}{power}{turn}"
