"""Built-in meshes, and models from strangers."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from renderer.gltf import GltfError, load, transform
from renderer.mesh import BUILT_IN, MAX_PROXY_TRIANGLES
from renderer.mesh_library import MeshLibrary

TEAPOT = Path(__file__).parents[2] / "renderer" / "meshes" / "teapot.glb"


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


def glb(document: dict[str, Any], binary: bytes = b"") -> bytes:
    body = json.dumps(document).encode()
    body += b" " * (-len(body) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(body), b"JSON") + body + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle(**changes: Any) -> bytes:
    """One triangle; `changes` replace top-level members of its JSON."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
    indices = np.array([0, 1, 2], "u2")
    document: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
        "buffers": [{"byteLength": 44}], **changes}
    return glb(document, positions.tobytes() + indices.tobytes())


def test_a_node_moves_its_mesh_and_a_missing_normal_is_made(tmp_path: Path) -> None:
    (tmp_path / "m.glb").write_bytes(triangle(nodes=[{"children": [1], "translation": [0, 5, 0]},
                                                     {"mesh": 0, "scale": [2, 2, 2]}]))
    (primitive,) = load(tmp_path / "m.glb").primitives
    assert primitive.positions.max(axis=0) == pytest.approx([2, 7, 0])
    assert primitive.normals == pytest.approx(np.tile([0, 0, 1], (3, 1)))


@pytest.mark.parametrize(("changes", "complaint"), [
    ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "requires KHR_draco_mesh_compression"),
    ({"nodes": [{"mesh": 7}]}, "mesh 7 does not exist"),
    ({"nodes": [{"children": [0]}]}, "cycle"),
    ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 999, "type": "VEC3"},
                    {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}]}, "ends outside"),
    ({"bufferViews": [{"buffer": 0, "byteLength": 3600}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}]}, "ends outside"),
    ({"buffers": [{"byteLength": 44, "uri": "../../etc/passwd"}]}, "leads outside the file"),
    ({"meshes": [{"primitives": [{"attributes": {}, "indices": 1}]}]}, "POSITION"),
    ({"scenes": [{"nodes": []}]}, "no triangles")])
def test_a_broken_model_is_refused_by_part(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    (tmp_path / "m.glb").write_bytes(triangle(**changes))
    with pytest.raises(GltfError, match=complaint):
        load(tmp_path / "m.glb")


def test_an_index_out_of_range_and_a_nan_are_refused(tmp_path: Path) -> None:
    for old, new, complaint in ((np.array([0, 1, 2], "u2"), np.array([0, 1, 9], "u2"), "index 9"),
                                (np.array([1, 0, 0], "f4"), np.array([np.nan, 0, 0], "f4"), "not finite")):
        (tmp_path / "m.glb").write_bytes(triangle().replace(old.tobytes(), new.tobytes(), 1))
        with pytest.raises(GltfError, match=complaint):
            load(tmp_path / "m.glb")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 400), st.binary(min_size=1, max_size=12), st.one_of(st.none(), st.integers(0, 900)))
def test_no_mutation_of_a_model_crashes_the_loader(tmp_path: Path, offset: int, patch: bytes, cut: int | None) -> None:
    data = bytearray(triangle())
    data[offset:offset + len(patch)] = patch
    (tmp_path / "m.glb").write_bytes(bytes(data[:cut]))
    try:
        mesh = load(tmp_path / "m.glb")
    except GltfError:
        return
    assert all(np.isfinite(part.positions).all() for part in mesh.primitives)


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
