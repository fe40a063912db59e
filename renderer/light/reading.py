"""Reads the light of each frame from its radiance map, by the methods that the scene asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import solid_angles, uv_from_direction
from renderer.light.detection import MIN_ANGULAR_RADIUS, Detection, Light, find_candidates
from renderer.light.diffuse import diffuse_map
from renderer.light.fitting import Probe
from renderer.light.highlights import HighlightRestorer
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.irradiance import project
from renderer.light.radiance_map import RadianceMap
from renderer.light.refinement import Moments, refined
from renderer.light.specular import resample
from renderer.light.sun import NO_SKY, Sun, SunFinder, sun_in
from renderer.light.threshold_detection import SIGMAS, detect_by_threshold
from renderer.light.tracking import DEFAULT_STEP_S, LightNames, LightTracker
from renderer.scene import Lighting
from renderer.timings import Timings

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
SMALL_ROWS = 64             # of the residual for spherical harmonics and prefiltering, which use no more


@dataclass(frozen=True)
class FrameLight:
    """The light of one frame: lights and residual; the residual's (25, 3) spherical harmonics; the map that lights surfaces
    together with the lights that are not wide, small, and its irradiance by the direction of the normal; the detection's method;
    what share of each texel's luminance is in that map, for methods that go back to the frame itself (None: not asked for)."""

    detection: Detection
    coefficients: Array
    soft: NDArray[np.float32]
    irradiance: NDArray[np.float32]
    method: str = "default"
    kept: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class FrameAccess:
    """`upper_half`: of the frame, as the papers' detection wants it; `moments`: of pixels inside texels of the map (None: the map
    has the frame's own pixels)."""

    upper_half: Callable[[], NDArray[np.float32]]
    moments: Moments | None


class LightReader:
    """Reads one frame after another; keeps what the methods remember of earlier ones."""

    def __init__(self) -> None:
        self._tracker, self._probe, self._names = LightTracker(), Probe(), LightNames()
        self._highlights, self._sun = HighlightRestorer(), SunFinder()
        self._moment: float | None = None
        self._method = "default"

    def reset(self) -> None:
        """The next frame has nothing to do with the last one."""
        for part in (self._tracker, self._probe, self._highlights, self._sun):
            part.reset()
        self._moment = None

    def read(self, radiance_map: RadianceMap, frame: FrameAccess, lighting: Lighting, moment: float | None,
             timings: Timings) -> FrameLight:
        """`frame` gives what the methods want to see of the frame itself."""
        method = lighting.method("lights")
        if method != self._method:
            self.reset()
            self._method = method
        if method != "threshold":       # the papers' frames are taken as the operator leaves them
            with timings.stage("highlights"):
                radiance_map, sun = self._restored(radiance_map, lighting, moment)
        with timings.stage("lights"):
            if method == "threshold":
                detection = self._by_threshold(radiance_map, frame.upper_half(), lighting)
            elif method == "probe":
                detection = self._by_probe(radiance_map, lighting, sun)
            else:
                found = find_candidates(radiance_map, lighting.threshold, sun)
                detection = self._tracker.update(found if frame.moments is None else refined(found, frame.moments), moment)
        with timings.stage("irradiance"):
            soft = _small(detection.soft)
            coefficients = project(soft)
            irradiance = diffuse_map(lighting.method("diffuse"), soft, coefficients)
            if detection.soft is not detection.residual:
                coefficients = project(_small(detection.residual))
            kept = _kept(radiance_map, detection) if lighting.method("glossy") == "rings36" else None
            return FrameLight(detection, coefficients, soft, irradiance, method, kept)

    def _restored(self, radiance_map: RadianceMap, lighting: Lighting, moment: float | None) -> tuple[RadianceMap, Sun | None]:
        """The map with what the camera has clipped, and the sun if it is there; a given gain stands in for both estimates."""
        step = DEFAULT_STEP_S if moment is None or self._moment is None else max(moment - self._moment, 0.0)
        self._moment = moment
        sky = self._sun.look(radiance_map) if lighting.gain is None else NO_SKY
        restored = self._highlights.restore(radiance_map, step, sky.clear, lighting.gain)
        return restored, sun_in(sky, restored)

    def _by_threshold(self, radiance_map: RadianceMap, upper: NDArray[np.float32], lighting: Lighting) -> Detection:
        found = detect_by_threshold(upper, radiance_map.rgb, SIGMAS if lighting.threshold is None else lighting.threshold)
        return replace(found, lights=self._names.named(found.lights))

    def _by_probe(self, radiance_map: RadianceMap, lighting: Lighting, sun: Sun | None) -> Detection:
        def guess() -> Array:
            candidates = find_candidates(radiance_map, lighting.threshold, sun).candidates
            return np.array([item.light.direction for item in candidates]).reshape(-1, 3)

        count = lighting.light_count if isinstance(lighting.light_count, int) else None
        fit = self._probe.fit(_with_sun(radiance_map.rgb, sun), guess, count)
        lights = tuple(Light(direction, irradiance, MIN_ANGULAR_RADIUS) for direction, irradiance in
                       zip(fit.directions, fit.irradiances, strict=True))
        ordered = sorted(self._names.named(lights), key=lambda light: -float(light.irradiance @ WEIGHTS))
        # all that the model has besides its lights is an ambient term
        ambient = np.broadcast_to(fit.ambient, radiance_map.rgb.shape)
        return Detection(tuple(ordered), ambient, ambient, 0.0)


def _with_sun(radiance: Floats, sun: Sun | None) -> Floats:
    """The map with the sun in the texel where it stands."""
    if sun is None:
        return radiance
    height, width = radiance.shape[:2]
    u, v = uv_from_direction(sun.direction)
    row, column = min(int(v * height), height - 1), int(u * width) % width
    whole = radiance.copy()
    whole[row, column] += sun.irradiance / solid_angles(height, width)[row, 0]
    return whole


def _kept(radiance_map: RadianceMap, detection: Detection) -> NDArray[np.float32]:
    luminance = np.maximum(radiance_map.luminance, 1e-12)
    return np.asarray(np.clip(detection.soft @ WEIGHTS / luminance, 0.0, 1.0), dtype=np.float32)


def _small(radiance: Floats) -> NDArray[np.float32]:
    small = radiance.astype(np.float32, copy=False)
    return np.asarray(resample(small, SMALL_ROWS, 2 * SMALL_ROWS), dtype=np.float32) if small.shape[0] > SMALL_ROWS else small
