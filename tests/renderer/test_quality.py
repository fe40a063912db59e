"""What each knob of the quality changes, and that the default changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.quality import FULL, Quality
from tests.renderer.frames import scene, sky_with_sun

SIZE = (512, 256)
STANDING = {"mesh": "box", "position": [0, -1.1, -2.5], "scale": [0.6, 1.0, 0.6]}
Render = Callable[[Quality, RadianceFrame], np.ndarray]


@pytest.fixture
def render(context: Context) -> Render:
    def rendered(quality: Quality, frame: RadianceFrame) -> np.ndarray:
        pipeline = Pipeline(context, RadianceFrame, SIZE)
        pipeline.quality = quality
        found = pipeline.render(frame, scene(STANDING)).frame
        pipeline.release()
        assert isinstance(found, RadianceFrame)
        return found.rgb

    return rendered


@pytest.mark.parametrize(("knob", "value"), [("shading_share", 0.0), ("lobe_share", -0.5), ("shadow_detail", 1.5),
                                             ("min_ground_share", float("nan"))])
def test_a_value_outside_is_refused_by_name(knob: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{knob} is .*, expected more than 0 and at most 1"):
        Quality(**{knob: value})


def test_coarser_shadows_are_nearly_the_same_shadows(render: Render) -> None:
    frame = sky_with_sun(60, 45, size=SIZE, radius_deg=4.0)
    full, coarse = render(FULL, frame), render(Quality(shadow_detail=0.5), frame)
    assert (render(FULL, frame) == full).all()
    touched = (full != frame.rgb).any(axis=2)
    error = np.abs(coarse - full).mean(axis=2)[touched].mean() / full[touched].mean()
    assert 0.0 < error < 0.01


def test_a_light_below_the_share_casts_no_shadow(render: Render) -> None:
    frame = sky_with_sun(60, 45, size=SIZE, sun=200.0, radius_deg=2.0)
    full, gone = render(FULL, frame), render(Quality(min_ground_share=0.5), frame)
    without = (gone / full)[160:].mean(axis=2)
    assert without.max() > 1.1, "the light's shadow is gone"
    assert without.min() > 0.99, "nothing else is"


def test_quality_returns_and_so_do_the_shadows(context: Context) -> None:
    """What was drawn coarsely does not stay, though neither light nor objects are others."""
    pipeline, frame = Pipeline(context, RadianceFrame, SIZE), sky_with_sun(60, 45, size=SIZE, radius_deg=4.0)
    shown = []
    for number in range(60):
        pipeline.quality = FULL if number > 5 else Quality(shadow_detail=0.5)
        light, _ = pipeline.analyse(frame, number / 30)
        pipeline.prepare(light)
        image = pipeline.render(frame, scene(STANDING), light=light, moment=number / 30).frame
        assert isinstance(image, RadianceFrame)
        shown.append(image.rgb)
    right = Pipeline(context, RadianceFrame, SIZE)
    wanted = right.render(frame, scene(STANDING)).frame
    assert isinstance(wanted, RadianceFrame)
    off = [float(np.abs(image - wanted.rgb).max()) for image in (shown[5], shown[-1])]
    assert off[1] < 0.2 * off[0]
    pipeline.release()
    right.release()
