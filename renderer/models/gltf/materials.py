"""A model's materials as surfaces, with the extensions that change what the renderer draws."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pygltflib

from renderer.models.gltf.document import GltfError, extension, item, number, numbers, printable, shown
from renderer.models.gltf.images import Images
from renderer.models.mesh import Slot, Surface, Texture, TextureMapping

_ALPHA_MODES: dict[Any, Literal["opaque", "mask", "blend"]] = {
    None: "opaque", "OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
DEFAULT_CUTOFF = 0.5


def surface(document: Any, index: int | None, images: Images) -> Surface:
    """The material as a surface; without one, the default that glTF names."""
    if index is None:
        return Surface(base_color=(1.0, 1.0, 1.0, 1.0), metallic=1.0, roughness=1.0)
    part = f"material {index}"
    material = item(document.materials, index, "material", "mesh")
    pbr = material.pbrMetallicRoughness or pygltflib.PbrMetallicRoughness()
    mode = material.alphaMode if isinstance(material.alphaMode, (str, type(None))) else ""
    if mode not in _ALPHA_MODES:
        raise GltfError(f"{part}: alphaMode is {shown(mode)}, expected OPAQUE, MASK or BLEND")
    infos: dict[Slot, Any] = {
        "base_color": pbr.baseColorTexture, "metallic_roughness": pbr.metallicRoughnessTexture,
        "normal": material.normalTexture, "occlusion": material.occlusionTexture, "emissive": material.emissiveTexture}
    textures: dict[str, Texture | None] = {}
    mappings: dict[Slot, TextureMapping] = {}
    for slot, info in infos.items():
        textures[f"{slot}_texture"] = texture = images.texture(info.index, f"{part} {slot}") if info is not None else None
        if texture is not None and (mapping := _mapping(info, images, f"{part} {slot}")) != TextureMapping():
            mappings[slot] = mapping
    r, g, b, a = numbers(pbr.baseColorFactor or [1, 1, 1, 1], 4, "baseColorFactor", part, 0, 1)
    coat = extension(material, "KHR_materials_clearcoat", part) or {}
    return Surface(
        base_color=(r, g, b, a), metallic=number(pbr.metallicFactor, "metallicFactor", part, 1, 0, 1),
        roughness=number(pbr.roughnessFactor, "roughnessFactor", part, 1, 0, 1), emissive=_emissive(material, part),
        double_sided=bool(material.doubleSided), alpha_mode=_ALPHA_MODES[mode],
        alpha_cutoff=number(material.alphaCutoff, "alphaCutoff", part, DEFAULT_CUTOFF) if mode == "MASK" else None,
        normal_scale=number(getattr(infos["normal"], "scale", None), "normal scale", part, 1),
        occlusion_strength=number(getattr(infos["occlusion"], "strength", None), "occlusion strength", part, 1, 0, 1),
        unlit=extension(material, "KHR_materials_unlit", part) is not None,
        clearcoat=number(coat.get("clearcoatFactor"), "clearcoatFactor", part, 0, 0, 1),
        clearcoat_roughness=number(coat.get("clearcoatRoughnessFactor"), "clearcoatRoughnessFactor", part, 0, 0, 1),
        mappings=mappings, **textures)


def _emissive(material: Any, part: str) -> tuple[float, float, float]:
    strength = (extension(material, "KHR_materials_emissive_strength", part) or {}).get("emissiveStrength")
    factor = number(strength, "emissiveStrength", part, 1, 0)
    r, g, b = numbers(material.emissiveFactor or [0, 0, 0], 3, "emissiveFactor", part, 0)
    return r * factor, g * factor, b * factor


def _mapping(info: Any, images: Images, part: str) -> TextureMapping:
    transform = extension(info, "KHR_texture_transform", part) or {}
    uv_set = transform.get("texCoord", info.texCoord or 0)
    if uv_set not in (0, 1):
        raise GltfError(f"{part}: reads texture coordinates {printable(shown(uv_set))}, expected set 0 or 1")
    u, v = numbers(transform.get("offset", [0, 0]), 2, "offset", part)
    across, down = numbers(transform.get("scale", [1, 1]), 2, "scale", part)
    angle = number(transform.get("rotation"), "rotation", part, 0)
    c, s = float(np.cos(angle)), float(np.sin(angle))
    matrix = ((c * across, s * down, u), (-s * across, c * down, v))
    wrap, nearest = images.sampling(info.index, part)
    return TextureMapping(int(uv_set), matrix, wrap, nearest)
