"""`mr360 render` and `mr360 lights` as a user runs them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from tests.renderer.frames import sky_with_sun

OBJECT = {"id": "ball", "mesh": "sphere", "position": [0, -1.1, -3], "material": {"base_color": [0.8, 0.2, 0.2]}}


def mr360(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "server.cli", *map(str, arguments)], capture_output=True, text=True, timeout=120,
                          check=False)


@pytest.fixture
def radiance_map(tmp_path: Path) -> Path:
    path = tmp_path / "sky.exr"
    OpenEXR.File({}, {"RGB": sky_with_sun(60, 40).rgb}).write(str(path))
    return path


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"objects": [OBJECT]}))
    return path


def read_exr(path: Path) -> np.ndarray:
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[name].pixels for name in "RGB"], axis=-1)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_radiance_map_stays_linear_and_exact_where_untouched(tmp_path: Path, radiance_map: Path, scene_file: Path,
                                                               preset: str) -> None:
    done = mr360("render", radiance_map, "--output", tmp_path / "out.exr", "--scene", scene_file, "--report", tmp_path / "r.json",
                 "--preset", preset)
    assert (done.returncode, done.stderr) == (0, "")
    before, after = read_exr(radiance_map), read_exr(tmp_path / "out.exr")
    changed = (before != after).any(axis=2)
    assert 0.005 < changed.mean() < 0.2
    assert not changed[:100].any()
    assert after.max() == before.max()
    report = json.loads((tmp_path / "r.json").read_text())
    assert {"frames_in", "frames_out", "frames_dropped", "fps", "render_ms", "latency_ms", "stages_ms", "renderer", "cpu_seconds",
            "lights", "touched_fraction"} <= report.keys()
    assert set(report["render_ms"]) == {"p50", "p95", "max"}
    assert len(report["lights"]) == 1


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_panorama_becomes_a_panorama(tmp_path: Path, scene_file: Path, preset: str) -> None:
    Image.new("RGB", (512, 256), (120, 130, 140)).save(tmp_path / "in.png")
    done = mr360("render", tmp_path / "in.png", "--output", tmp_path / "out.png", "--scene", scene_file, "--preset", preset)
    assert (done.returncode, done.stderr) == (0, "")
    with Image.open(tmp_path / "out.png") as image:
        pixels = np.asarray(image)
    assert (pixels[:100] == [120, 130, 140]).all()
    assert (pixels != [120, 130, 140]).any()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_clip_becomes_a_spherical_clip(tmp_path: Path, scene_file: Path, preset: str) -> None:
    with av.open(str(tmp_path / "in.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 256, 128, "yuv420p"
        for _ in range(5):
            frame = av.VideoFrame.from_ndarray(np.full((128, 256, 3), 120, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    done = mr360("render", tmp_path / "in.mp4", "--output", tmp_path / "out.mp4", "--scene", scene_file, "--preset", preset)
    assert (done.returncode, done.stderr) == (0, "")
    with av.open(str(tmp_path / "out.mp4")) as container:
        frames = list(container.decode(video=0))
        assert [round(frame.time * 25) for frame in frames] == [0, 1, 2, 3, 4]
        assert (int(frames[0].color_range), frames[0].width) == (1, 256)
    assert b"<GSpherical:ProjectionType>equirectangular" in (tmp_path / "out.mp4").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"in.mp4", "out.mp4", "scene.json"}


def test_lights_are_printed_as_one_json_object(radiance_map: Path) -> None:
    done = mr360("lights", radiance_map)
    assert done.returncode == 0
    message = json.loads(done.stdout)
    assert len(message["sphericalHarmonicsCoefficients"]) == 27
    light = message["lights"][0]
    expected = [np.cos(np.radians(40)) * np.sin(np.radians(60)), np.sin(np.radians(40)),
                -np.cos(np.radians(40)) * np.cos(np.radians(60))]
    assert light["direction"] == pytest.approx(expected, abs=0.01)
    assert message["primaryLightDirection"] == light["direction"]
    assert message["ambient"] == pytest.approx([0.5] * 3, rel=0.05)


@pytest.mark.parametrize(("scene", "complaint"), [
    ("{", "is not JSON"), ('{"objects": [{"id": "a", "mesh": "dragon"}]}', "unknown mesh 'dragon'"),
    ('{"sun": 1}', "sun"), ('{"objects": [{"id": "a", "mesh": "box", "scale": [0, 1, 1]}]}', "scale is"),
    ('{"objects": [{"id": "a", "mesh": "box", "position": [NaN, 0, 0]}]}', "position"),
    ('{"objects": [{"id": "a", "mesh": "gone.glb", "position": [0, 0, -3]}]}', "does not exist"),
    ('{"lighting": {"preset": "papers"}}', "papers")])
def test_a_bad_scene_is_one_line_and_exit_2(tmp_path: Path, radiance_map: Path, scene: str, complaint: str) -> None:
    (tmp_path / "bad.json").write_text(scene)
    done = mr360("render", radiance_map, "--output", tmp_path / "out.png", "--scene", tmp_path / "bad.json")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert complaint in done.stderr
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("name", ["gone.png", "noise.exr", "noise.png", "noise.hdr", "noise.mp4"])
def test_a_bad_input_is_one_line_and_exit_2(tmp_path: Path, name: str) -> None:
    if name.startswith("noise"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
    output = tmp_path / ("out.mp4" if name.endswith("mp4") else "out.png")
    done = mr360("render", tmp_path / name, "--output", output)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not output.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) in ([], [name])


def test_without_gl_one_line_says_what_to_install(radiance_map: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    done = mr360("lights", radiance_map)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "install the packages libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri" in done.stderr


@pytest.mark.parametrize(("method", "arguments"), [("threshold", []), ("probe", []), ("probe", ["--count", "2"])])
def test_lights_by_the_papers_methods(radiance_map: Path, method: str, arguments: list[str]) -> None:
    done = mr360("lights", radiance_map, "--method", method, *arguments)
    assert done.returncode == 0, done.stderr
    message = json.loads(done.stdout)
    assert message["method"] == method
    assert message["lights"]
    assert len(message["lights"]) == 2 or not arguments
    assert message["primaryLightDirection"] == message["lights"][0]["direction"]


def test_a_count_is_for_the_probe(radiance_map: Path) -> None:
    done = mr360("lights", radiance_map, "--count", "3")
    assert done.returncode == 2
    assert "count 3 for method 'default', expected method probe" in done.stderr
