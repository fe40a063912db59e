"""The references of `mr360 bench` against what is known without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from renderer.equirectangular import solid_angles
from renderer.gl import Context
from renderer.light.detection import Light
from renderer.light.discs import disc_directions
from renderer.light.irradiance import disc_cosine
from server.bench.ball_reference import Ball, BallReference, Environment
from server.bench.ball_shadow import hidden_share, hidden_sky
from server.bench.composite_rows import EXPOSURES, composite_rows
from server.bench.effort import QUICK
from server.bench.frames import direction, linear_from_yuv, yuv_from_linear
from server.bench.light_rows import exact_irradiance, ring_cosine
from server.bench.pipelines import Pipelines
from server.bench.whole_scene import BALLS, CAMERA_HEIGHT, REGIONS, looked_at
from server.bench.worlds import disc_coverage, lamp, worlds

CENTRE, RADIUS = np.array([0.2, -1.0, -2.4]), 0.35
ALONE = Ball("ball", CENTRE, RADIUS, np.ones(3), 1.0, 0.5)
BLACK = Ball("black", CENTRE, RADIUS, np.zeros(3), 1.0, 0.5)


def around(light: Light, count: int) -> np.ndarray:
    """Points of the ground where a light throws the ball's shadow."""
    random = np.random.default_rng(0)
    foot = CENTRE - light.direction * ((CENTRE[1] + CAMERA_HEIGHT) / light.direction[1])
    across = np.cross(light.direction, (0, 1, 0)) / np.linalg.norm(np.cross(light.direction, (0, 1, 0)))
    penumbra = np.tan(light.angular_radius) / light.direction[1]
    at_edge = foot + across * (RADIUS + penumbra * random.uniform(-1, 1, (count // 2, 1)))
    return np.concatenate([foot + random.uniform(-0.8, 0.8, (count // 2, 3)) * [1, 0, 1], at_edge])


@pytest.mark.parametrize(("elevation", "radius"), [(28, 7.0), (60, 3.0), (45, 0.3)])
def test_what_a_ball_hides_of_a_disc(elevation: float, radius: float) -> None:
    """Against 100,000 rays a point."""
    light = Light(direction(150, elevation), np.ones(3), float(np.radians(radius)))
    points, rays = around(light, 60), disc_directions(light.direction, light.angular_radius, 100_000)
    offset = points - CENTRE
    along = offset @ rays.T
    hits = (along < 0) & (along**2 > ((offset**2).sum(axis=1) - RADIUS**2)[:, None])
    expected = (hits * rays[:, 1]).sum(axis=1) / rays[:, 1].sum()
    found = hidden_share(points, CENTRE, RADIUS, light)
    assert found == pytest.approx(expected, abs=3e-4)
    assert ((expected > 0.05) & (expected < 0.95)).any()


@pytest.mark.parametrize("radius", [0.3, 4.0, 20.0])
def test_irradiance_of_a_disc_at_any_height(radius: float) -> None:
    angle = float(np.radians(radius))
    cosine = np.cos(np.linspace(0, np.pi, 50))
    above = np.abs(cosine) > np.sin(angle)
    assert ring_cosine(cosine[above], angle) == pytest.approx(disc_cosine(cosine[above], angle), abs=1e-9)
    rays = disc_directions(np.array([0.0, 0.0, 1.0]), angle, 200_000)
    facing = np.stack([np.sqrt(1 - cosine**2), np.zeros(50), cosine], axis=1)
    mean = np.maximum(facing @ rays.T, 0.0).mean(axis=1) / rays[:, 2].mean()
    assert ring_cosine(cosine, angle) == pytest.approx(mean, abs=2e-5)


def test_a_white_ball_in_constant_light_is_not_seen() -> None:
    """Furnace: what it hides of the ground's light it gives back."""
    sky = np.full((64, 128, 3), 2.0)
    reference = BallReference(Environment(sky, (), sky), (ALONE,), CAMERA_HEIGHT, 64)
    normals = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    points = CENTRE + RADIUS * normals
    seen = reference.radiance(ALONE, points, -points / np.linalg.norm(points, axis=1, keepdims=True))
    assert seen == pytest.approx(np.full((4, 3), 2.0), rel=0.01)
    ground = np.array([[0.2, -CAMERA_HEIGHT, -2.4 + shift] for shift in (0.0, 0.3, 0.8)])
    assert reference.ground(ground) == pytest.approx(np.ones((3, 3)), rel=0.01)


def test_a_black_ball_takes_what_the_closed_forms_say() -> None:
    sky = np.full((64, 128, 3), 1.0)
    light = lamp(150, 50, 3.0, 2.0)
    points = around(light, 40)
    overcast = BallReference(Environment(sky, (), sky), (BLACK,), CAMERA_HEIGHT, 64).ground(points)
    assert 1 - overcast[:, 0] == pytest.approx(hidden_sky(points, CENTRE, RADIUS), abs=4e-3)
    lit = BallReference(Environment(1e-9 * sky, (light,), sky), (BLACK,), CAMERA_HEIGHT, 32).ground(points)
    assert 1 - lit[:, 0] == pytest.approx(hidden_share(points, CENTRE, RADIUS, light), abs=1e-6)


def test_the_worlds_have_the_light_they_say() -> None:
    for world in worlds((512, 256)):
        angles = solid_angles(256, 512)
        for light in world.lights:
            covered = disc_coverage(light, (512, 256))
            assert float((covered * angles).sum()) == pytest.approx(light.solid_angle)
            assert covered.max() < 1.15     # the samples' share of a small disc is not exact, its power is
        extra = ((world.radiance - world.sky) * angles[..., None]).sum(axis=(0, 1))
        given = sum((light.irradiance / (np.pi * np.sin(light.angular_radius) ** 2) * light.solid_angle for light in world.lights),
                    np.zeros(3))
        assert extra == pytest.approx(given, rel=1e-4, abs=1e-5)
        assert exact_irradiance(world, np.array([[0.0, 1.0, 0.0]])).min() > 0


def test_pixels_lie_where_they_are_said_to() -> None:
    pixels = looked_at((1024, 512), 40)
    for ball in BALLS:
        assert np.linalg.norm(pixels.points[ball.name] - ball.centre, axis=1) == pytest.approx(np.full(40, ball.radius))
    assert pixels.points["ground"][:, 1] == pytest.approx(np.full(40, -CAMERA_HEIGHT))
    assert len(np.unique(np.concatenate([pixels.indices[region] for region in REGIONS]))) == 120


def test_a_cameras_codes_are_what_it_shows() -> None:
    linear = np.random.default_rng(2).uniform(0.1, 0.9, (1, 64, 1)).repeat(8, axis=0) * np.ones(3)
    assert linear_from_yuv(yuv_from_linear(linear)) == pytest.approx(linear, abs=0.012)


def test_a_shadow_on_a_bright_ground_is_as_dark_as_on_a_dark_one() -> None:
    """The ratio is one of the camera's linear light: exact whatever the exposure. Behind the tone curve it took too little."""
    context = Context()
    pipelines = Pipelines(context)
    effort = replace(QUICK, size=(512, 256), repeats=1)
    errors = {(row.method, row.condition): float(np.sqrt((row.errors**2).mean())) for row in composite_rows(pipelines, effort)}
    pipelines.release()
    context.release()
    for exposure in EXPOSURES:
        assert errors["ratio", f"exposure {exposure}"] < 0.01
        assert errors["additive", f"exposure {exposure}"] > 0.1
