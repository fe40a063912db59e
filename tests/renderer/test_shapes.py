"""Simple solids: rays against formulas and against steps along the ray; which solid a mesh becomes."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from renderer.models.gltf import load, transform
from renderer.models.mesh import BUILT_IN, Mesh, Primitive
from renderer.models.shapes import KINDS, Kind, Shape, Solid, fitted_shape, hides, hit

STEPS = np.linspace(0.0, 8.0, 8001)
SHAPES: dict[str, Kind] = {"sphere": "ellipsoid", "box": "box", "cylinder": "cylinder"}
TURNED = (0.18257, 0.36515, 0.54772, 0.7303)


def is_inside(kind: Kind, points: np.ndarray) -> np.ndarray:
    """Of the closed unit solid, for (..., 3) points."""
    if kind == "box":
        return np.asarray((np.abs(points) <= 0.5).all(axis=-1))
    if kind == "ellipsoid":
        return np.asarray(np.linalg.norm(points, axis=-1) <= 0.5)
    return np.asarray((np.abs(points[..., 1]) <= 0.5) & (np.hypot(points[..., 0], points[..., 2]) <= 0.5))


def random_rays(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of length 1 from around the unit solids, most of them towards their middle."""
    random = np.random.default_rng(seed)
    origins = random.uniform(-2, 2, (count, 3))
    directions = random.uniform(-0.6, 0.6, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_rays_enter_where_steps_along_them_first_are_inside(kind: Kind, seed: int) -> None:
    origins, directions = random_rays(24, seed)
    inside = is_inside(kind, origins[:, None] + directions[:, None] * STEPS[:, None])
    first = np.where(inside.any(axis=1), STEPS[inside.argmax(axis=1)], np.inf)
    found, _ = hit(kind, origins, directions)
    grazes = inside.sum(axis=1) < 5                    # a chord of a few steps may be missed by them
    assert (np.isfinite(found) == np.isfinite(first))[~grazes].all()
    both = np.isfinite(found) & np.isfinite(first)
    assert np.abs(found[both] - first[both]).max(initial=0.0) < 1.1e-3


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), axis=st.sampled_from([None, 0, 1, 2]))
def test_what_hides_is_what_is_hit(kind: Kind, seed: int, axis: int | None) -> None:
    origins, directions = random_rays(200, seed)
    if axis is not None:
        directions[:, axis] = 0.0
    assert (hides(kind, origins, directions) == np.isfinite(hit(kind, origins, directions)[0])).all()


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_those_of_the_place(kind: Kind) -> None:
    origins, directions = random_rays(4000, 5)
    outside = ~is_inside(kind, origins)
    origins, directions = origins[outside], directions[outside]
    distance, normals = hit(kind, origins, directions)
    met = np.isfinite(distance)
    assert met.mean() > 0.5
    at = origins[met] + directions[met] * distance[met, None]
    unit = normals[met] / np.linalg.norm(normals[met], axis=1, keepdims=True)
    assert ((unit * directions[met]).sum(axis=1) < 1e-9).all(), "they face where the ray came from"
    assert not is_inside(kind, at + 1e-5 * unit).any()
    assert is_inside(kind, at - 1e-4 * unit).mean() > 0.998     # but at an edge
    flat = {"box": np.ones(len(unit), dtype=bool), "ellipsoid": np.zeros(len(unit), dtype=bool),
            "cylinder": np.abs(at[:, 1]) > 0.4999}[kind]
    assert np.abs(unit[flat]).max(axis=1) == pytest.approx(1.0)
    round_part = at * ([1, 1, 1] if kind == "ellipsoid" else [1, 0, 1])
    assert unit[~flat] == pytest.approx((round_part / np.linalg.norm(round_part, axis=1, keepdims=True))[~flat], abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_from_inside_meet_the_solid_at_once(kind: Kind) -> None:
    origins, directions = random_rays(500, 3)
    origins *= 0.1
    assert (hit(kind, origins, directions)[0] == 0.0).all()
    assert hides(kind, origins, directions).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis(kind: Kind, axis: int) -> None:
    aside = (axis + 1) % 3
    origins, directions = np.zeros((5, 3)), np.zeros((5, 3))
    origins[:, axis] = [-2, -2, -2, 2, 0]
    origins[:, aside] = [0.2, 0.6, -0.6, 0.2, 0]
    directions[:, axis] = [1, 1, 1, 1, -1]
    round_here = kind == "ellipsoid" or (kind == "cylinder" and axis != 1 and aside != 1)
    depth = np.sqrt(0.25 - 0.04) if round_here else 0.5
    assert hit(kind, origins, directions)[0] == pytest.approx([2 - depth, np.inf, np.inf, np.inf, 0.0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_placed_solid_is_hit_as_in_its_own_space(kind: Kind) -> None:
    model = transform((1.0, -0.5, -3.0), TURNED, (0.5, 2.0, 1.0))
    solid = Solid.placed(Shape(kind, np.eye(4)), model)
    origins, directions = random_rays(300, 11)
    distance, normals = solid.hit(origins @ model[:3, :3].T + model[:3, 3], directions @ model[:3, :3].T)
    expected, local = hit(kind, origins, directions)
    assert distance == pytest.approx(expected)
    met = np.isfinite(expected) & (expected > 0)
    world = local[met] @ np.linalg.inv(model[:3, :3])       # normals by the inverse transpose
    assert normals[met] == pytest.approx(world / np.linalg.norm(world, axis=1, keepdims=True), abs=1e-9)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    assert solid.centre == pytest.approx([1.0, -0.5, -3.0])
    if kind == "box":
        assert np.linalg.norm(corners @ model[:3, :3].T, axis=1).max() <= solid.radius


def test_hides_of_a_solid_is_that_of_every_pair() -> None:
    solid = Solid.placed(Shape("cylinder", np.eye(4)), transform((0.3, 0, 0), TURNED, (1.0, 0.5, 2.0)))
    points, directions = random_rays(30, 1)
    pairs = [[bool(np.isfinite(solid.hit(p[None], d[None])[0][0])) for d in directions] for p in points]
    found = solid.hides(points, directions)
    assert found.shape == (30, 30)
    assert (found == np.array(pairs)).mean() > 0.995      # single precision, at the rim


@pytest.mark.parametrize("name", SHAPES)
def test_built_in_meshes_are_their_own_shape(name: str) -> None:
    shape = fitted_shape(BUILT_IN[name]())
    assert shape.kind == SHAPES[name]
    assert shape.model_from_unit == pytest.approx(np.eye(4), abs=1e-6)
    assert shape.is_convex


def test_the_teapot_may_hide_a_light_from_itself() -> None:
    mesh = load(Path(str(resources.files("renderer.models.builtin") / "teapot.glb")))
    shape = fitted_shape(mesh)
    assert not shape.is_convex
    low, high = mesh.outline.min(axis=0), mesh.outline.max(axis=0)
    assert shape.model_from_unit[:3, 3] == pytest.approx((low + high) / 2)
    assert (np.diag(shape.model_from_unit)[:3] <= high - low + 1e-6).all()


def one_part(positions: list[list[float]], triangles: list[list[int]]) -> Mesh:
    points = np.array(positions, dtype=np.float32)
    normals = np.tile(np.array([0, 1, 0], dtype=np.float32), (len(points), 1))
    return Mesh((Primitive(points, normals, points[:, :2].copy(), np.array(triangles, dtype=np.int32)),))


@pytest.mark.parametrize(("positions", "triangles"), [
    ([[0, 0, 0], [2, 0, 0], [0, 0, 1]], [[0, 1, 2]]),
    ([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], [[0, 2, 1], [0, 3, 2]]),
    ([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]]),
    ([[3, 3, 3], [3, 3, 3], [3, 3, 3]], [[0, 1, 2]])], ids=["triangle", "plane", "line", "point"])
def test_flat_meshes_become_thin_solids(positions: list[list[float]], triangles: list[list[int]]) -> None:
    shape = fitted_shape(one_part(positions, triangles))
    assert np.isfinite(shape.model_from_unit).all()
    solid = Solid.placed(shape, np.eye(4))
    assert np.isfinite(solid.unit_from_world).all()
    assert 0 < solid.radius < 3
    assert np.diag(shape.model_from_unit)[:3] == pytest.approx(np.maximum(np.ptp(positions, axis=0), 1e-4))
