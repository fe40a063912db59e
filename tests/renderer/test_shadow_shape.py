"""The ground's shadows against geometry: how wide a penumbra is, and where a shadow lies."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction

SIZE = (2048, 1024)
CAMERA_HEIGHT = 1.6
TEN_TO_NINETY = 0.687       # of a disc's width: between where a straight edge hides a tenth and nine tenths of it


def light_alone(azimuth_deg: float, elevation_deg: float, radius_deg: float) -> RadianceFrame:
    """A disc over a grey ground: what the ground's ratio says is the share of the disc that is seen."""
    directions = pixel_directions(SIZE[1], SIZE[0])
    radiance = np.where(directions[..., 1] < 0, 0.5, 0.0)
    # so bright that the ground's own light is nothing beside it
    radiance[directions @ direction(azimuth_deg, elevation_deg) > np.cos(np.radians(radius_deg))] = 3e4
    return RadianceFrame(np.repeat(radiance[..., None], 3, axis=2).astype(np.float32))


def shadow_ratio(context: Context, frame: RadianceFrame, **item: object) -> NDArray[np.float64]:
    scene = Scene.model_validate({"camera_height": CAMERA_HEIGHT, "objects": [
        {"id": "caster", "material": {"base_color": [0, 0, 0], "roughness": 1.0}, **item}]})
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    rendered = pipeline.render(frame, scene)
    pipeline.release()
    assert isinstance(rendered.frame, RadianceFrame)
    return np.asarray(rendered.frame.rgb[..., 1] / np.maximum(frame.rgb[..., 1], 1e-9), dtype=np.float64)


@pytest.mark.parametrize("radius_deg", [4.0, 7.0])     # a smaller one has a penumbra of two pixels
@pytest.mark.parametrize("elevation_deg", [45.0, 65.0])
def test_a_penumbra_is_as_wide_as_the_light_makes_it(context: Context, radius_deg: float, elevation_deg: float) -> None:
    height, middle = 1.0, -3.0
    # the light stands behind the camera, so the shadow lies ahead of the slab, its edges across the light's azimuth
    ratio = shadow_ratio(context, light_alone(180, elevation_deg, radius_deg), mesh="box",
                         position=[0, height - CAMERA_HEIGHT, middle], scale=[3.0, 0.001, 1.0])
    rows = np.arange(SIZE[1] // 2 + 60, SIZE[1] - 60)
    polar = (rows + 0.5) / SIZE[1] * np.pi
    distance = CAMERA_HEIGHT * np.tan(np.pi - polar)
    profile = ratio[rows, SIZE[0] // 2 - 3:SIZE[0] // 2 + 3].mean(axis=1)
    zenith, radius = np.radians(90 - elevation_deg), np.radians(radius_deg)
    expected = height * np.sin(2 * radius) / (np.cos(zenith + radius) * np.cos(zenith - radius))
    far_edge = -middle + 0.5 + height * np.tan(zenith)
    near_far = (distance > far_edge - expected) & (distance < far_edge + expected)
    order = np.argsort(distance[near_far])
    crossings = np.interp([0.1, 0.5, 0.9], profile[near_far][order], distance[near_far][order])
    assert crossings[2] - crossings[0] == pytest.approx(TEN_TO_NINETY * expected, rel=0.05)
    assert crossings[1] == pytest.approx(far_edge, abs=0.02)


@pytest.mark.parametrize("azimuth_deg", [30.0, 110.0, 200.0, 290.0])
def test_a_shadow_lies_where_the_light_throws_it(context: Context, azimuth_deg: float) -> None:
    centre, elevation_deg = np.array([0.4, -0.8, -2.6]), 60.0
    frame = light_alone(azimuth_deg, elevation_deg, 1.0)
    ratio = shadow_ratio(context, frame, mesh="sphere", position=list(centre), scale=[0.5, 0.5, 0.5])
    towards = direction(azimuth_deg, elevation_deg)
    directions = pixel_directions(SIZE[1], SIZE[0])
    ground = directions * (-CAMERA_HEIGHT / np.minimum(directions[..., 1], -1e-6))[..., None]
    # exact: the share of the disc's directions whose ray from the ground meets the sphere; here of its middle, the disc is small
    offset = ground - centre
    along = offset @ -towards
    hidden = np.linalg.norm(offset + along[..., None] * towards, axis=-1) < 0.25
    seen = (directions[..., 1] < -0.05) & (np.linalg.norm(np.cross(directions, centre), axis=-1) > 0.27)
    rows, columns = np.indices(ratio.shape)
    found, expected = ((np.array([(weights * rows).sum(), (weights * columns).sum()]) / weights.sum())
                       for weights in (np.where(seen, np.clip(1 - ratio, 0, 1), 0), np.where(seen, hidden, 0.0)))
    assert found == pytest.approx(expected, abs=0.5)
