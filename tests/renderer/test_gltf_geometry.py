"""How a file's numbers become vertices and triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from renderer.models.gltf import GltfError
from renderer.models.mesh import Primitive
from tests.models import CORNERS, Model, one_triangle

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "f4")
FACING = np.tile([0, 0, 1], (4, 1)).astype("f4")
UV = np.array([[0, 1], [1, 1], [0, 0], [1, 0]], "f4")     # v grows downwards
BUMPS = np.full((2, 2, 3), 128, "u1")


def only(model: Model, folder: Path) -> Primitive:
    (primitive,) = model.load(folder).primitives
    return primitive


def square(mode: int | None = None, indices: list[int] | None = None, **attributes: Any) -> Model:
    model = Model()
    primitive: dict[str, Any] = {"attributes": {
        name: model.accessor(values) for name, values in {"POSITION": SQUARE, "NORMAL": FACING, **attributes}.items()}}
    if mode is not None:
        primitive["mode"] = mode
    if indices is not None:
        primitive["indices"] = model.accessor(np.array(indices, "u1"))
    model.show(primitive)
    return model


@pytest.mark.parametrize(("mode", "indices", "triangles"), [
    (5, None, [[0, 1, 2], [1, 3, 2]]), (6, [0, 1, 3, 2], [[1, 3, 0], [3, 2, 0]]), (None, [0, 1, 3], [[0, 1, 3]])])
def test_strips_and_fans_become_triangles(tmp_path: Path, mode: int | None, indices: list[int] | None,
                                          triangles: list[list[int]]) -> None:
    primitive = only(square(mode, indices), tmp_path)
    corners = primitive.positions[primitive.triangles]
    assert corners == pytest.approx(SQUARE[np.array(triangles)])
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


def test_points_and_lines_are_left_out(tmp_path: Path) -> None:
    with pytest.raises(GltfError, match="no triangles"):
        square(mode=1).load(tmp_path)
    with pytest.raises(GltfError, match="mode is 7, expected 0 to 6"):
        square(mode=7).load(tmp_path)


def test_triangles_without_an_area_are_dropped(tmp_path: Path) -> None:
    model = square(indices=[0, 1, 2, 0, 0, 1])
    assert only(model, tmp_path).triangles.tolist() == [[0, 1, 2]]
    with pytest.raises(GltfError, match="no triangles with an area"):
        one_triangle(POSITION=[[0, 0, 0], [1, 1, 1], [2, 2, 2]]).load(tmp_path)


def test_a_sparse_accessor_replaces_some_elements(tmp_path: Path) -> None:
    model = one_triangle()
    sparse = {"count": 1, "indices": {"bufferView": model.view(np.array([2], "u2").tobytes()), "componentType": 5123},
              "values": {"bufferView": model.view(np.array([0, 5, 0], "f4").tobytes())}}
    model.json["accessors"][0]["sparse"] = sparse
    assert only(model, tmp_path).positions[2] == pytest.approx([0, 5, 0])
    del model.json["accessors"][0]["bufferView"]      # the rest are zeros, which is a triangle without an area
    with pytest.raises(GltfError, match="no triangles"):
        model.load(tmp_path)
    sparse["indices"]["componentType"] = 5126
    with pytest.raises(GltfError, match="accessor 0 replaces 1 elements by indices of type 5126"):
        model.load(tmp_path)


def test_a_sparse_accessor_replaces_no_element_that_does_not_exist(tmp_path: Path) -> None:
    model = one_triangle()
    model.json["accessors"][0]["sparse"] = {
        "count": 1, "indices": {"bufferView": model.view(np.array([3], "u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": 0}}
    with pytest.raises(GltfError, match="accessor 0 replaces element 3, expected less than its 3"):
        model.load(tmp_path)


def test_interleaved_and_quantised_attributes(tmp_path: Path) -> None:
    model = one_triangle()
    positions = np.zeros(3, np.dtype([("position", "i2", 3), ("padding", "i2")]))
    positions["position"] = CORNERS * 32767
    model.json["bufferViews"][0] = {"buffer": 0, "byteOffset": len(model.binary), "byteLength": 24, "byteStride": 8}
    model.binary += positions.tobytes()
    model.json["accessors"][0].update(componentType=5122, normalized=True)
    model.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    assert only(model, tmp_path).positions == pytest.approx(CORNERS)


@pytest.mark.parametrize(("colors", "normalized", "expected"), [
    (np.array([[255, 0, 51]] * 3, "u1"), True, [1, 0, 0.2, 1]), (np.array([[65535, 0, 0, 32768]] * 3, "u2"), True, [1, 0, 0, 0.5]),
    (np.array([[0.25, 2, -1, 0.5]] * 3, "f4"), False, [0.25, 1, 0, 0.5])])
def test_vertex_colours_are_linear_factors(tmp_path: Path, colors: Any, normalized: bool, expected: list[float]) -> None:
    model = one_triangle(COLOR_0=colors)
    model.json["accessors"][-1]["normalized"] = normalized
    assert only(model, tmp_path).colors == pytest.approx(np.tile(expected, (3, 1)), abs=1e-4)


def test_a_part_without_colours_is_white_beside_one_that_has_them(tmp_path: Path) -> None:
    model = one_triangle(COLOR_0=np.zeros((3, 3), "f4"))
    model.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}})
    colors = only(model, tmp_path).colors
    assert colors is not None
    assert colors[:, 0].tolist() == [0, 0, 0, 1, 1, 1]


def test_normals_without_a_direction_are_repaired_and_missing_ones_are_flat(tmp_path: Path) -> None:
    broken = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 3]], "f4")
    assert only(one_triangle(NORMAL=broken), tmp_path).normals == pytest.approx(np.array([[0, 1, 0], [0, 1, 0], [0, 0, 1]]))
    model = square(indices=[0, 1, 2, 1, 3, 2])
    del model.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    primitive = only(model, tmp_path)
    assert primitive.positions.shape == (6, 3)
    assert primitive.normals == pytest.approx(np.tile([0, 0, 1], (6, 1)))


def with_normal_map(model: Model, **texture: Any) -> Model:
    model.json["meshes"][0]["primitives"][0]["material"] = model.add(
        "materials", normalTexture={**model.texture(BUMPS), **texture})
    return model


@pytest.mark.parametrize(("uv", "tangent"), [
    (UV, [1, 0, 0, 1]), (UV * [-1, 1], [-1, 0, 0, -1]), (UV[:, ::-1], [0, -1, 0, -1]), (UV * 0, None)])
def test_tangents_are_made_along_u_with_the_bitangent_up_the_picture(tmp_path: Path, uv: Any, tangent: Any) -> None:
    made = only(with_normal_map(square(mode=5, TEXCOORD_0=uv.astype("f4"))), tmp_path).tangents
    assert made is not None
    if tangent is None:
        assert np.linalg.norm(made[:, :3], axis=1) == pytest.approx(1)
    else:
        assert made == pytest.approx(np.tile(tangent, (4, 1)), abs=1e-6)


def test_tangents_of_the_file_are_kept_where_a_normal_map_needs_them(tmp_path: Path) -> None:
    given = np.tile([0, 2, 0, -1], (4, 1)).astype("f4")
    model = square(mode=5, TEXCOORD_0=UV, TANGENT=given)
    assert only(model, tmp_path).tangents is None
    assert only(with_normal_map(model), tmp_path).tangents == pytest.approx(np.tile([0, 1, 0, -1], (4, 1)))
    model.json["nodes"][0]["scale"] = [-1, 1, 1]       # seen in a mirror, the bitangent is on the other side
    assert only(model, tmp_path).tangents == pytest.approx(np.tile([0, 1, 0, 1], (4, 1)))
