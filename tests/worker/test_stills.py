"""What `mr360 render` keeps of a still's numbers, for each kind that goes in and comes out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from renderer.color import linear_from_srgb, srgb_from_linear
from renderer.equirectangular import uv_from_direction
from renderer.light.inverse_tone_mapping import linear_from_radiance, radiance_from_linear
from server.cli import main
from server.worker.images import read_still
from tests.renderer.frames import sky_with_sun

SIZE = (256, 128)
BALL = {"id": "ball", "mesh": "sphere", "position": [0, -1.1, -3], "material": {"base_color": [0.8, 0.2, 0.2]}}
UNTOUCHED = np.s_[:50]      # rows
ODD_VALUES = [np.nan, np.inf, -np.inf, -5.0, 7e4, 1e30, 1e-40, -0.0, 6.00001e4]


@pytest.fixture
def render(tmp_path: Path) -> Any:
    """Renders a file of the folder to another one with these objects; the exit status."""

    def run(source: str, output: str, *objects: dict[str, Any]) -> int:
        (tmp_path / "scene.json").write_text(json.dumps({"objects": list(objects)}))
        return main(["render", str(tmp_path / source), "--output", str(tmp_path / output), "--scene", str(tmp_path / "scene.json")])

    return run


def codes() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A gradient in which every code occurs, darker below."""
    pixels = np.zeros((*SIZE[::-1], 3), dtype=np.uint8)
    pixels[..., 0] = np.arange(256)
    pixels[..., 1] = np.arange(255, -1, -1)
    pixels[..., 2] = np.arange(128)[:, None]
    pixels[64:] //= 2
    return pixels


def write_exr(path: Path, pixels: np.ndarray[Any, Any], name: str = "RGB") -> None:
    OpenEXR.File({}, {name: np.ascontiguousarray(pixels)}).write(str(path))


def read_exr(path: Path) -> np.ndarray[Any, np.dtype[np.float32]]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.stack([np.asarray(file.channels()[name].pixels) for name in "RGB"], axis=-1)


def bits(values: np.ndarray[Any, np.dtype[np.float32]]) -> np.ndarray[Any, np.dtype[np.uint32]]:
    return np.ascontiguousarray(values).view(np.uint32)


def pixel_of(point: list[float]) -> tuple[int, int]:
    u, v = uv_from_direction(np.array(point)) * SIZE
    return int(v), int(u)


def test_a_panorama_becomes_radiance_that_has_not_been_codes(tmp_path: Path, render: Any) -> None:
    """Touched pixels lie between the codes, and above the display's white; all others are the inverse tone mapping of theirs."""
    Image.fromarray(codes()).save(tmp_path / "in.png")
    glowing = {**BALL, "id": "lamp", "position": [1.5, -1.0, -3], "material": {"base_color": [0, 0, 0], "emissive": [40, 30, 20]}}
    assert render("in.png", "out.exr", BALL, glowing) == 0
    assert render("in.png", "out.png", BALL, glowing) == 0
    found, before = read_exr(tmp_path / "out.exr"), radiance_from_linear(linear_from_srgb(codes() / 255.0)).astype(np.float32)
    assert found.dtype == np.float32
    assert (bits(found[UNTOUCHED]) == bits(before[UNTOUCHED])).all()
    lamp = found[pixel_of([1.5, -1.0, -3])]
    assert lamp == pytest.approx([40, 30, 20], rel=0.03)
    touched = (found != before).any(axis=2)
    assert 0.01 < touched.mean() < 0.3
    signal = srgb_from_linear(np.clip(linear_from_radiance(found[touched]), 0, 1)) * 255
    off_grid = np.abs(signal - np.round(signal))[(signal < 250).all(axis=1)]
    assert off_grid.mean() > 0.15, "a quarter, for values that know nothing of codes"
    with Image.open(tmp_path / "out.png") as image:
        displayed = np.asarray(image)
    assert np.abs(displayed[touched] - signal).max() <= 0.51
    assert (displayed[~touched] == codes()[~touched]).all()


def test_a_panorama_without_objects_becomes_its_radiance(tmp_path: Path, render: Any) -> None:
    Image.fromarray(codes()).save(tmp_path / "in.png")
    assert render("in.png", "out.exr") == 0
    expected = radiance_from_linear(linear_from_srgb(codes() / 255.0)).astype(np.float32)
    assert (bits(read_exr(tmp_path / "out.exr")) == bits(expected)).all()


