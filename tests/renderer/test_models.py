"""Built-in meshes, and what of a static model becomes of which primitive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from renderer.models.gltf import GltfError, load, transform
from renderer.models.mesh import BUILT_IN, MAX_PROXY_TRIANGLES, Mesh, Primitive
from renderer.models.mesh_library import MeshLibrary
from tests.models import CORNERS, one_triangle, triangle

TEAPOT = Path(__file__).parents[2] / "renderer" / "models" / "builtin" / "teapot.glb"


@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_built_in_meshes_face_outwards_with_unit_normals_and_size_1(name: str) -> None:
    mesh = BUILT_IN[name]()
    (primitive,) = mesh.primitives
    corners = primitive.positions[primitive.triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", faces, corners.mean(axis=1)) > 0).all()
    assert (np.einsum("ij,ij->i", faces, primitive.normals[primitive.triangles[:, 0]]) > 0).all()
    assert np.linalg.norm(primitive.normals, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.ptp(primitive.positions, axis=0) == pytest.approx(1.0, abs=0.01)
    assert primitive.positions.mean(axis=0) == pytest.approx(0.0, abs=0.05)


def test_the_teapot_stands_on_the_ground_and_is_1_high() -> None:
    mesh = load(TEAPOT)
    positions = mesh.primitives[0].positions
    assert (positions[:, 1].min(), positions[:, 1].max()) == pytest.approx((0.0, 1.0), abs=0.01)
    points, triangles = mesh.proxy
    assert 50 < len(triangles) <= MAX_PROXY_TRIANGLES
    assert np.ptp(points, axis=0) == pytest.approx(np.ptp(positions, axis=0), rel=0.1)


def test_a_node_moves_its_mesh_and_a_missing_normal_is_made(tmp_path: Path) -> None:
    (tmp_path / "m.glb").write_bytes(triangle(nodes=[{"children": [1], "translation": [0, 5, 0]},
                                                     {"mesh": 0, "scale": [2, 2, 2]}]))
    (primitive,) = load(tmp_path / "m.glb").primitives
    assert primitive.positions.max(axis=0) == pytest.approx([2, 7, 0])
    assert primitive.normals == pytest.approx(np.tile([0, 0, 1], (3, 1)))


def test_a_mesh_library_names_what_is_missing(tmp_path: Path) -> None:
    library = MeshLibrary(lambda mesh: pytest.fail("nothing to upload"), tmp_path, None)
    with pytest.raises(GltfError, match=r"gone.glb' does not exist"):
        library.get("asset:gone")
    with pytest.raises(GltfError, match="is a path"):
        library.get("model.glb")


def test_a_transform_applies_scale_then_rotation_then_translation() -> None:
    quarter_turn = (0, np.sqrt(0.5), 0, np.sqrt(0.5))   # +X goes to -Z
    matrix = transform((1, 2, 3), quarter_turn, (2, 1, 1))
    assert matrix @ [1, 0, 0, 1] == pytest.approx([1, 2, 1, 1])


def test_parts_of_one_material_are_one_primitive_in_the_order_of_the_scene(tmp_path: Path) -> None:
    model = one_triangle()
    model.json["meshes"][0]["primitives"].append({**model.json["meshes"][0]["primitives"][0], "material": model.add("materials")})
    model.json.update(nodes=[{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 3]}], scenes=[{"nodes": [1, 0]}])
    mesh = model.load(tmp_path)
    assert [len(primitive.triangles) for primitive in mesh.primitives] == [2, 2]
    assert mesh.primitives[0].positions[:, 2] == pytest.approx([3, 3, 3, 0, 0, 0])
    assert not mesh.is_animated
    assert mesh.clips == ()


def test_a_mirrored_part_still_faces_outwards(tmp_path: Path) -> None:
    for normals in ({}, {"NORMAL": [[0, 0, 1]] * 3}):
        model = one_triangle(**normals)
        model.json["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
        (primitive,) = model.load(tmp_path).primitives
        a, b, c = primitive.positions[primitive.triangles[0]]
        assert np.cross(b - a, c - a) == pytest.approx([0, 0, 1])
        assert primitive.normals == pytest.approx(np.tile([0, 0, 1], (3, 1)))


def test_a_part_that_a_scale_makes_a_point_is_left_out_and_one_that_becomes_flat_is_kept(tmp_path: Path) -> None:
    model = one_triangle()
    model.json.update(nodes=[{"mesh": 0, "scale": [0, 0, 0]}, {"mesh": 0, "scale": [1, 1, 0]}], scenes=[{"nodes": [0, 1]}])
    assert model.load(tmp_path).triangle_count == 1


def test_nodes_outside_the_scene_are_not_shown_and_matrices_are_in_column_order(tmp_path: Path) -> None:
    model = one_triangle()
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    model.json.update(nodes=[{"mesh": 0, "matrix": matrix.T.ravel().tolist()}, {"mesh": 0}])
    (primitive,) = model.load(tmp_path).primitives
    assert primitive.positions == pytest.approx(CORNERS + np.array([1, 2, 3]))


def test_a_mesh_of_parts_in_one_place_has_a_proxy() -> None:
    part = Primitive(CORNERS, CORNERS, CORNERS[:, :2], np.tile(np.array([[0, 1, 2], [0, 2, 1]], "i4"), (400, 1)))
    for mesh in (Mesh((part,)), Mesh((replace(part, positions=CORNERS * 0),))):
        assert 0 < len(mesh.proxy[1]) <= 128
        assert np.isfinite(mesh.outline).all()


def test_the_proxies_are_few_triangles_of_the_same_size() -> None:
    sphere = BUILT_IN["sphere"]()
    for (points, triangles), most in ((sphere.proxy, 128), (sphere.fine_proxy, 500)):
        assert most / 2 < len(triangles) <= most
        assert np.linalg.norm(points, axis=1) == pytest.approx(0.5, abs=0.05)
