"""Models that strangers could send to do harm, or have made badly: each is refused by the part that is wrong."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from renderer.models.gltf import GltfError, document, load, model, primitives
from tests.models import bent_bar, glb, one_triangle, triangle

POSITIONS = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
INDICES = {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}
SHOWN = {"attributes": {"POSITION": 0}, "indices": 1}


def refused(folder: Path, data: bytes, complaint: str) -> None:
    (folder / "m.glb").write_bytes(data)
    with pytest.raises(GltfError, match=complaint) as caught:
        load(folder / "m.glb")
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(("changes", "complaint"), [
    ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "requires KHR_draco_mesh_compression, which is not supported"),
    ({"nodes": [{"mesh": 7}]}, "node 0: mesh 7 does not exist, the model has 1"),
    ({"nodes": [{"mesh": -1}]}, "node 0: mesh -1 does not exist"),
    ({"nodes": [{"children": [0]}]}, "node 0: is in a cycle"),
    ({"nodes": [{"children": [1, 2]}, {"children": [2]}, {}]}, "node 2: is a child of node 0 and of node 1, expected one parent"),
    ({"nodes": [{"children": [1, 1]}, {}]}, "node 1: is a child of node 0 and of node 0"),
    ({"nodes": [{"mesh": 0, "scale": [1, 1]}]}, r"node 0: scale is \[1, 1\], expected 3 numbers"),
    ({"nodes": [{"mesh": 0, "matrix": [1] * 15}]}, "node 0: matrix"),
    ({"nodes": [{"mesh": 0, "translation": [1e300, 0, 0]}, {"children": [0], "scale": [1e9] * 3}]}, "positions in the scene reach"),
    ({"accessors": [{**POSITIONS, "count": 999}, INDICES]}, "mesh 0 primitive 0 POSITION: accessor 0 has 999 .* ends outside"),
    ({"accessors": [{**POSITIONS, "count": 10**9}, INDICES]}, "model has 1000000000 vertices or more, expected at most 1500000"),
    ({"accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}, INDICES]}, "model has 1000000000 vertices"),
    ({"accessors": [POSITIONS, {"componentType": 5123, "count": 10**9, "type": "SCALAR"}]}, "model has 333333333 triangles"),
    ({"accessors": [{**POSITIONS, "count": 0}, INDICES]}, "accessor 0 has 0 elements"),
    ({"accessors": [{**POSITIONS, "count": -1}, INDICES]}, "count is -1, expected a whole number"),
    ({"accessors": [{**POSITIONS, "type": "MAT3"}, INDICES]}, "accessor 0 is of type 'MAT3', expected VEC3"),
    ({"accessors": [{**POSITIONS, "componentType": 5130}, INDICES]}, "component type 5130, expected one of 5120"),
    ({"accessors": [POSITIONS, {**INDICES, "componentType": 5122}]}, "indices are int16, expected unsigned"),
    ({"bufferViews": [{"buffer": 0, "byteLength": 3600}, {"buffer": 0, "byteLength": 6}]}, "buffer view 0 .* ends outside"),
    ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteStride": 1}, {"buffer": 0, "byteLength": 6}]}, "12 bytes every 1"),
    ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteStride": 1 << 63}, {"buffer": 0, "byteLength": 6}]}, "at most 252"),
    ({"buffers": [{"byteLength": 44, "uri": "../../etc/passwd"}]}, "buffer 0: uri '../../etc/passwd' leads outside the file"),
    ({"buffers": [{"byteLength": 4400}]}, "buffer 0 names 4400 bytes, it has 44"),
    ({"meshes": [{"primitives": [{"attributes": {}, "indices": 1}]}]}, "mesh 0 primitive 0: has no POSITION"),
    ({"meshes": [{"primitives": [{**SHOWN, "material": 3}]}]}, "material 3 does not exist, the model has 0"),
    ({"meshes": [{"primitives": [{**SHOWN, "targets": [{"POSITION": 1}]}]}]}, "target 0 POSITION: accessor 1 is of type 'SCALAR'"),
    ({"scenes": [{"nodes": []}]}, "no triangles"), ({"scene": 4}, "scene 4 does not exist"),
    ({"asset": {"version": "1.0"}}, "asset version is '1.0', expected '2.0'"),
    ({"nodes": "none"}, "another type than expected")])
def test_a_broken_model_is_refused_by_part(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    refused(tmp_path, triangle(**changes), complaint)


@pytest.mark.parametrize(("data", "complaint"), [
    (b"", "it has 0 bytes, expected a header of 12"), (b"x" * 20, "it begins with b'xxxx'"),
    (struct.pack("<4sII", b"glTF", 1, 12), "version 1, expected b'glTF' version 2"),
    (triangle()[:-1], "its header names .* bytes, the file has"),
    (struct.pack("<4sII", b"glTF", 2, 12), "no chunk"), (struct.pack("<4sIII", b"glTF", 2, 16, 0), "a chunk begins 4 bytes before"),
    (struct.pack("<4sIII4s", b"glTF", 2, 20, 4000, b"JSON"), "names 4000 bytes, expected at most the 0"),
    (struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"), r"its first chunk is b'BIN\\x00', expected b'JSON'"),
    (glb({"asset": {"version": "2.0"}, "extras": float("nan")}), "NaN is not a number")])
def test_a_broken_container_is_refused(tmp_path: Path, data: bytes, complaint: str) -> None:
    refused(tmp_path, data, f"model 'm.glb' is not glTF 2.0: .*{complaint}")


def container(text: str) -> bytes:
    data = text.encode()
    data += b" " * (-len(data) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(data), len(data), b"JSON") + data


def test_deep_or_endless_json_is_refused(tmp_path: Path) -> None:
    refused(tmp_path, container("[" * 100_000), "its JSON cannot be read")
    refused(tmp_path, container("[" + "{}," * document.MAX_JSON_VALUES + "{}]"), "its JSON has about .* values, expected at most")
    refused(tmp_path, container('{"asset": {"version": "2.0"}, "scene": ' + "9" * 5000 + "}"), "its JSON cannot be read")


@pytest.mark.parametrize("kind", sorted(document.MAX_ITEMS))
def test_the_number_of_items_is_bounded(tmp_path: Path, kind: str) -> None:
    most = document.MAX_ITEMS[kind]
    data = glb({"asset": {"version": "2.0"}, kind: [{}] * (most + 1)})
    refused(tmp_path, data, f"has {most + 1} {kind}, expected at most {most}")


def test_indices_and_positions_are_checked(tmp_path: Path) -> None:
    indices, corner = np.array([0, 1, 2], "u2"), np.array([1, 0, 0], "f4")
    for old, new, complaint in ((indices, [0, 1, 9], "index 9, expected less than its 3"),
                                (corner, [np.nan, 0, 0], "POSITION has values that are not finite"),
                                (corner, [np.inf, 0, 0], "POSITION has values that are not finite"),
                                (corner, [2e30, 0, 0], r"POSITION has 2e\+30, expected at most 1e\+09")):
        refused(tmp_path, triangle().replace(old.tobytes(), np.array(new, old.dtype).tobytes(), 1), complaint)


def test_triangles_vertices_and_parts_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    big = one_triangle()
    big.json["accessors"].append({"componentType": 5123, "count": 3 * primitives.MAX_TRIANGLES + 3, "type": "SCALAR"})
    big.json["meshes"][0]["primitives"][0]["indices"] = 1
    refused(tmp_path, big.bytes(), "model has 500001 triangles or more, expected at most 500000")
    big.json["accessors"][1]["count"] = 30_000
    big.json["nodes"] = [{"mesh": 0} for _ in range(51)]
    big.json["scenes"] = [{"nodes": list(range(51))}]
    refused(tmp_path, big.bytes(), "model has 510000 triangles or more, expected at most 500000")


def test_vertices_that_move_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "MAX_MOVING_VERTICES", 5)
    refused(tmp_path, bent_bar().bytes(), "model has 6 vertices that move, expected at most 5")


def test_morph_targets_are_bounded_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(primitives, "MAX_MORPHED_VERTICES", 10)
    many = one_triangle()
    many.json["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}] * 4
    refused(tmp_path, many.bytes(), "4 morph targets of 3 vertices, with them 12 vertices are morphed, expected at most 10")


def test_the_number_of_morph_targets_is_bounded(tmp_path: Path) -> None:
    many = one_triangle()
    many.json["meshes"][0]["primitives"][0]["targets"] = [{}] * 513
    refused(tmp_path, many.bytes(), "mesh 0 primitive 0: has 513 morph targets, expected at most 512")


def test_a_hierarchy_is_at_most_256_deep(tmp_path: Path) -> None:
    deep = one_triangle()
    deep.json["nodes"] = [*({"children": [index + 1]} for index in range(256)), {"mesh": 0}]
    refused(tmp_path, deep.bytes(), "node 256: is 257 levels deep, expected at most 256")


def skinned(**attributes: Any) -> bytes:
    bar = bent_bar()
    of = bar.json["meshes"][0]["primitives"][0]["attributes"]
    of.update({name: bar.accessor(values) for name, values in attributes.items()})
    return bar.bytes()


def test_skins_are_checked(tmp_path: Path) -> None:
    refused(tmp_path, skinned(JOINTS_0=np.array([[0, 2, 0, 0]] * 6, "u1")), "joint 2, expected less than the 2 of skin 0")
    refused(tmp_path, skinned(JOINTS_0=np.array([[0, 1, 0, 0]] * 5, "u1")), "JOINTS_0 has 5 elements of uint8, expected 6")
    refused(tmp_path, skinned(WEIGHTS_0=np.zeros((6, 4), "f4")), "the weights of vertex 0 sum to 0, expected 1")
    refused(tmp_path, skinned(WEIGHTS_0=np.full((6, 4), np.nan, "f4")), "WEIGHTS_0 has values that are not finite")
    bar = bent_bar()
    bar.json["skins"][0]["joints"] = [1, 2, 1]
    refused(tmp_path, bar.bytes(), "skin 0: has 2 inverse bind matrices for 3 joints")
    bar.json["skins"][0]["joints"] = [1, 8]
    refused(tmp_path, bar.bytes(), "skin 0 joints: node 8 does not exist, the model has 3")
    bar.json["nodes"][0]["skin"] = 4
    refused(tmp_path, bar.bytes(), "node 0: skin 4 does not exist, the model has 1")


@pytest.mark.parametrize(("change", "complaint"), [
    ({"target": {"node": 9, "path": "rotation"}}, "animation 0 channel 0: node 9 does not exist"),
    ({"target": {"node": 2, "path": "shape"}}, "path is 'shape', expected translation"),
    ({"sampler": 1}, "sampler 1 does not exist, the model has 1")])
def test_channels_are_checked(tmp_path: Path, change: dict[str, Any], complaint: str) -> None:
    bar = bent_bar()
    bar.json["animations"][0]["channels"][0].update(change)
    refused(tmp_path, bar.bytes(), complaint)


def test_a_node_is_animated_once_by_a_clip_and_has_no_matrix_then(tmp_path: Path) -> None:
    bar = bent_bar()
    bar.json["animations"][0]["channels"] *= 2
    refused(tmp_path, bar.bytes(), "animation 0 channel 1: rotation of node 2 has a channel already")
    bar = bent_bar()
    bar.json["nodes"][2] = {"matrix": np.eye(4).ravel().tolist()}
    refused(tmp_path, bar.bytes(), "node 2 has a matrix, expected translation, rotation and scale")


def everything() -> bytes:
    """A small model that has a little of all that the loader reads."""
    rich = bent_bar()
    attributes = rich.json["meshes"][0]["primitives"][0]["attributes"]
    attributes.update(TEXCOORD_0=rich.accessor(np.zeros((6, 2), "f4")), COLOR_0=rich.accessor(np.ones((6, 3), "f4")))
    rich.json["meshes"][0]["primitives"][0].update(
        targets=[{"POSITION": rich.accessor(np.ones((6, 3), "f4"))}],
        material=rich.add("materials", normalTexture=rich.texture(np.zeros((2, 2, 3), "u1"))))
    rich.clip(0, "weights", [0, 1], [0, 1])
    return rich.bytes()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=12), st.one_of(st.none(), st.integers(0, 4000)))
def test_no_mutation_of_a_model_crashes_the_loader(tmp_path: Path, place: float, patch: bytes, cut: int | None) -> None:
    data = bytearray(everything())
    offset = int(place * len(data))
    data[offset:offset + len(patch)] = patch
    (tmp_path / "m.glb").write_bytes(bytes(data[:cut]))
    try:
        mesh = load(tmp_path / "m.glb")
    except GltfError:
        return
    for clip in (None, *mesh.clips):
        assert all(np.isfinite(part.positions).all() and np.isfinite(part.normals).all()
                   for part in mesh.pose(clip, 0.3).primitives)
