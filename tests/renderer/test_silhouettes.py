"""Silhouettes against rays: what share of each pixel an object covers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.models.gltf import transform
from renderer.pipeline import Pipeline
from renderer.scene import Scene

SIZE = (256, 128)
FINER = 16
GLOW = {"base_color": [0, 0, 0], "metallic": 0, "roughness": 1, "emissive": [1, 1, 1]}


def covered_by_box(position: tuple[float, float, float], rotation: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """(height, width) share of every pixel, by 16 x 16 rays through a box of edge 1."""
    return shares(rays_through_box(position, rotation))


def shares(hit: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.asarray(hit.reshape(SIZE[1], FINER, SIZE[0], FINER).mean(axis=(1, 3)))


def rays_through_box(position: tuple[float, float, float], rotation: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    inverse = np.linalg.inv(transform(position, rotation, (1, 1, 1)))
    directions = pixel_directions(SIZE[1] * FINER, SIZE[0] * FINER) @ inverse[:3, :3].T
    with np.errstate(divide="ignore"):
        one, other = (((side - inverse[:3, 3]) / directions) for side in (-0.5, 0.5))
    enters, leaves = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return np.asarray((enters < leaves) & (leaves > 0))


@pytest.mark.parametrize("position", [(0.0, 0.0, -3.0), (-2.0, 0.8, 1.5), (0.1, -0.2, 3.0)], ids=["upright edges", "above", "seam"])
@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0, 1.0), (0.18257, 0.36515, 0.54772, 0.7303)], ids=["upright", "turned"])
def test_the_share_of_a_pixel_that_a_box_covers(context: Context, position: tuple[float, float, float],
                                                rotation: tuple[float, float, float, float]) -> None:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    scene = Scene.model_validate({"ground": {"catcher": False}, "objects": [
        {"id": "box", "mesh": "box", "position": position, "rotation": rotation, "material": GLOW}]})
    frame = pipeline.render(RadianceFrame(np.zeros((SIZE[1], SIZE[0], 3), dtype=np.float32)), scene).frame
    found, truth = np.asarray(frame.rgb[..., 0], dtype=np.float64), covered_by_box(position, rotation)
    edge = ((truth > 0.02) & (truth < 0.98)) | ((found > 0.02) & (found < 0.98))
    assert edge.sum() > 30
    assert np.abs(found - truth)[edge].mean() < 0.035
    assert np.abs(found - truth)[~edge].max() < 0.02
    assert (found - truth)[edge].mean() == pytest.approx(0.0, abs=0.02)
    pipeline.release()


@pytest.mark.parametrize("mesh", ["box", "teapot"])     # convex, and one whose vertices are not all open
def test_what_an_occluder_leaves_of_an_object(context: Context, mesh: str) -> None:
    here, there, turned = (0.0, 0.0, -4.0), (0.6, 0.1, -2.4), (0.18257, 0.36515, 0.54772, 0.7303)
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    black = RadianceFrame(np.zeros((SIZE[1], SIZE[0], 3), dtype=np.float32))
    item = {"id": "box", "mesh": "box", "position": here, "scale": [2, 2, 1], "material": GLOW}
    thing = {"id": "real", "mesh": mesh, "position": there, "rotation": turned}

    def drawn(**values: object) -> NDArray[np.float64]:
        frame = pipeline.render(black, Scene.model_validate({"ground": {"catcher": False}, **values})).frame
        return np.asarray(frame.rgb[..., 0], dtype=np.float64)      # type: ignore[union-attr]

    whole, left = drawn(objects=[item]), drawn(objects=[item], local_scene=[{**thing, "role": "occluder"}])
    alone = drawn(objects=[{**thing, "material": GLOW}])
    pipeline.release()
    inside = whole > 0.999      # there the edge is the occluder's alone
    expected = 1 - alone[inside]
    edge = (expected > 0.02) & (expected < 0.98)
    assert edge.sum() > 10
    assert np.abs(left[inside] - expected)[edge].mean() < 0.03
    assert np.abs(left[inside] - expected)[~edge].max() < 0.03
