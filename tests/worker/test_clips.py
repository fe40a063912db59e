"""Clips through `mr360 render`: each frame's time, and video of more than 8 bits."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame

from renderer.pipeline import Pipeline
from server.cli import main
from server.worker import offline
from tests.models import one_triangle

SIZE = (256, 128)
TICK = Fraction(1, 1000)
BALL = {"id": "ball", "mesh": "sphere", "position": [0, -1.1, -3]}


def write_clip(path: Path, ticks: list[int], *, pix_fmt: str = "yuv420p", codec: str = "libx264", code: int = 126,
               color_range: int = 1) -> None:
    """Frames of one grey at these thousandths of a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, pix_fmt
        context = stream.codec_context
        context.time_base, context.color_range, context.colorspace = TICK, color_range, 1
        context.options = {"crf": "5", "bf": "0", "x265-params": "log-level=none:bframes=0"}
        for tick in ticks:
            frame = VideoFrame(*SIZE, pix_fmt)
            for index, plane in enumerate(frame.planes):
                dtype = "<u2" if pix_fmt.endswith("le") else np.uint8
                middle = 512 if pix_fmt.endswith("10le") else 128
                np.frombuffer(memoryview(plane), dtype)[:] = middle if index else code
            frame.colorspace, frame.color_range = 1, color_range
            frame.pts, frame.time_base = tick, TICK
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.fixture
def moments(monkeypatch: pytest.MonkeyPatch) -> list[float | None]:
    """What each frame is rendered at."""
    seen: list[float | None] = []

    class Watched(Pipeline):
        def render(self, *arguments: Any, moment: float | None = None, **values: Any) -> Any:
            seen.append(moment)
            return super().render(*arguments, moment=moment, **values)

    monkeypatch.setattr(offline, "Pipeline", Watched)
    return seen


def times(path: Path) -> list[float]:
    with av.open(str(path)) as container:
        return [float(frame.time) for frame in container.decode(video=0) if frame.time is not None]


@pytest.mark.parametrize("ticks", [[0, 40, 80, 120], [0, 15, 100, 400], [2000, 2040, 2120]],
                         ids=["steady", "irregular", "starting late"])
def test_each_frame_is_rendered_at_its_own_time(tmp_path: Path, moments: list[float | None], ticks: list[int]) -> None:
    """The stream's clock, by which animations run, not the time that rendering takes."""
    write_clip(tmp_path / "in.mkv", ticks)
    given = times(tmp_path / "in.mkv")
    assert np.diff(given) == pytest.approx(np.diff(ticks) / 1000, abs=1e-3)
    assert main(["render", str(tmp_path / "in.mkv"), "--output", str(tmp_path / "out.mp4")]) == 0
    assert moments == pytest.approx(given, abs=1e-6)
    assert times(tmp_path / "out.mp4") == pytest.approx([one - given[0] for one in given], abs=1e-3)


def test_an_animation_runs_on_the_clips_clock(tmp_path: Path) -> None:
    """A black triangle that goes half a metre to the right in a second, in frames 0, 0.5 and 1 s after the clip's time 0."""
    black = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "extensions": {"KHR_materials_unlit": {}}}
    model = one_triangle(black)
    model.clip(0, "translation", [0.0, 1.0], [[0, 0, 0], [1, 0, 0]], name="go")
    (tmp_path / "m.glb").write_bytes(model.bytes())
    (tmp_path / "scene.json").write_text(json.dumps({"ground": {"catcher": False}, "objects": [
        {"id": "walker", "mesh": "m.glb", "position": [0, 0, -2], "scale": [0.5, 0.5, 0.5],
         "animation": {"clip": "go", "loop": False}}]}))
    write_clip(tmp_path / "in.mkv", [0, 500, 1000], code=180)
    assert main(["render", str(tmp_path / "in.mkv"), "--output", str(tmp_path / "out.mp4"), "--scene",
                 str(tmp_path / "scene.json")]) == 0
    columns = []
    with av.open(str(tmp_path / "out.mp4")) as container:
        for frame in container.decode(video=0):
            luma = np.frombuffer(memoryview(frame.planes[0]), np.uint8).reshape(SIZE[1], -1)[:, :SIZE[0]]
            columns.append(np.nonzero(luma < 60)[1].min())      # its left edge
    expected = [SIZE[0] * (0.5 + np.arctan2(0.5 * across, 2.0) / (2 * np.pi)) for across in (0.0, 0.5, 1.0)]
    assert columns == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("color_range", [1, 2])
@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_a_clip_of_ten_bits_becomes_one_of_eight(tmp_path: Path, codec: str, color_range: int) -> None:
    """With the tags that it had, and a grey between two codes as a mixture of both."""
    write_clip(tmp_path / "in.mkv", [0, 40, 80], pix_fmt="yuv420p10le", codec=codec, code=602, color_range=color_range)
    (tmp_path / "scene.json").write_text(json.dumps({"objects": [BALL]}))
    assert main(["render", str(tmp_path / "in.mkv"), "--output", str(tmp_path / "out.mp4"), "--scene",
                 str(tmp_path / "scene.json")]) == 0
    with av.open(str(tmp_path / "out.mp4")) as container:
        frames = list(container.decode(video=0))
    assert len(frames) == 3
    assert (int(frames[0].colorspace), int(frames[0].color_range)) == (1, color_range)
    sky = np.frombuffer(memoryview(frames[0].planes[0]), np.uint8).reshape(SIZE[1], -1)[:48, :SIZE[0]]
    expected = 602 / 4 if color_range == 1 else 602 * 255 / 1023
    assert sky.mean() == pytest.approx(expected, abs=0.15)     # the encoder may smooth the mixture


def test_a_clip_that_cannot_be_read_as_pictures_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                                            monkeypatch: pytest.MonkeyPatch) -> None:
    """One line with the pixel format, exit status 2, and no file left behind."""
    write_clip(tmp_path / "in.mkv", [0, 40])
    strange = VideoFrame(*SIZE, "y210be")
    original = offline.PictureReader.read
    monkeypatch.setattr(offline.PictureReader, "read", lambda reader, _: original(reader, strange))
    assert main(["render", str(tmp_path / "in.mkv"), "--output", str(tmp_path / "out.mp4")]) == 2
    complaint = capsys.readouterr().err
    assert complaint.count("\n") == 1
    assert "pixel format 'y210be'" in complaint
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]
