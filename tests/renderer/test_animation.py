"""Clips, skins and morph targets against what glTF 2.0 defines them to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from renderer.models.animation import slerp
from renderer.models.gltf import GltfError
from renderer.models.mesh import BUILT_IN, Mesh
from tests.models import CORNERS, TURN, Model, bent_bar, one_triangle

ROUNDING = 1e-5
QUARTER = [0, 0, TURN, TURN]    # about +Z: x goes to y


def moved(mesh: Mesh, clip: str | None, seconds: float, loop: bool = False) -> np.ndarray:
    return mesh.pose(clip, seconds, loop).primitives[0].positions


def triangle_with_clip(tmp_path: Path, path: str, times: list[float], values: list[list[float]], interpolation: str) -> Mesh:
    model = one_triangle()
    model.clip(0, path, times, values, interpolation, name="c")
    return model.load(tmp_path)


def test_a_bar_of_two_joints_bends_by_a_right_angle(tmp_path: Path) -> None:
    mesh = bent_bar().load(tmp_path)
    assert mesh.clips == ("bend",)
    assert mesh.clip_seconds("bend") == 1.0
    rest = np.array([[x, y, 0] for y in (0, 1, 2) for x in (-0.1, 0.1)])
    assert mesh.primitives[0].positions == pytest.approx(rest, abs=ROUNDING)     # the skinned node's own place does not count
    assert moved(mesh, None, 5.0) is mesh.primitives[0].positions
    # the upper end turns about (0, 1): (x, 2) goes to (-1, 1 + x); at the joint each vertex is half of either place
    expected = [[-0.1, 0, 0], [0.1, 0, 0], [-0.05, 0.95, 0], [0.05, 1.05, 0], [-1, 0.9, 0], [-1, 1.1, 0]]
    assert moved(mesh, "bend", 1.0) == pytest.approx(np.array(expected), abs=ROUNDING)
    half = np.sqrt(0.5)     # at 0.5 s by 45 degrees
    assert moved(mesh, "bend", 0.5)[4] == pytest.approx([-0.1 * half - half, 1 - 0.1 * half + half, 0], abs=ROUNDING)
    assert mesh.pose("bend", 0.5).primitives[0].normals == pytest.approx(np.tile([0, 0, 1], (6, 1)), abs=ROUNDING)


def test_a_skin_without_clips_is_a_static_mesh_at_its_bind_pose(tmp_path: Path) -> None:
    model = bent_bar()
    del model.json["animations"]
    model.json["nodes"][2]["rotation"] = QUARTER
    mesh = model.load(tmp_path)
    assert not mesh.is_animated
    assert mesh.primitives[0].positions[5] == pytest.approx([-1, 1.1, 0], abs=ROUNDING)


def test_eight_influences_count_and_weights_are_normalised(tmp_path: Path) -> None:
    model = bent_bar()
    attributes = model.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["WEIGHTS_0"] = model.accessor(np.zeros((6, 4), "f4"))
    attributes["JOINTS_1"] = model.accessor(np.tile(np.array([0, 1, 0, 0], "u2"), (6, 1)))
    attributes["WEIGHTS_1"] = model.accessor(np.tile(np.array([0, 128, 0, 0], "u1"), (6, 1)), normalized=True)
    assert moved(model.load(tmp_path), "bend", 1.0)[0] == pytest.approx([1, 0.9, 0], abs=ROUNDING)      # all on the upper joint


def test_a_node_carries_its_children_and_what_does_not_move_is_the_same_array(tmp_path: Path) -> None:
    model = one_triangle()
    model.json.update(nodes=[{"mesh": 0}, {"children": [2], "translation": [1, 0, 0]}, {"mesh": 0, "translation": [1, 0, 0]}],
                      scenes=[{"nodes": [0, 1]}])
    model.clip(1, "rotation", [0, 2], [[0, 0, 0, 1], QUARTER], name="turn")
    mesh = model.load(tmp_path)
    still, moving = mesh.pose("turn", 2.0, loop=False).primitives
    assert still.positions is mesh.primitives[0].positions
    assert moving.positions == pytest.approx(np.array([[1, 1, 0], [1, 2, 0], [0, 1, 0]]), abs=ROUNDING)
    assert mesh.primitives[1].positions == pytest.approx(CORNERS + np.array([2, 0, 0]), abs=ROUNDING)


@pytest.mark.parametrize(("interpolation", "expected"), [("LINEAR", 1.0), ("STEP", 0.0)])
def test_values_between_keys(tmp_path: Path, interpolation: str, expected: float) -> None:
    mesh = triangle_with_clip(tmp_path, "translation", [0, 1, 2], [[0, 0, 0], [4, 0, 0], [0, 8, 0]], interpolation)
    assert moved(mesh, "c", 0.25)[0] == pytest.approx([expected, 0, 0], abs=ROUNDING)
    assert moved(mesh, "c", 1.0)[0] == pytest.approx([4, 0, 0], abs=ROUNDING)
    assert moved(mesh, "c", 2.0)[0] == pytest.approx([0, 8, 0], abs=ROUNDING)


def test_a_cubic_spline_follows_its_formula(tmp_path: Path) -> None:
    keys = [[9, 9, 9], [1, 0, 0], [0, 3, 0],        # in-tangent, value, out-tangent
            [0, 0, 5], [2, 0, 0], [9, 9, 9]]
    mesh = triangle_with_clip(tmp_path, "translation", [1, 3], keys, "CUBICSPLINE")
    interval, t = 2.0, 0.3
    start, leaving, arriving, end = (np.array(keys[i]) for i in (1, 2, 3, 4))
    expected = ((2 * t**3 - 3 * t**2 + 1) * start + interval * (t**3 - 2 * t**2 + t) * leaving
                + (-2 * t**3 + 3 * t**2) * end + interval * (t**3 - t**2) * arriving)
    assert moved(mesh, "c", 1 + t * interval)[0] == pytest.approx(expected, abs=ROUNDING)
    assert moved(mesh, "c", 0.0)[0] == pytest.approx(start, abs=ROUNDING)
    assert moved(mesh, "c", 7.0)[0] == pytest.approx(end, abs=ROUNDING)


def test_slerp_turns_evenly_and_the_shorter_way() -> None:
    start = np.array([[0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 1]])
    end = np.array([QUARTER, [-c for c in QUARTER], [0, 0, 0, 1]])
    third = np.radians(30) / 2
    expected = [0, 0, np.sin(third), np.cos(third)]
    assert slerp(start, end, 1 / 3) == pytest.approx(np.array([expected, expected, [0, 0, 0, 1]]), abs=1e-12)


@pytest.mark.parametrize(("seconds", "loop", "expected"), [
    (2.5, True, 0.5), (-0.5, True, 1.5), (2.0, True, 0.0), (2.5, False, 2.0), (-0.5, False, 0.0)])
def test_a_clip_wraps_or_stops(tmp_path: Path, seconds: float, loop: bool, expected: float) -> None:
    mesh = triangle_with_clip(tmp_path, "translation", [0, 2], [[0, 0, 0], [2, 0, 0]], "LINEAR")
    assert moved(mesh, "c", seconds, loop)[0] == pytest.approx([expected, 0, 0], abs=ROUNDING)


def test_a_scale_to_nothing_leaves_finite_normals(tmp_path: Path) -> None:
    mesh = triangle_with_clip(tmp_path, "scale", [0, 1], [[1, 1, 1], [0, 0, 0]], "LINEAR")
    pose = mesh.pose("c", 1.0, loop=False).primitives[0]
    assert (pose.positions == 0).all()
    assert np.linalg.norm(pose.normals, axis=1) == pytest.approx(1)


def test_normals_stay_square_to_a_surface_that_is_stretched(tmp_path: Path) -> None:
    slope = np.array([[0, 0, 0], [1, -1, 0], [0, 0, -1]], "f4")
    model = one_triangle(POSITION=slope, NORMAL=np.tile([TURN, TURN, 0], (3, 1)).astype("f4"))
    model.clip(0, "scale", [0, 1], [[1, 1, 1], [4, 1, 1]], name="c")
    pose = model.load(tmp_path).pose("c", 1.0, loop=False)
    assert pose.primitives[0].normals[0] == pytest.approx(np.array([1, 4, 0]) / np.sqrt(17), abs=ROUNDING)


def offsets(first: list[float], second: list[float]) -> np.ndarray:
    return np.array([first, second, [0, 0, 0]])


def morphing() -> Model:
    model = one_triangle(NORMAL=np.tile([0, 0, 1], (3, 1)).astype("f4"))
    model.json["meshes"][0]["weights"] = [0.5, 0]
    model.json["meshes"][0]["primitives"][0]["targets"] = [
        {"POSITION": model.accessor([[0, 0, 2], [0, 0, 0], [0, 0, 0]]), "NORMAL": model.accessor([[1, 0, 0]] * 3)},
        {"POSITION": model.accessor([[0, 0, 0], [0, 4, 0], [0, 0, 0]])}]
    return model


def test_morph_targets_add_up_by_their_weights(tmp_path: Path) -> None:
    model = morphing()
    model.clip(0, "weights", [0, 1], [0, 0, 1, 0.25], name="c")
    mesh = model.load(tmp_path)
    assert mesh.primitives[0].positions == pytest.approx(CORNERS + offsets([0, 0, 1], [0, 0, 0]), abs=ROUNDING)
    pose = mesh.pose("c", 1.0, loop=False).primitives[0]
    assert pose.positions == pytest.approx(CORNERS + offsets([0, 0, 2], [0, 1, 0]), abs=ROUNDING)
    assert pose.normals[0] == pytest.approx([TURN, 0, TURN], abs=ROUNDING)
    assert moved(mesh, "c", 0.5) == pytest.approx(CORNERS + offsets([0, 0, 1], [0, 0.5, 0]), abs=ROUNDING)


def test_a_node_overrides_the_weights_of_its_mesh(tmp_path: Path) -> None:
    model = morphing()
    model.json["nodes"][0]["weights"] = [0, 1]
    mesh = model.load(tmp_path)
    assert not mesh.is_animated
    assert mesh.primitives[0].positions[1] == pytest.approx([1, 4, 0], abs=ROUNDING)


def test_flat_normals_follow_a_morph(tmp_path: Path) -> None:
    model = morphing()
    del model.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    model.clip(0, "weights", [0, 1], [0, 0, 0.5, 0], name="c")
    normal = model.load(tmp_path).pose("c", 1.0, loop=False).primitives[0].normals[0]
    assert normal == pytest.approx(np.ones(3) / np.sqrt(3), abs=ROUNDING)       # of (0, 0, 1), (1, 0, 0), (0, 1, 0)


def test_clips_without_a_name_of_their_own_have_a_number(tmp_path: Path) -> None:
    model = one_triangle()
    for name in ("walk", None, "walk", "run\n"):
        model.clip(0, "translation", [0, 1], [[0, 0, 0], [1, 0, 0]], **({} if name is None else {"name": name}))
    assert model.load(tmp_path).clips == ("walk", "1", "2", "run")


def test_an_unknown_clip_is_named_beside_those_that_exist(tmp_path: Path) -> None:
    mesh = bent_bar().load(tmp_path)
    with pytest.raises(ValueError, match="clip 'jump' does not exist, expected one of bend"):
        mesh.pose("jump", 0.0)
    with pytest.raises(ValueError, match="clip 'jump' does not exist, the model has none"):
        BUILT_IN["box"]().clip_seconds("jump")
    with pytest.raises(ValueError, match="at nan s"):
        mesh.pose("bend", np.nan)


def test_proxies_and_outline_follow_the_pose(tmp_path: Path) -> None:
    mesh = bent_bar().load(tmp_path)
    pose = mesh.pose("bend", 1.0, loop=False)
    for fine, proxy in ((False, mesh.proxy), (True, mesh.fine_proxy)):      # whose points are the mesh's own
        same = np.linalg.norm(proxy[0][:, None] - mesh.primitives[0].positions, axis=2).argmin(axis=1)
        assert mesh.posed_proxy(pose, fine) == pytest.approx(pose.primitives[0].positions[same], abs=ROUNDING)
    assert np.ptp(mesh.posed_outline(pose), axis=0) == pytest.approx(np.ptp(pose.primitives[0].positions, axis=0), abs=ROUNDING)
    assert mesh.posed_proxy(mesh.pose(None)) == pytest.approx(mesh.proxy[0], abs=ROUNDING)


@pytest.mark.parametrize(("times", "values", "complaint"), [
    ([0, 0], [[0, 0, 0]] * 2, "time 1 is 0 s"), ([0, 2, 1], [[0, 0, 0]] * 3, "time 2 is 1 s"), ([-1, 0], [[0, 0, 0]] * 2, "time 0"),
    ([0, np.nan], [[0, 0, 0]] * 2, "time 1 is nan"), ([0, np.inf], [[0, 0, 0]] * 2, "time 1 is inf"),
    ([0, 1], [[0, 0, 0]] * 3, "9 numbers, expected 1 x 3 for each of 2"), ([0, 1], [[0, 0, np.nan]] * 2, "not finite")])
def test_broken_key_frames_are_refused(tmp_path: Path, times: list[float], values: list[list[float]], complaint: str) -> None:
    with pytest.raises(GltfError, match=f"animation 0 channel 0 (in|out)put: .*{complaint}"):
        triangle_with_clip(tmp_path, "translation", times, values, "LINEAR")