def odd_sky() -> np.ndarray[Any, np.dtype[np.float32]]:
    pixels = sky_with_sun(60, 40, size=SIZE).rgb
    pixels[5, :len(ODD_VALUES), 0] = ODD_VALUES
    pixels[6, :len(ODD_VALUES)] = np.array(ODD_VALUES, dtype=np.float32)[:, None]
    return pixels


def test_a_radiance_map_keeps_every_bit_of_what_is_untouched(tmp_path: Path, render: Any) -> None:
    """Infinities, NaN, negatives and values beyond those that the renderer computes with as well."""
    before = odd_sky()
    write_exr(tmp_path / "in.exr", before)
    assert render("in.exr", "out.exr", BALL) == 0
    found = read_exr(tmp_path / "out.exr")
    assert (bits(found[UNTOUCHED]) == bits(before[UNTOUCHED])).all()
    assert (found[64:] != before[64:]).any()
    assert np.isfinite(found[64:]).all()


def test_what_is_touched_is_finite_whatever_lies_behind_it(tmp_path: Path, render: Any) -> None:
    before = sky_with_sun(60, 40, size=SIZE).rgb
    row, column = pixel_of([0.0, -1.59, -2.6])                 # the ground in front of the ball: in its shadow
    before[row - 2:row + 3, column - 2:column + 3] = [np.nan, np.inf, -3.0]
    write_exr(tmp_path / "in.exr", before)
    assert render("in.exr", "out.exr", BALL) == 0
    changed = read_exr(tmp_path / "out.exr")[row, column]
    assert np.isfinite(changed).all()
    assert changed[[0, 2]] == pytest.approx(0.0, abs=1e-6)
    assert 100 < changed[1] <= 4 * 6e4, "the largest radiance that is computed with, and what the ball adds to it"


def test_half_floats_become_the_same_floats(tmp_path: Path, render: Any) -> None:
    before = sky_with_sun(60, 40, size=SIZE).rgb.astype(np.float16)
    before[3, 3] = np.float16(1 / 3)
    write_exr(tmp_path / "in.exr", before)
    assert render("in.exr", "out.exr", BALL) == 0
    assert (bits(read_exr(tmp_path / "out.exr")[UNTOUCHED]) == bits(before.astype(np.float32)[UNTOUCHED])).all()


def write_hdr(path: Path, mantissas: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
    """(height, width, 4) r, g, b, exponent as a Radiance picture without run lengths."""
    height, width = mantissas.shape[:2]
    path.write_bytes(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + mantissas.tobytes())


def test_a_radiance_picture_keeps_its_floats(tmp_path: Path, render: Any) -> None:
    """By what the format says: (mantissa + 0 or 0.5) 2^(exponent - 136)."""
    mantissas = np.full((*SIZE[::-1], 4), 128, dtype=np.uint8)
    mantissas[:, :, 1] = np.arange(100, 228).astype(np.uint8)[:, None]
    mantissas[3, 3] = (255, 200, 130, 150)
    write_hdr(tmp_path / "in.hdr", mantissas)
    given = read_still(tmp_path / "in.hdr")
    step = 2.0 ** (mantissas[..., 3].astype(int) - 136)[..., None]
    assert (np.abs(given.rgb - mantissas[..., :3] * step) <= step).all()
    assert given.rgb[3, 3].max() > 4e6 / 2**8, "it is the radiance itself, not a display signal"
    assert render("in.hdr", "out.exr", BALL) == 0
    found = read_exr(tmp_path / "out.exr")
    assert (bits(found[UNTOUCHED]) == bits(given.rgb[UNTOUCHED])).all()
    assert (found != given.rgb).any()


def test_a_radiance_map_is_encoded_for_a_display(tmp_path: Path, render: Any) -> None:
    before = odd_sky()
    before[10] = np.linspace(0, 1, SIZE[0])[:, None]
    write_exr(tmp_path / "in.exr", before)
    assert render("in.exr", "out.png", BALL) == 0
    with Image.open(tmp_path / "out.png") as image:
        found = np.asarray(image)
    assert found.dtype == np.uint8
    assert (found[10] == np.round(255 * srgb_from_linear(before[10].astype(float)))).all()
    assert found[6, :len(ODD_VALUES), 0].tolist() == [0, 255, 0, 0, 255, 255, 0, 0, 255]
    assert (found[20, 20] == round(255 * float(srgb_from_linear(np.array(0.5))))).all()
