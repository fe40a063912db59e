from __future__ import annotations

import json
from pathlib import Path

import moderngl
import numpy as np
import pytest

from renderer.equirectangular import direction_from_uv, pixel_directions, solid_angles, uv_from_direction
from renderer.gl import Context, load_shader

PAIRS = json.loads((Path(__file__).parents[1] / "data" / "directions.json").read_text())["pairs"]
DIRECTIONS = np.array([pair["direction"] for pair in PAIRS])
UVS = np.array([pair["uv"] for pair in PAIRS])


@pytest.mark.parametrize("size", [(1, 2), (5, 7), (128, 256), (961, 1922)])
def test_solid_angles_sum_to_the_sphere(size: tuple[int, int]) -> None:
    total = np.broadcast_to(solid_angles(*size), size).sum()
    assert total == pytest.approx(4 * np.pi, rel=1e-12)


def test_numpy_agrees_with_the_shared_directions() -> None:
    assert np.abs(uv_from_direction(DIRECTIONS) - UVS).max() < 1e-7
    assert np.abs(direction_from_uv(UVS) - DIRECTIONS).max() < 1e-7


def test_glsl_agrees_with_the_shared_directions(context: Context) -> None:
    count = len(PAIRS)
    body = load_shader("equirectangular.glsl").text
    program = context.gl.program(
        vertex_shader=body + """
            in vec3 direction; in vec2 uv; out vec2 found_uv; out vec3 found_direction;
            void main() { found_uv = uv_from_direction(direction); found_direction = direction_from_uv(uv); }""",
        varyings=["found_uv", "found_direction"])
    data = np.concatenate([DIRECTIONS, UVS], axis=1).astype("f4")
    output = context.gl.buffer(reserve=count * 20)
    context.gl.simple_framebuffer((4, 4)).use()  # even a transform needs a complete one
    context.gl.vertex_array(program, [(context.gl.buffer(data.tobytes()), "3f 2f", "direction", "uv")]).transform(
        output, moderngl.POINTS)
    found = np.frombuffer(output.read(), "f4").reshape(count, 5)
    assert np.abs(found[:, :2] - UVS).max() < 2e-6
    assert np.abs(found[:, 2:] - DIRECTIONS).max() < 1e-5


def test_axes_are_those_of_webxr() -> None:
    assert uv_from_direction(np.array([0, 0, -1.0])) == pytest.approx([0.5, 0.5])
    assert uv_from_direction(np.array([1.0, 0, 0])) == pytest.approx([0.75, 0.5])
    assert uv_from_direction(np.array([0, 1.0, 0]))[1] == pytest.approx(0.0)
    assert pixel_directions(2, 4)[0, 2, 1] > 0
