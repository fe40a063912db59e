"""Scenes that stand in no textbook: the cases of `server/bench/hard_scenes.py`, and what a long event and a rough floor ask for."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.objects import surfaces
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from server.bench.hard_scenes import SIZE, scene_cases
from server.bench.pipelines import Pipelines
from tests.renderer.frames import sky_with_sun

CASES = scene_cases()


@pytest.mark.usefixtures("context")
@pytest.mark.parametrize("name", CASES)
def test_hard_scene(pipelines: Pipelines, name: str) -> None:
    CASES[name](pipelines)


def test_views_of_ever_other_sizes_do_not_pile_up(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long live event: things of all sizes come and go, a rough specular floor among them."""
    monkeypatch.setattr(surfaces, "MAX_IDLE_PIXELS", 50_000)       # a quarter of what comes together here
    pipeline = Pipeline(context, RadianceFrame, (1024, 512))
    frame = sky_with_sun(30, 50, size=(1024, 512))
    light, _ = pipeline.analyse(frame)
    random = np.random.default_rng(3)
    for _ in range(60):
        size = 10 ** random.uniform(-1.0, 0.5)
        item = {"id": "o", "mesh": "box", "position": [*random.uniform(-2, 2, 2), -2.5 - size], "scale": [size, size / 2, size]}
        document = {"objects": [item], "ground": {"specular": float(random.choice([0.0, 0.3])), "roughness": 0.9}}
        rendered = pipeline.render(frame, Scene.model_validate(document), light=light)
        assert isinstance(rendered.frame, RadianceFrame)
        assert np.isfinite(rendered.frame.rgb).all()
    targets = [target for group in pipeline._surfaces._targets.values() for target in group]
    assert sum(target.pixels for target in targets if target.view is None) <= 50_000
    pipeline.release()


def test_a_rough_floor_around_the_camera_has_views_that_fit_a_framebuffer(context: Context) -> None:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    document = {"camera_height": 1.0, "ground": {"specular": 0.3, "roughness": 0.75},
                "objects": [{"id": "o", "mesh": "box", "position": [0, 0.5, -1.5], "scale": [6, 0.2, 0.6]}]}
    pipeline.render(sky_with_sun(30, 50, size=SIZE), Scene.model_validate(document))
    assert pipeline.placement is not None
    views = pipeline.placement.mirrored
    pipeline.release()
    assert len(views) > 1       # too wide for one
    assert max(side for view in views for side in view.size) < 4 * SIZE[1]
