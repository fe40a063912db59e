from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from renderer.scene import STAGES, Lighting, Scene

DESIGN_EXAMPLE = {
    "camera_height": 1.6, "ground": {"catcher": True, "specular": 0.0, "roughness": 0.3},
    "local_scene": [{"id": "table", "mesh": "box", "position": [0, -1.0, -2], "rotation": [0, 0, 0, 1], "scale": [1, 0.1, 1],
                     "role": "catcher"}],
    "objects": [{"id": "teapot-1", "mesh": "teapot", "position": [0, -1.6, -3], "rotation": [0, 0, 0, 1], "scale": [0.4, 0.4, 0.4],
                 "material": {"base_color": [0.8, 0.8, 0.8], "metallic": 0.0, "roughness": 0.5, "emissive": [0, 0, 0]},
                 "visible": True, "casts_shadow": True, "animation": {"clip": "Run", "speed": 1.0, "loop": True}}],
    "lighting": {"preset": "default"}}


def test_the_contracts_example_is_a_scene_and_survives_the_way_through_json() -> None:
    scene = Scene.model_validate(DESIGN_EXAMPLE)
    assert Scene.model_validate_json(scene.model_dump_json()) == scene
    assert Scene() == Scene.model_validate({})


@pytest.mark.parametrize(("where", "value", "complaint"), [
    ("mesh", "dragon", "unknown mesh 'dragon'"), ("mesh", "../x.glb", "unknown mesh"), ("mesh", "asset:", "unknown mesh"),
    ("position", [float("nan"), 0, 0], "finite"), ("position", [0, 0], "Field required"), ("position", [1e9, 0, 0], "10000"),
    ("scale", [0, 1, 1], "scale is"), ("rotation", [0, 0, 0, 2], "quaternion length is 2"), ("id", "a b", "pattern"),
    ("material", {"roughness": 1.5}, "less than or equal to 1"), ("colour", "red", "Extra inputs")])
def test_a_bad_object_names_the_value(where: str, value: Any, complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        Scene.model_validate({"objects": [{"id": "a", "mesh": "box", **{where: value}}]})


def test_ids_are_unique_across_objects_and_surfaces() -> None:
    item = {"id": "a", "mesh": "box"}
    with pytest.raises(ValidationError, match="id 'a' is used twice"):
        Scene.model_validate({"objects": [item], "local_scene": [{**item, "role": "occluder"}]})


def test_preset_paper_is_the_papers_five_methods_and_single_ones_can_be_ours() -> None:
    chosen = Lighting(preset="paper")
    assert [chosen.method(stage) for stage in STAGES] == ["map32x16", "rings36", "threshold", "pcf", "additive"]
    assert Lighting(preset="paper", shadows="area").method("shadows") == "area"
    assert [Lighting(shadows="pcf").method(stage) for stage in STAGES] == ["auto", "ggx", "default", "pcf", "ratio"]
