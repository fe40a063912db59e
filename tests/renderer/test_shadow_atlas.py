"""Which shadows share a map, and where maps lie in their atlas."""

from __future__ import annotations

import numpy as np

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.shadows.shadow_atlas import Blocks, sharing, union
from tests.renderer.frames import scene, sky_with_sun


def test_shadows_in_the_same_tiles_share_a_map_and_others_do_not() -> None:
    columns = {"a": [0, 1], "b": [6], "c": [2, 3], "d": [1, 2]}
    tiles = {name: np.isin(np.arange(8), found)[None] for name, found in columns.items()}
    assert [set(names) for names in sharing(tiles)] == [{"b"}, {"a", "c", "d"}]
    assert union([(0.0, 0.0, 1.0, 1.0), (0.5, -1.0, 0.7, 0.5)]) == (0.0, -1.0, 1.0, 1.0)


def test_a_group_does_not_grow_without_end() -> None:
    tiles = {f"{i}": np.isin(np.arange(21), [i, i + 1])[None] for i in range(20)}
    groups = sharing(tiles, 6)
    assert sorted(name for names in groups for name in names) == sorted(tiles)
    assert max(map(len, groups)) <= 6


def test_places_in_an_atlas_never_overlap() -> None:
    random, blocks, taken = np.random.default_rng(1), Blocks(512), []
    for _ in range(300):
        if taken and random.random() < 0.45:
            blocks.give_back(taken.pop(random.integers(len(taken))))
        place = blocks.take(int(random.integers(1, 200)))
        if place is not None:
            taken.append(place)
        used = np.zeros((512, 512), dtype=int)
        for one in taken:
            x, y, width, height = blocks.viewport(one)
            assert x + width <= 512
            assert y + height <= 512
            used[y:y + height, x:x + width] += 1
        assert used.max() <= 1
    assert blocks.cell(taken[0], 64)[2] == 64 / 512


def test_every_one_of_many_shadows_is_seen(context: Context) -> None:
    """A tile takes so many maps and no more: objects that came last would have no shadow there, in squares."""
    size = (1024, 512)
    suns = [sky_with_sun(70 * index, 52, size=size, sun=600.0, radius_deg=3.0).rgb for index in range(5)]
    frame = RadianceFrame(np.maximum.reduce(suns))
    balls = [{"mesh": "sphere", "position": [x, -1.3, z], "scale": [0.4, 0.4, 0.4], "material": {"base_color": [0.5] * 3}}
             for x in (-0.5, 0.0, 0.5) for z in (-2.2, -2.7)]
    pictures = []
    for order in (balls, balls[::-1]):
        pipeline = Pipeline(context, RadianceFrame, size)
        rendered = pipeline.render(frame, scene(*order))
        assert isinstance(rendered.frame, RadianceFrame)
        assert len(rendered.light.detection.lights) == 5
        pictures.append(rendered.frame.rgb[..., 1] / frame.rgb[..., 1])
        pipeline.release()
    directions = pixel_directions(size[1], size[0])
    floor = np.logical_and.reduce([np.linalg.norm(np.cross(directions, ball["position"]), axis=-1) > 0.22 for ball in balls])
    floor[:size[1] // 2] = False
    assert (pictures[0] < 0.9)[floor].sum() > 1500
    assert np.abs(pictures[0] - pictures[1])[floor].max() < 0.03
