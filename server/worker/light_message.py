"""The light message of one frame, the same on the REST route, the WebSocket and the command line."""

from __future__ import annotations

from typing import Any

import numpy as np

from renderer.light.irradiance import basis
from renderer.light.reading import FrameLight

_BAND_0 = float(basis(np.array([0.0, 1.0, 0.0]))[0])


def light_message(light: FrameLight, *, stream: str, frame: int, pts: float | None, rtp_timestamp: int,
                  captured_at: float) -> dict[str, Any]:
    """JSON-ready. Directions point to the light; `irradiance` is on a plane facing it; `ambient` the residual's mean radiance."""
    lights = light.detection.lights
    primary = lights[0] if lights else None
    coefficients = light.coefficients[:9]
    return {
        "stream": stream, "frame": frame, "pts": None if pts is None else round(pts, 6), "rtp_timestamp": rtp_timestamp,
        "captured_at": round(captured_at, 6), "method": light.method, "threshold": _number(light.detection.threshold),
        "lights": [{"id": item.id, "direction": _numbers(item.direction), "irradiance": _numbers(item.irradiance),
                    "solid_angle": _number(item.solid_angle), "angular_radius": _number(item.angular_radius),
                    "gain": _number(item.gain)}
                   for item in lights],
        "ambient": _numbers(coefficients[0] * _BAND_0),
        "sphericalHarmonicsCoefficients": _numbers(coefficients.ravel()),
        "primaryLightDirection": _numbers(primary.direction) if primary else [0.0, 1.0, 0.0],
        "primaryLightIntensity": _numbers(primary.irradiance) if primary else [0.0, 0.0, 0.0],
    }


def _number(value: float) -> float:
    return float(f"{value:.7g}")


def _numbers(values: Any) -> list[float]:
    return [_number(float(value)) for value in values]
