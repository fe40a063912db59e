"""How soon the light has to be read again: from how it has changed lately, by the error that would be made until then.

What a reading gives is written down in units of what can just be seen: a hundredth of the irradiance, and a pixel by which a
shadow's edge is shifted. A line through the last readings tells motion from noise, since noise does not grow with time: its
slope, less twice its standard error, is by how much the error grows in a second.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.irradiance import irradiance
from renderer.light.reading import FrameLight

Array = NDArray[np.float64]
VISIBLE = 0.01                  # of the irradiance, on any face of a cube: half of Weber's just noticeable difference
MIN_ANGLE, MAX_ANGLE = np.radians([0.1, 0.25])    # a shadow's edge is shifted by as much as its light: a pixel, within these
FULL_SHARE = 0.25               # of the light: the shadows of a weaker one are less distinct
LONGEST_S = 0.5                 # between two readings; without a reading no new light is found that the glance does not see
FIRST_READINGS = 8              # one after another before anything is known; shadows are then drawn finely
GROWTH, FIRST_S = 1.5, 0.04     # of the interval from one reading to the next, and what it grows from
MAX_READINGS, MAX_AGE_S = 12, 3.0   # that are remembered
SURPRISE = 2.0                  # off the line by so much of what is tolerated, and four times the noise: all begins anew
AXES = np.concatenate([np.eye(3), -np.eye(3)])


class _Reading(NamedTuple):
    """Irradiance of a cube's faces and power of each light, and the mean face's; directions, in units of what can be seen."""

    moment: float
    names: tuple[int, ...]
    irradiances: Array
    whole: float
    directions: Array


class LightNeed:
    """Learns from each reading. `width`: of the frame, in pixels."""

    def __init__(self, width: int) -> None:
        self._angle = float(np.clip(2 * np.pi / width, MIN_ANGLE, MAX_ANGLE))
        self._readings: deque[_Reading] = deque(maxlen=MAX_READINGS)
        self._in_a_row = 0      # readings since all began anew
        self._rate = 0.0
        self._most_s = 0.0
        self.ground_shares: tuple[float, ...] = ()      # of the ground's irradiance, of each light

    def reset(self) -> None:
        """What comes has nothing to do with what was, or may not have."""
        self._readings.clear()
        self._in_a_row, self._most_s = 0, 0.0       # the rate is the best guess that there is

    def learn(self, light: FrameLight, moment: float, tolerance: float = 1.0) -> None:
        """Take over the light of a frame shown at `moment` seconds. `tolerance`: of what the readings before did not predict."""
        reading = self._described(light, moment)
        if self._readings and (self._readings[-1].names != reading.names or self._readings[-1].moment >= moment):
            self.reset()
        if self._is_surprise(reading, SURPRISE * tolerance):
            before = self._readings[-1]
            self.reset()
            self._readings.append(before)
        self._readings.append(reading)
        while moment - self._readings[0].moment > MAX_AGE_S:
            self._readings.popleft()
        self._in_a_row += 1
        self._rate = self._growth()
        if self._in_a_row >= FIRST_READINGS:
            self._most_s = min(max(FIRST_S, GROWTH * self._most_s), LONGEST_S)

    @property
    def rate(self) -> float:
        """By how much of what can be seen the error of a light grows in a second."""
        return self._rate

    def interval_s(self, tolerance: float = 1.0) -> float:
        """From the last reading to the next, for an error of at most `tolerance` times what can be seen."""
        most_s = max(self._most_s, (tolerance - 1.0) * FIRST_S)     # where errors are tolerated, those of not knowing are too
        return min(tolerance / max(self._rate, 1e-9), most_s, LONGEST_S)

    def _described(self, light: FrameLight, moment: float) -> _Reading:
        lights = light.detection.lights
        faces = np.maximum(irradiance(light.coefficients, AXES), 0.0)
        faces = faces + sum((np.maximum(AXES @ item.direction, 0.0)[:, None] * item.irradiance for item in lights), np.zeros(3))
        whole = max(float((faces @ WEIGHTS).mean()), 1e-9)
        ground = max(float(faces[1] @ WEIGHTS), 1e-9)
        powers = [float(item.irradiance @ WEIGHTS) for item in lights]
        self.ground_shares = tuple(power * max(float(item.direction[1]), 0.0) / ground
                                   for power, item in zip(powers, lights, strict=True))
        weights = [min(1.0, power / (power + whole) / FULL_SHARE) / self._angle for power in powers]
        directions = [weight * item.direction for weight, item in zip(weights, lights, strict=True)]
        return _Reading(moment, tuple(item.id for item in lights), np.array([*faces.ravel(), *powers]), whole,
                        np.array(directions).ravel())

    def _is_surprise(self, reading: _Reading, least: float) -> bool:
        """Whether it lies off the line through those before."""
        if len(self._readings) < 3:
            return False
        fit = _Line(self._readings)
        off = np.abs(fit.values(reading) - fit.at(reading.moment))
        return bool((off > np.maximum(least, 4.0 * fit.noise)).any())

    def _growth(self) -> float:
        if len(self._readings) < 3:
            return self._rate
        fit = _Line(self._readings)
        return float(np.maximum(np.abs(fit.slope) - 2 * fit.error, 0.0).max())


class _Line:
    """Least squares through readings: slope a second, its standard error, and the noise of a reading; of each value."""

    def __init__(self, readings: deque[_Reading]) -> None:
        self._unit = max(VISIBLE * readings[-1].whole, 1e-9)
        moments, values = np.array([item.moment for item in readings]), np.array([self.values(item) for item in readings])
        self._centre, self._mean = float(moments.mean()), values.mean(axis=0)
        times = moments - self._centre
        spread = max(float(times @ times), 1e-9)
        self.slope = np.asarray(times @ (values - self._mean) / spread)
        left = values - self._mean - times[:, None] * self.slope
        self.noise = np.sqrt((left**2).sum(axis=0) / max(len(moments) - 2, 1))
        self.error = self.noise / np.sqrt(spread)

    def values(self, reading: _Reading) -> Array:
        """In units of what can be seen in the newest light."""
        return np.concatenate([reading.irradiances / self._unit, reading.directions])

    def at(self, moment: float) -> Array:
        return np.asarray(self._mean + (moment - self._centre) * self.slope)
