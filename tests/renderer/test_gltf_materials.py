"""How a file's materials become surfaces."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from renderer.models.gltf import GltfError, images
from renderer.models.mesh import Primitive, Surface, TextureMapping
from tests.models import Model, one_triangle, png

PICTURE = np.arange(48, dtype="u1").reshape(4, 4, 3)
UV = np.array([[0, 0], [1, 0], [0, 1]], "f4")


def primitive_of(folder: Path, model: Model) -> Primitive:
    (primitive,) = model.load(folder).primitives
    return primitive


def surface(folder: Path, material: dict[str, Any]) -> Surface:
    return primitive_of(folder, one_triangle(material)).surface


def test_the_defaults_are_those_of_gltf(tmp_path: Path) -> None:
    for made in (surface(tmp_path, {}), primitive_of(tmp_path, one_triangle()).surface):
        assert made == Surface(base_color=(1, 1, 1, 1), metallic=1, roughness=1)


def test_factors_and_extensions(tmp_path: Path) -> None:
    made = surface(tmp_path, {
        "pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 2], "metallicFactor": 0, "roughnessFactor": 0.25},
        "emissiveFactor": [1, 0.5, 0], "doubleSided": True, "alphaMode": "BLEND", "extensions": {
            "KHR_materials_emissive_strength": {"emissiveStrength": 4}, "KHR_materials_unlit": {},
            "KHR_materials_clearcoat": {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.1}}})
    assert made == Surface(base_color=(0.1, 0.2, 0.3, 1), metallic=0, roughness=0.25, emissive=(4, 2, 0), double_sided=True,
                           alpha_mode="blend", unlit=True, clearcoat=0.5, clearcoat_roughness=0.1)


@pytest.mark.parametrize(("material", "mode", "cutoff"), [
    ({}, "opaque", None), ({"alphaMode": "MASK"}, "mask", 0.5), ({"alphaMode": "MASK", "alphaCutoff": 0}, "mask", 0.0),
    ({"alphaMode": "BLEND", "alphaCutoff": 0.3}, "blend", None)])
def test_alpha_modes(tmp_path: Path, material: dict[str, Any], mode: str, cutoff: float | None) -> None:
    made = surface(tmp_path, material)
    assert (made.alpha_mode, made.alpha_cutoff) == (mode, cutoff)


def test_every_texture_has_its_slot_and_one_picture_is_decoded_once(tmp_path: Path) -> None:
    model = one_triangle({}, TEXCOORD_0=UV)
    info = model.texture(PICTURE)
    model.json["materials"][0].update(
        pbrMetallicRoughness={"baseColorTexture": info, "metallicRoughnessTexture": info}, emissiveTexture=info,
        normalTexture={**info, "scale": 2}, occlusionTexture={**info, "strength": 0.5})
    made = primitive_of(tmp_path, model).surface
    assert (made.normal_scale, made.occlusion_strength, made.mappings) == (2, 0.5, {})
    assert made.base_color_texture is not None
    assert (made.base_color_texture[..., :3] == PICTURE).all()
    for texture in (made.metallic_roughness_texture, made.emissive_texture, made.normal_texture, made.occlusion_texture):
        assert texture is made.base_color_texture


def moved_texture(model: Model, texture: dict[str, Any], texcoord: int = 0, **transform: Any) -> dict[str, Any]:
    return {**texture, "texCoord": texcoord, "extensions": {"KHR_texture_transform": transform}}


def test_a_transform_that_all_textures_share_is_in_the_vertices(tmp_path: Path) -> None:
    model = one_triangle({}, TEXCOORD_0=UV * 0, TEXCOORD_1=UV)
    info = moved_texture(model, model.texture(PICTURE), 1, offset=[0.5, 0], scale=[2, 4], rotation=np.pi / 2)
    model.json["materials"][0].update(pbrMetallicRoughness={"baseColorTexture": info}, emissiveTexture=info)
    primitive = primitive_of(tmp_path, model)
    # scaled, turned counter-clockwise in a picture whose v grows downwards (u becomes -v, v becomes u), then moved
    assert primitive.uvs == pytest.approx(np.array([[0.5, 0], [0.5, -2], [4.5, 0]]), abs=1e-6)
    assert primitive.uvs2 is None
    assert primitive.surface.mappings == {}


def test_textures_that_lie_differently_keep_their_mappings(tmp_path: Path) -> None:
    model = one_triangle({}, TEXCOORD_0=UV, TEXCOORD_1=UV * 3)
    info = model.texture(PICTURE)
    model.json["materials"][0].update(
        pbrMetallicRoughness={"baseColorTexture": info, "metallicRoughnessTexture": moved_texture(model, info, offset=[1, 2])},
        occlusionTexture={**info, "texCoord": 1})
    primitive = primitive_of(tmp_path, model)
    assert primitive.uvs == pytest.approx(UV)
    assert primitive.uvs2 == pytest.approx(UV * 3)
    assert primitive.surface.mappings == {
        "metallic_roughness": TextureMapping(matrix=((1, 0, 1), (0, 1, 2))), "occlusion": TextureMapping(uv_set=1)}


def test_samplers_say_how_a_texture_continues(tmp_path: Path) -> None:
    model = one_triangle({}, TEXCOORD_0=UV)
    model.json["samplers"] = [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]
    model.json["materials"][0]["emissiveTexture"] = model.texture(PICTURE, sampler=0)
    mappings = primitive_of(tmp_path, model).surface.mappings
    assert mappings == {"emissive": TextureMapping(wrap=("clamp", "mirror"), nearest=True)}
    model.json["samplers"][0]["wrapS"] = 1
    with pytest.raises(GltfError, match="sampler 0 wraps by 1"):
        model.load(tmp_path)


def test_a_grey_picture_of_16_bits_keeps_its_greys(tmp_path: Path) -> None:
    model = one_triangle({}, TEXCOORD_0=UV)
    model.json["materials"][0]["occlusionTexture"] = model.texture(np.array([[0x1234, 0xfedc]], "u2"))
    texture = primitive_of(tmp_path, model).surface.occlusion_texture
    assert texture is not None
    assert texture.tolist() == [[[0x12, 0x12, 0x12, 255], [0xfe, 0xfe, 0xfe, 255]]]


def with_emission(texture: Any, **members: Any) -> Model:
    model = one_triangle({"emissiveTexture": texture}, TEXCOORD_0=UV)
    model.json.update(members)
    return model


@pytest.mark.parametrize(("model", "complaint"), [
    (with_emission({"index": 3}), "material 0 emissive: texture 3 does not exist, the model has 0"),
    (with_emission({"index": -1}, textures=[{}]), "texture -1 does not exist, the model has 1"),
    (with_emission({"index": 0}, textures=[{"source": 2}]), "texture 0: image 2 does not exist, the model has 0"),
    (with_emission({"index": 0}, textures=[{"source": 0}], images=[{"uri": "wood.png"}]), "image 0: uri 'wood.png' leads outside"),
    (with_emission({"index": 0}, textures=[{"source": 0}], images=[{"bufferView": 0}]), "image 0 is not a PNG or JPEG"),
    (with_emission({"index": 0, "texCoord": 2}, textures=[{"source": 0}], images=[{"bufferView": 0}]), "image 0"),
    (one_triangle({"alphaMode": "GLASS"}), "material 0: alphaMode is 'GLASS', expected OPAQUE, MASK or BLEND"),
    (one_triangle({"emissiveFactor": [1, 2]}), r"material 0: emissiveFactor is \[1, 2\], expected 3 numbers"),
    (one_triangle({"emissiveFactor": [1, 2, None]}), "emissiveFactor is .*, expected finite numbers"),
    (one_triangle({"extensions": {"KHR_materials_clearcoat": 1}}), "KHR_materials_clearcoat is 1, expected an object")])
def test_a_broken_material_is_refused_by_part(tmp_path: Path, model: Model, complaint: str) -> None:
    with pytest.raises(GltfError, match=complaint):
        model.load(tmp_path)


@pytest.mark.parametrize(("side", "complaint"), [(4097, "image 0 is 4097x4097, expected at most 4096"),
                                                 (16384, "image 0 has more pixels than can be decoded, expected at most 4096")])
def test_a_texture_too_large_is_refused_by_its_header(tmp_path: Path, side: int, complaint: str) -> None:
    bomb = bytearray(png(np.zeros((1, 1, 3), "u1")))
    bomb[16:24] = side.to_bytes(4, "big") * 2
    bomb[29:33] = zlib.crc32(bomb[12:29]).to_bytes(4, "big")
    model = with_emission({"index": 0}, textures=[{"source": 0}], images=[{"bufferView": 2}])
    model.view(bytes(bomb))
    with pytest.raises(GltfError, match=complaint):
        model.load(tmp_path)


def test_all_textures_together_are_bounded_before_they_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "MAX_TEXTURE_BYTES", 100)
    model = one_triangle({}, TEXCOORD_0=UV)
    model.json["materials"][0].update(occlusionTexture=model.texture(PICTURE), emissiveTexture=model.texture(PICTURE))
    with pytest.raises(GltfError, match="image 1 is 4x4, with it the textures take 128 bytes, expected at most 100"):
        model.load(tmp_path)
