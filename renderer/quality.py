"""How much accuracy the renderer gives, where less can be had for less time. The defaults are what it gives when there is time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quality:
    """Shares, each above 0 and at most 1. Another quality acts from the next light on; what is drawn already stays.

    `shading_share`: of all pixels that objects cover, those to be shaded ahead of one live frame when the light has changed; the
    others are shown in an older light. `lobe_share`: of the prefiltered maps in use, those that are made anew with each light.
    `shadow_detail`: texels a side of the lights' shadow maps and samples of a light's disc, times this. `min_ground_share`: of the
    ground's irradiance; a weaker light casts no shadow on it.

    Raises ValueError for a value outside.
    """

    shading_share: float = 0.4
    lobe_share: float = 0.5
    shadow_detail: float = 1.0
    min_ground_share: float = 0.02

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value <= 1.0:
                raise ValueError(f"{name} is {value:g}, expected more than 0 and at most 1")


FULL = Quality()
