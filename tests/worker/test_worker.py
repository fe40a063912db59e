"""A real worker process on a real picture: how many frames an edit takes to be seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.worker.real_worker import RealWorker

WIDTH, HEIGHT = 512, 256
SCENE = {"objects": [{"id": "box", "mesh": "box", "position": [0, -0.6, -2], "scale": [2, 2, 2],
                      "material": {"base_color": [0.9, 0.05, 0.05], "metallic": 0, "roughness": 0.8}}]}


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[RealWorker]:
    picture = tmp_path / "grey.png"
    Image.new("RGB", (WIDTH, HEIGHT), (120, 120, 120)).save(picture)
    running = RealWorker(picture)
    yield running
    running.stop()


def test_an_edit_is_in_the_picture_within_three_frames(worker: RealWorker) -> None:
    """Placed, repainted and moved: counted from the newest frame that had been received when the edit was sent."""
    pictures = worker.pictures()
    centre, beside = (HEIGHT * 5 // 8, WIDTH // 2), (HEIGHT * 5 // 8, WIDTH * 3 // 4)
    placed, painted, moved = SCENE, {"objects": [{**SCENE["objects"][0]}]}, {"objects": [{**SCENE["objects"][0]}]}
    painted["objects"][0]["material"] = {"base_color": [0.05, 0.05, 0.9], "metallic": 0, "roughness": 0.8}
    moved["objects"][0]["position"] = [2, -0.6, 0]
    edits = [(placed, centre, 0), (painted, centre, 2), (moved, beside, 0)]
    for _ in range(10):
        newest, picture = next(pictures)
    for revision, (scene, where, channel) in enumerate(edits, start=1):
        assert not _dominates(picture[where], channel)
        worker.send({"type": "scene", "scene": scene, "revision": revision})
        seen_in, picture = next((number, picture) for number, picture in pictures if _dominates(picture[where], channel))
        assert seen_in - newest <= 3, f"edit {revision}: the first frame after {newest} that shows it is {seen_in}"
        for _ in range(5):
            newest, picture = next(pictures)


def test_the_scene_chooses_the_methods_while_it_runs(worker: RealWorker) -> None:
    methods = worker.light_methods()
    assert next(methods) == "default"
    for revision, method in enumerate(("threshold", "probe", "default"), start=1):
        lighting = {"lights": method, "diffuse": "map32x16", "glossy": "rings36"}
        worker.send({"type": "scene", "scene": {**SCENE, "lighting": lighting}, "revision": revision})
        assert method in (found for found, _ in zip(methods, range(30), strict=False))


def _dominates(color: np.ndarray[Any, np.dtype[np.uint8]], channel: int) -> bool:
    """Whether the pixel is mainly of that colour."""
    rest = np.delete(color.astype(int), channel)
    return bool(color[channel] > 1.3 * rest.max() + 10)
