"""What objects stand close to, against form factors; that the shader says the same; what is worked out anew when one moves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Light
from renderer.models.gltf import transform
from renderer.models.mesh import BUILT_IN
from renderer.models.shapes import Solid, fitted_shape, hit
from renderer.objects import surroundings
from renderer.objects.near_field import (
    FUNCTIONS,
    GROUND_RAYS,
    LIGHT_RAYS,
    POINTS,
    Body,
    Fit,
    NearField,
    _GroundPatch,
    form_factor,
    functions,
    surface_points,
)
from renderer.pipeline import Pipeline
from tests.renderer.frames import scene, sky_with_sun

ROWS = 32
GROUND = -1.6
FLAT = np.ones((ROWS, 2 * ROWS, 3), dtype=np.float32)
FLAT_IRRADIANCE = np.full((16, 32, 3), np.pi, dtype=np.float32)
Vector = tuple[float, float, float]


def body(mesh: str, position: Vector, scale: Vector = (1, 1, 1), albedo: float = 0.0) -> Body:
    built, model = BUILT_IN[mesh](), transform(position, (0, 0, 0, 1), scale)
    shape = fitted_shape(built)
    points, normals = surface_points(built)
    turned = normals @ np.linalg.inv(model[:3, :3])
    return Body(Solid.placed(shape, model), points @ model[:3, :3].T + model[:3, 3],
                turned / np.linalg.norm(turned, axis=1, keepdims=True), shape.is_convex, np.full(3, albedo))


def fitted(it: Body, others: list[Body], ground_y: float | None, radiance: np.ndarray = FLAT) -> Fit:
    return NearField(it, others, ground_y, ROWS).fit(radiance, FLAT_IRRADIANCE, ())


def ratio_at(fit: Fit, points: Any, normals: Any, ground_y: float = -1e9) -> np.ndarray:
    """(n,) of the red channel."""
    return functions(np.atleast_2d(np.array(points, float)), np.atleast_2d(np.array(normals, float)), fit.centre, fit.size,
                     ground_y, fit.spheres) @ fit.coefficients[:, 0]


@pytest.mark.parametrize("mesh", BUILT_IN)
def test_points_lie_on_the_surface_and_are_spread_over_it(mesh: str) -> None:
    points, normals = surface_points(BUILT_IN[mesh]())
    assert points.shape == normals.shape == (POINTS, 3)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    distance, _ = hit(fitted_shape(BUILT_IN[mesh]()).kind, points + normals, -normals)
    assert distance == pytest.approx(1.0, abs=0.01)
    assert np.abs(points.mean(axis=0)).max() < 0.1
    assert np.abs(normals.mean(axis=0)).max() < 0.15


def test_an_empty_world_changes_nothing() -> None:
    radiance = np.random.default_rng(0).random((ROWS, 2 * ROWS, 3)).astype(np.float32)
    fit = fitted(body("sphere", (0, 0, -3)), [], None, radiance)
    assert fit.coefficients[0] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(fit.coefficients[1:]).max() < 1e-6


def test_ground_and_neighbours_that_shine_as_the_sky_change_nothing() -> None:
    far_up = fitted(body("box", (0, 20, -3)), [], GROUND)
    box = body("box", (0, 20, -3))
    assert ratio_at(far_up, box.points, box.normals, GROUND) == pytest.approx(1.0, abs=0.01)
    white = [body("box", (0.55, 0, -3), (0.1, 1, 1), albedo=1.0), body("sphere", (0, 1, -3), albedo=1.0)]
    among = fitted(body("sphere", (0, 0, -3), (0.5, 0.5, 0.5)), white, None)
    assert among.coefficients[0] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(among.coefficients[1:]).max() < 1e-6


@pytest.mark.parametrize("height", [0.6, 1.0, 1.5])
def test_a_sphere_over_the_ground_hides_its_form_factor_of_the_sky(height: float) -> None:
    """(n . d) (R / d)^2 of a sphere that is whole above the horizon."""
    it = body("sphere", (0.3, GROUND + height, -3))
    patch = _GroundPatch(it, [it.solid], GROUND)
    missing = 1 - patch.ratio(np.ones((GROUND_RAYS, 3)), ())[:, 1]
    towards = it.solid.centre - patch.points
    distance = np.linalg.norm(towards, axis=1)
    expected = towards[:, 1] / distance * (0.5 / distance) ** 2
    assert expected.max() > 0.1
    assert missing.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert np.sqrt(np.mean((missing - expected) ** 2)) < 0.75 / GROUND_RAYS
    assert np.abs(missing - expected).max() < 2 / GROUND_RAYS


def test_a_light_is_missing_where_the_sphere_is_in_its_way() -> None:
    it = body("sphere", (0, GROUND + 0.5, -3))
    patch = _GroundPatch(it, [it.solid], GROUND)
    light = Light(np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0]), np.full(3, 2.0), 0.01, id=1)
    found = patch.ratio(np.zeros((GROUND_RAYS, 3)), (light,))[:, 0]
    away = np.linalg.norm(np.cross(it.solid.centre - patch.points, light.direction), axis=1)
    assert (found[away < 0.45] == 0.0).all()
    assert (found[away > 0.55] == 1.0).all()
    assert (away < 0.45).sum() > 3
    half = patch.ratio(np.full((GROUND_RAYS, 3), light.irradiance[0] * light.direction[1] / np.pi), (light,))[:, 0]
    sky = patch.ratio(np.ones((GROUND_RAYS, 3)), ())[:, 0]
    assert half == pytest.approx((sky + found) / 2)


def test_how_much_of_a_light_arrives_is_kept_until_it_moves() -> None:
    it = body("sphere", (0, GROUND + 0.5, -3))
    patch = _GroundPatch(it, [it.solid], GROUND)
    light = Light(np.array([0.0, 1.0, 0.0]), np.ones(3), 0.01, id=1)
    share = patch._light_share(light)
    assert set(np.unique(share * LIGHT_RAYS)) <= set(range(LIGHT_RAYS + 1))
    assert patch._light_share(Light(light.direction, 2 * np.ones(3), 0.01, id=1)) is share
    moved = Light(np.array([0.6, 0.8, 0.0]), np.ones(3), 0.01, id=1)
    assert (patch._light_share(moved) != share).any()
    patch.forget_lights(())
    assert patch._light_share(moved) is not share


def test_the_underside_of_a_sphere_on_the_ground_is_dark() -> None:
    it = body("sphere", (0, GROUND + 0.5, -3))
    fit = fitted(it, [], GROUND)
    normals = np.array([[np.sin(a), np.cos(a), 0.0] for a in np.radians([0, 60, 120, 150, 180])])
    found = ratio_at(fit, it.solid.centre + 0.5 * normals, normals, GROUND)
    assert found[:2] == pytest.approx(1.0, abs=0.03), "what looks up sees the sky alone"
    assert (np.diff(found) < 0.02).all()
    assert found[4] < 0.35


@pytest.mark.parametrize("gap", [0.3, 0.5, 0.8])
def test_a_black_wall_takes_its_form_factor_from_the_side_that_faces_it(gap: float) -> None:
    """That of a square of edge 1 at this distance over its middle; the functions leave some of it out."""
    small = body("box", (0, 0, -3), (0.2, 0.2, 0.2))
    fit = fitted(small, [body("box", (0.1 + gap + 0.05, 0, -3), (0.1, 1, 1))], None)
    half = 0.5 / gap
    form_factor = 4 / np.pi * half / np.hypot(1, half) * np.arctan(half / np.hypot(1, half))
    facing, back = 1 - ratio_at(fit, small.solid.centre + np.array([[0.1, 0, 0], [-0.1, 0, 0]]), [[1, 0, 0], [-1, 0, 0]])
    assert 0.7 * form_factor < facing < 1.05 * form_factor
    assert abs(back) < 0.25 * form_factor


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.6, 0.8, 0.0), (0.1, 0.995, 0.0), (0.0, 0.0, 1.0), (-0.9, 0.436, 0.0)])
@pytest.mark.parametrize("distance", [0.7, 1.5])
def test_the_form_factor_of_a_sphere_is_its_share_of_cosine_weighted_directions(normal: Vector, distance: float) -> None:
    directions = np.random.default_rng(5).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    weights = np.maximum(directions @ np.array(normal), 0.0)
    met = np.isfinite(hit("ellipsoid", np.broadcast_to([-distance, 0.0, 0.0], directions.shape), directions)[0])
    expected = float((weights * met).sum() / weights.sum())
    found = form_factor(np.zeros((1, 3)), np.array([normal]), np.array([distance, 0.0, 0.0, 0.5]))[0]
    assert found == pytest.approx(expected, abs=0.03)


def test_a_neighbour_darkens_the_side_of_a_sphere_that_faces_it_and_no_other() -> None:
    """A black ball beside a ball, under a flat sky: against rays from every place."""
    it, other = body("sphere", (0, 0, -3)), body("sphere", (1.1, 0, -3))
    fit = fitted(it, [other], None)
    angles = np.radians([0, 30, 60, 120, 180])
    normals = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    expected = 1 - form_factor(it.solid.centre + 0.5 * normals, normals, np.array([*other.solid.centre, 0.5]))
    assert expected[0] < 0.35
    found = fit.ratio(it.solid.centre + 0.5 * normals, normals, -1e9)[:, 0]
    assert found == pytest.approx(expected, abs=0.08)


def test_a_metal_gives_back_what_it_mirrors() -> None:
    """Under a sky that is bright on one side a mirror facing it is bright, and a matte thing as it is lit."""
    seen, irradiance = np.full((1, 3), 4.0), np.full((1, 3), np.pi)
    assert replace(body("box", (0, 0, -3), albedo=0.5), metallic=1.0).reflects(irradiance, seen) == pytest.approx(2.0)
    assert body("box", (0, 0, -3), albedo=0.5).reflects(irradiance, seen) == pytest.approx(0.5)


def flat_frame(value: float = 1.0) -> RadianceFrame:
    return RadianceFrame(np.full((128, 256, 3), value, dtype=np.float32))


def test_the_shader_evaluates_the_same_functions(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sphere under a flat sky, by a fit of arbitrary numbers: the picture divided by that of a fit of one is `functions`."""
    centre, pipeline = np.array([0.0, -1.0, -2.0]), Pipeline(context, RadianceFrame, (256, 128))
    coefficients = np.random.default_rng(4).uniform(-0.12, 0.12, (FUNCTIONS, 3))
    coefficients[0] += 1.0
    spheres = np.array([[0.2, -0.9, -1.0, 0.3], [1.2, -1.0, -2.2, 0.6]])
    one = np.zeros((FUNCTIONS, 3))
    one[0] = 1.0
    wanted = scene({"mesh": "sphere", "position": list(centre), "casts_shadow": False,
                    "material": {"base_color": [0.7, 0.7, 0.7], "roughness": 1.0}})
    pictures = []
    for given in (one, coefficients):
        fit = Fit(centre, 1.3, given, spheres)
        monkeypatch.setattr(pipeline._scene_light._surroundings, "fits", lambda *_, fit=fit: (fit,))
        pipeline._scene_light._last = None
        frame = pipeline.render(flat_frame(), wanted).frame
        assert isinstance(frame, RadianceFrame)
        pictures.append(frame.rgb)
    pipeline.release()
    directions = pixel_directions(128, 256)
    away = directions @ centre
    inside = (np.linalg.norm(np.cross(directions, centre), axis=-1) < 0.42) & (away > 0)    # away from the silhouette
    assert inside.sum() > 200
    distance, normals = hit("ellipsoid", np.broadcast_to(-centre, (inside.sum(), 3)), directions[inside])
    assert (np.abs(distance - away[inside]) < 0.5).all()
    at, normals = directions[inside] * distance[:, None], normals / np.linalg.norm(normals, axis=1, keepdims=True)
    expected = functions(at, normals, centre, 1.3, GROUND, spheres) @ coefficients
    assert np.ptp(expected) > 0.3
    assert (pictures[1] / pictures[0])[inside] == pytest.approx(expected, abs=0.01)


