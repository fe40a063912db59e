"""Models as they are drawn: their textures, colours and transparency, their clips, and real things in front of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline, Rendered
from renderer.scene import Scene
from tests.models import Model
from tests.renderer.frames import sky_with_sun

SIZE = (512, 256)
FLAT = np.full((4, 4, 3), (128, 128, 255), dtype=np.uint8)
WHITE = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}


def quad(material: dict[str, Any], *, model: Model | None = None, **attributes: Any) -> Model:
    """A square of edge 2 in the plane z = 0 that faces +Z; u grows to the right, v downwards."""
    model = model or Model()
    points = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    found = {"POSITION": points, "NORMAL": [[0, 0, 1]] * 4, "TEXCOORD_0": [[0, 1], [1, 1], [1, 0], [0, 0]], **attributes}
    model.show({"attributes": {name: model.accessor(values) for name, values in found.items()},
                "indices": model.accessor(np.array([0, 1, 2, 0, 2, 3], "u2")), "material": model.add("materials", **material)})
    return model


def drawn(context: Context, folder: Path, model: Model, frame: RadianceFrame | None = None, moment: float | None = None,
          local_scene: tuple[dict[str, Any], ...] = (), **members: Any) -> Rendered:
    """The model two metres ahead in a sky of radiance 1, without a ground."""
    (folder / "m.glb").write_bytes(model.bytes())
    frame = frame or RadianceFrame(np.ones((SIZE[1], SIZE[0], 3), dtype=np.float32))
    scene = Scene.model_validate({"ground": {"catcher": False}, "local_scene": local_scene, "objects": [
        {"id": "model", "mesh": "m.glb", "position": [0, 0, -2], **members}]}, context={"allow_mesh_paths": True})
    pipeline = Pipeline(context, RadianceFrame, SIZE, mesh_root=folder)
    try:
        return pipeline.render(frame, scene, moment=moment)
    finally:
        pipeline.release()
        context.collect()


def middle(rendered: Rendered, across: float = 0.0) -> np.ndarray[Any, Any]:
    """Mean radiance of a few pixels ahead, `across` metres to the right on the plane two metres away."""
    assert isinstance(rendered.frame, RadianceFrame)
    column = round(SIZE[0] * (0.5 + np.arctan2(across, 2.0) / (2 * np.pi)))
    return rendered.frame.rgb[122:134, column - 4:column + 4].mean(axis=(0, 1))


def test_a_texture_is_read_where_its_coordinates_say_and_as_srgb(context: Context, tmp_path: Path) -> None:
    picture = np.zeros((8, 8, 3), dtype=np.uint8)
    picture[:, :4, 0], picture[:, 4:, 1] = 188, 255     # red of half the light on the left, green on the right
    model = Model()
    model = quad({"pbrMetallicRoughness": {"baseColorTexture": model.texture(picture), "metallicFactor": 0.0}}, model=model)
    found = drawn(context, tmp_path, model)
    left, right = middle(found, -0.5), middle(found, 0.5)
    assert left[0] == pytest.approx(0.5, abs=0.05)
    assert left[0] > 5 * left[1]
    assert right[1] == pytest.approx(1.0, abs=0.05)
    assert right[1] > 5 * right[0]


@pytest.mark.parametrize(("wrap", "expected"), [(10497, [1, 0, 1, 0]), (33648, [1, 0, 0, 1]), (33071, [1, 0, 0, 0])])
def test_a_texture_repeats_as_its_sampler_says(context: Context, tmp_path: Path, wrap: int, expected: list[int]) -> None:
    """Bright on its left half, laid twice across: repeated, mirrored, or its last column over and over."""
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    picture[:, :8] = 255
    model = Model()
    texture = model.texture(picture, sampler=model.add("samplers", wrapS=wrap, wrapT=wrap))
    model = quad({"pbrMetallicRoughness": {"baseColorTexture": texture, "metallicFactor": 0.0},
                  "extensions": {"KHR_materials_unlit": {}}}, model=model, TEXCOORD_0=[[0, 1], [2, 1], [2, 0], [0, 0]])
    found = drawn(context, tmp_path, model)
    assert [middle(found, across)[1] for across in (-0.75, -0.25, 0.25, 0.75)] == pytest.approx(expected, abs=0.03)


def coated(strength: float, **base: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": base, "extensions": {"KHR_materials_clearcoat": {
        "clearcoatFactor": strength, "clearcoatRoughnessFactor": 0.2}}}


def test_a_clear_coat_adds_no_energy_and_reflects_as_a_dielectric(context: Context, tmp_path: Path) -> None:
    for roughness in (0.3, 0.8):        # a white furnace, under the coat a white metal
        white = quad(coated(1.0, metallicFactor=1.0, roughnessFactor=roughness))
        assert middle(drawn(context, tmp_path, white)) == pytest.approx([1.0] * 3, abs=0.03)
    black = {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 1.0, "roughnessFactor": 1.0}
    dark = middle(drawn(context, tmp_path, quad(coated(0.0, **black))))
    for strength in (0.5, 1.0):         # seen from straight ahead: the reflectance of glass
        found = middle(drawn(context, tmp_path, quad(coated(strength, **black))))
        assert found - dark == pytest.approx([0.04 * strength] * 3, abs=0.008)


def test_a_clear_coat_has_a_highlight_of_its_own(context: Context, tmp_path: Path) -> None:
    sun = sky_with_sun(180, 0, size=SIZE, sky=0.0, radius_deg=3.0)     # behind the camera: mirrored straight ahead
    matte = {"baseColorFactor": [0.2, 0.2, 0.2, 1], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    plain, shiny = (middle(drawn(context, tmp_path, quad(coated(strength, **matte)), sun)) for strength in (0.0, 1.0))
    assert (shiny > 2 * plain).all()


def test_vertex_colours_are_factors(context: Context, tmp_path: Path) -> None:
    model = quad({"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 1, 1], "metallicFactor": 0.0}},
                 COLOR_0=[[1, 1, 0, 1]] * 4)
    red, green, blue = middle(drawn(context, tmp_path, model))
    assert red == pytest.approx(1.0, abs=0.03)
    assert green == pytest.approx(0.5, abs=0.06)
    assert blue < 0.1


def test_an_unlit_surface_has_its_colour_in_any_light(context: Context, tmp_path: Path) -> None:
    material = {**WHITE, "pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.8, 1]}, "extensions": {"KHR_materials_unlit": {}}}
    for frame in (None, sky_with_sun(180, 30, size=SIZE), RadianceFrame(np.zeros((SIZE[1], SIZE[0], 3), dtype=np.float32))):
        assert middle(drawn(context, tmp_path, quad(material), frame)) == pytest.approx([0.2, 0.4, 0.8], abs=0.01)


@pytest.mark.parametrize(("alpha", "mode", "expected"), [(0.5, "BLEND", 0.75), (0.25, "BLEND", 0.875), (0.3, "MASK", 1.0),
                                                         (0.7, "MASK", 0.5), (0.3, "OPAQUE", 0.5)])
def test_what_shines_through(context: Context, tmp_path: Path, alpha: float, mode: str, expected: float) -> None:
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, alpha]}, "alphaMode": mode,
                "extensions": {"KHR_materials_unlit": {}}}
    found = drawn(context, tmp_path, quad(material))
    assert middle(found) == pytest.approx([expected] * 3, abs=0.03)
    assert middle(found, 0.5) == pytest.approx([expected] * 3, abs=0.03)


def test_a_normal_map_turns_the_surface_towards_the_light(context: Context, tmp_path: Path) -> None:
    sun = sky_with_sun(-90, 0, size=SIZE, sky=0.0)      # from the left, along the quad
    right, left = FLAT.copy(), FLAT.copy()
    right[..., 0], left[..., 0] = 220, 36
    brightness = {}
    for name, picture in (("flat", FLAT), ("right", right), ("left", left)):
        model = Model()
        model = quad({**WHITE, "normalTexture": model.texture(picture)}, model=model)
        brightness[name] = float(middle(drawn(context, tmp_path, model, sun)).mean())
    plain = float(middle(drawn(context, tmp_path, quad(WHITE), sun)).mean())
    assert brightness["flat"] == pytest.approx(plain, rel=0.05, abs=1e-3)
    assert brightness["left"] > 5 * max(brightness["right"], 1e-3)
    assert brightness["left"] > 3 * max(plain, 1e-3)


def test_occlusion_takes_ambient_light_by_its_strength(context: Context, tmp_path: Path) -> None:
    dark = np.zeros((4, 4, 3), dtype=np.uint8)
    model = Model()
    model = quad({**WHITE, "occlusionTexture": {**model.texture(dark), "strength": 0.6}}, model=model)
    assert middle(drawn(context, tmp_path, model)) == pytest.approx([0.4] * 3, abs=0.03)


def walking() -> Model:
    """The unlit quad, which the clip 'go' takes 1 m to the right within a second."""
    model = quad({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "extensions": {"KHR_materials_unlit": {}}})
    model.json["nodes"][0]["scale"] = [0.3, 0.3, 0.3]
    model.clip(0, "translation", [0.0, 1.0], [[0, 0, 0], [1, 0, 0]], name="go")
    return model


@pytest.mark.parametrize(("moment", "speed", "loop", "across"), [
    (0.0, 1.0, True, 0.0), (1.0, 0.5, True, 0.5), (2.75, 1.0, True, 0.75), (9.0, 1.0, False, 1.0), (None, 1.0, True, 0.0)])
def test_a_clip_is_played_by_the_streams_clock(context: Context, tmp_path: Path, moment: float | None, speed: float, loop: bool,
                                               across: float) -> None:
    found = drawn(context, tmp_path, walking(), moment=moment, animation={"clip": "go", "speed": speed, "loop": loop})
    assert not found.errors
    assert middle(found, across) == pytest.approx([0.0] * 3, abs=0.02)
    assert middle(found, across - 0.9) == pytest.approx([1.0] * 3)


def test_a_clip_that_is_not_there_is_reported_and_the_model_rests(context: Context, tmp_path: Path) -> None:
    found = drawn(context, tmp_path, walking(), moment=1.0, animation={"clip": "fly"})
    assert "'fly'" in found.errors["model"]
    assert "go" in found.errors["model"]
    assert middle(found) == pytest.approx([0.0] * 3, abs=0.02)


def test_successive_moments_are_each_shown(context: Context, tmp_path: Path) -> None:
    (tmp_path / "m.glb").write_bytes(walking().bytes())
    scene = Scene.model_validate({"objects": [
        {"id": "model", "mesh": "m.glb", "position": [0, 0, -2], "animation": {"clip": "go"}},
        {"id": "still", "mesh": "box", "position": [0, -1.1, 3]}]}, context={"allow_mesh_paths": True})
    pipeline = Pipeline(context, RadianceFrame, SIZE, mesh_root=tmp_path)
    frame, light = RadianceFrame(np.ones((SIZE[1], SIZE[0], 3), dtype=np.float32)), None
    for moment in (0.0, 0.25, 0.75, 0.5):
        found = pipeline.render(frame, scene, moment=moment, light=light)
        light = found.light
        assert middle(found, moment) == pytest.approx([0.0] * 3, abs=0.02)
        assert middle(found, moment - 0.7) == pytest.approx([1.0] * 3)
    pipeline.release()


def test_a_real_thing_in_front_hides_an_object_and_is_not_seen(context: Context, tmp_path: Path) -> None:
    post = {"id": "post", "mesh": "box", "position": [0.5, 0, -1.5], "scale": [0.3, 3, 0.1], "role": "occluder"}
    behind = {**post, "id": "wall", "position": [0.0, 0, -3.0], "scale": [9, 3, 0.1]}
    found = drawn(context, tmp_path, quad({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
                                           "extensions": {"KHR_materials_unlit": {}}}), local_scene=(post, behind))
    assert not found.errors
    assert middle(found, -0.5) == pytest.approx([0.0] * 3, abs=0.02)
    assert middle(found, 0.5 * 2 / 1.5) == pytest.approx([1.0] * 3)
