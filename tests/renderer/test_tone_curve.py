from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from renderer.color import YuvFormat, srgb_from_linear
from renderer.light.inverse_tone_mapping import gain, linear_from_radiance, radiance_from_linear, sanitize


def test_the_operator_is_the_papers_on_linear_light() -> None:
    rgb = np.random.default_rng(6).uniform(0, 1, (50, 3))
    y = 0.3 * rgb[:, 0] + 0.59 * rgb[:, 1] + 0.11 * rgb[:, 2]
    assert radiance_from_linear(rgb) == pytest.approx(rgb * (10 * y**10 + 1.8)[:, None], rel=1e-12)
    assert gain(np.array(1.0)) == pytest.approx(11.8)


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_the_operator_is_invertible(rgb: list[float]) -> None:
    back = linear_from_radiance(radiance_from_linear(np.array(rgb)))
    assert np.abs(srgb_from_linear(back) - srgb_from_linear(np.array(rgb))).max() < 1e-3 / 4


@pytest.mark.parametrize(("value", "expected"), [(np.nan, 0), (-1, 0), (-np.inf, 0), (np.inf, 6e4), (1e30, 6e4), (1e-30, 1e-30)])
def test_nothing_that_is_not_light_enters(value: float, expected: float) -> None:
    assert sanitize(np.array(value)) == pytest.approx(expected)


@pytest.mark.parametrize("layout", [YuvFormat(m, f) for m in ("bt601", "bt709") for f in (False, True)])
def test_yuv_matrices_are_each_others_inverse_and_know_black_and_white(layout: YuvFormat) -> None:
    forward, backward = layout.yuv_from_rgb(), layout.rgb_from_yuv()
    white = forward @ np.array([1, 1, 1, 1.0]) * 255
    assert white == pytest.approx([255 if layout.full_range else 235, 128, 128], abs=0.51)
    assert forward @ np.array([0, 0, 0, 1.0]) * 255 == pytest.approx([0 if layout.full_range else 16, 128, 128], abs=1e-9)
    assert backward[:, :3] @ forward[:, :3] == pytest.approx(np.eye(3), abs=1e-12)