class Counter:
    """Stands in for NearField and remembers whom it was asked for, by the object's x."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.built: list[float] = []
        monkeypatch.setattr(surroundings, "NearField", self)

    def __call__(self, it: Body, *arguments: Any) -> NearField:
        self.built.append(round(float(it.solid.centre[0]), 3))
        return NearField(it, *arguments)

    def since(self) -> list[float]:
        built, self.built = self.built, []
        return built


def small_box(x: float, **values: Any) -> dict[str, Any]:
    return {"mesh": "box", "position": [x, -1.5, -3], "scale": [0.2, 0.2, 0.2], **values}


def test_only_what_has_changed_is_worked_out_anew_one_in_each_frame(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    counter, pipeline = Counter(monkeypatch), Pipeline(context, RadianceFrame, (128, 64))
    frame = RadianceFrame(np.full((64, 128, 3), 0.5, dtype=np.float32))

    def built(*objects: dict[str, Any]) -> list[list[float]]:
        """In each of four frames of one scene."""
        wanted = scene(*objects)
        return [sorted(counter.since()) for _ in range(4) if pipeline.render(frame, wanted)]

    far, near = small_box(40.0, id="far"), small_box(0.3, id="near")
    assert built(small_box(0.0), near, far) == [[0.0, 0.3, 40.0], [], [], []]
    far = small_box(41.0, id="far")
    assert built(small_box(0.0), near, far) == [[41.0], [], [], []]
    moved = built(small_box(0.1), near, far)
    assert moved in ([[0.1], [0.3], [], []], [[0.3], [0.1], [], []]), "the moved one, and the one next to it"
    assert built(near, far) == [[0.3], [], [], []], "what was next to it when it goes"
    assert built(far, near) == [[], [], [], []]
    pipeline.release()


def test_a_new_object_is_looked_at_at_once_and_its_neighbours_one_by_one(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    counter, pipeline = Counter(monkeypatch), Pipeline(context, RadianceFrame, (128, 64))
    frame, first = RadianceFrame(np.full((64, 128, 3), 0.5, dtype=np.float32)), [small_box(x) for x in (0.0, 0.3, 0.6)]
    pipeline.render(frame, scene(*first))
    counter.since()
    wanted = scene(first[0], small_box(0.9, id="new"), *({**it, "id": f"o{i}"} for i, it in enumerate(first[1:], start=1)))
    found = [sorted(counter.since()) for _ in range(5) if pipeline.render(frame, wanted)]
    assert 0.9 in found[0]
    assert [len(one) for one in found] == [2, 1, 1, 0, 0]
    pipeline.release()


def test_the_fit_of_what_has_moved_is_that_of_its_new_place(context: Context) -> None:
    pipeline, frame = Pipeline(context, RadianceFrame, (128, 64)), sky_with_sun(90, 40, size=(128, 64))
    wall = {"mesh": "box", "position": [0.45, -1.5, -3], "scale": [0.1, 0.2, 0.2]}
    for wanted in (scene(small_box(0.0), {**wall, "position": [5.0, -1.5, -3]}), scene(small_box(0.0), wall)):
        for _ in range(4):
            pipeline.render(frame, wanted)
    assert pipeline._shading._illumination is not None
    after_moving = pipeline._shading._illumination.near
    fresh = Pipeline(context, RadianceFrame, (128, 64))
    fresh.render(frame, scene(small_box(0.0), wall))
    assert fresh._shading._illumination is not None
    for kept, new in zip(after_moving, fresh._shading._illumination.near, strict=True):
        assert kept.centre == pytest.approx(new.centre)
        assert kept.coefficients == pytest.approx(new.coefficients, abs=1e-6)
    pipeline.release()
    fresh.release()
