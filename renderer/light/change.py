"""When the light of a frame has changed so little that nobody could tell, so that nothing has to be lit anew."""

from __future__ import annotations

import numpy as np

from renderer.light.reading import FrameLight

VISIBLE = 0.004            # of the light: half a code of 8 bits or less, anywhere above black
VISIBLE_DIRECTION = np.radians(0.2)     # the same for a surface at right angles to a light's direction
BLOCK = 4                  # texels of the map of 128 x 64 a side, 11 degrees: what the glossiest prefiltered map resolves
VISIBLE_IN_BLOCK = 0.03    # of the mean radiance


def hardly_changed(before: FrameLight, now: FrameLight) -> bool:
    """Whether surfaces look the same in both lights."""
    if before is now:
        return True
    lights, others = before.detection.lights, now.detection.lights
    if (before.method, [light.id for light in lights]) != (now.method, [light.id for light in others]):
        return False
    if before.soft.shape != now.soft.shape or before.kept is not None or now.kept is not None:
        return False
    whole = float(before.irradiance.mean()) + sum(float(light.irradiance.mean()) for light in lights)
    changed = float(np.abs(now.irradiance - before.irradiance).max())
    for light, other in zip(lights, others, strict=True):
        changed += float(np.abs(light.irradiance - other.irradiance).max())
        moved = float(np.arccos(np.clip(light.direction @ other.direction, -1, 1)))
        grown = abs(light.angular_radius - other.angular_radius)
        if moved > VISIBLE_DIRECTION or grown > 0.05 * light.angular_radius:
            return False
    if changed > VISIBLE * whole:
        return False
    mean = float(before.soft.mean())
    return float(np.abs(_blocks(now) - _blocks(before)).max(initial=0.0)) <= VISIBLE_IN_BLOCK * mean


def _blocks(light: FrameLight) -> np.ndarray[tuple[int, ...], np.dtype[np.floating]]:
    rows, columns = (side // BLOCK for side in light.soft.shape[:2])
    cut = light.soft[:rows * BLOCK, :columns * BLOCK]
    return np.asarray(cut.reshape(rows, BLOCK, columns, BLOCK, 3).mean(axis=(1, 3)))
