from __future__ import annotations

from typing import Any

import httpx
import pytest

SCENE = "/api/streams/live/scene"
OBJECTS = "/api/streams/live/objects"
BALL = {"id": "ball", "mesh": "sphere", "position": [0, -1.1, -3],
        "material": {"base_color": [1, 0, 0], "metallic": 0.5, "roughness": 0.25}}


def assert_problem(response: httpx.Response, status: int, *texts: str) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    for text in texts:
        assert text in problem["detail"]
    return problem


def test_scene_round_trips(client: httpx.Client) -> None:
    scene = client.get(SCENE).json()
    scene["camera_height"] = 2.5
    scene["objects"] = [BALL]
    stored = client.put(SCENE, json=scene)
    assert stored.status_code == 200
    assert client.get(SCENE).json() == stored.json()
    assert stored.json()["objects"][0]["material"]["roughness"] == 0.25
    assert stored.json()["objects"][0]["rotation"] == [0, 0, 0, 1]


def test_etag_guards_against_lost_updates(client: httpx.Client) -> None:
    tag = client.get(SCENE).headers["etag"]
    changed = client.put(SCENE, json={"camera_height": 2}, headers={"If-Match": tag})
    assert changed.status_code == 200
    assert changed.headers["etag"] != tag
    problem = assert_problem(client.put(SCENE, json={}, headers={"If-Match": tag}), 412, "if-match is")
    assert changed.headers["etag"] in problem["detail"]
    assert client.get(SCENE).json()["camera_height"] == 2
    assert client.put(SCENE, json={}, headers={"If-Match": "*"}).status_code == 200


def test_every_edit_changes_the_etag(client: httpx.Client) -> None:
    tags = [client.get(SCENE).headers["etag"]]
    for edit in (lambda: client.post(OBJECTS, json=BALL),
                 lambda: client.patch(f"{OBJECTS}/ball", json={"visible": False}),
                 lambda: client.delete(f"{OBJECTS}/ball")):
        assert edit().is_success
        tags.append(client.get(SCENE).headers["etag"])
    assert len(set(tags)) == 4


def test_object_life(client: httpx.Client) -> None:
    created = client.post(OBJECTS, json=BALL)
    assert created.status_code == 201
    assert created.headers["location"] == f"{OBJECTS}/ball"
    assert client.get(created.headers["location"]).json() == created.json()
    assert [placed["id"] for placed in client.get(OBJECTS).json()] == ["ball"]
    assert client.delete(created.headers["location"]).status_code == 204
    assert_problem(client.get(created.headers["location"]), 404, "no object 'ball' in stream 'live'")
    assert_problem(client.delete(created.headers["location"]), 404)
    assert_problem(client.patch(created.headers["location"], json={}), 404)


def test_an_object_without_id_gets_one(client: httpx.Client) -> None:
    one, two = (client.post(OBJECTS, json={"mesh": "box"}) for _ in range(2))
    assert one.json()["id"] != two.json()["id"]
    assert one.headers["location"].endswith(one.json()["id"])


def test_an_id_in_use_is_a_conflict(client: httpx.Client) -> None:
    client.put(SCENE, json={"local_scene": [{"id": "table", "mesh": "box", "role": "catcher"}]})
    assert_problem(client.post(OBJECTS, json={"id": "table", "mesh": "box"}), 409, "'table' is in use")


def test_patch_merges_and_null_is_the_default(client: httpx.Client) -> None:
    client.post(OBJECTS, json=BALL)
    url = f"{OBJECTS}/ball"
    moved = client.patch(url, json={"position": [1, 2, 3], "material": {"roughness": 0.75, "metallic": None}},
                         headers={"Content-Type": "application/merge-patch+json"}).json()
    assert moved["position"] == [1, 2, 3]
    assert moved["material"] == {"base_color": [1, 0, 0], "metallic": 0.0, "roughness": 0.75, "emissive": [0, 0, 0]}
    assert client.patch(url, json={"material": None, "position": None}).json()["material"] is None
    assert client.get(url).json()["position"] == [0, 0, 0]
    assert client.patch(url, json={"animation": {"clip": "Run"}}).json()["animation"]["speed"] == 1.0
    assert client.patch(url, json={"animation": None}).json()["animation"] is None
    assert_problem(client.patch(url, json={"id": "other"}), 422, "id is 'other', expected 'ball'")
    assert_problem(client.patch(url, json={"mesh": None}), 422, "mesh is missing")


@pytest.mark.parametrize(("change", "texts"), [
    ({"mesh": "torus"}, ["unknown mesh 'torus'", "sphere, box, cylinder, teapot or asset:NAME"]),
    ({"mesh": "model.glb"}, ["unknown mesh 'model.glb'"]),
    ({"mesh": "asset:nothing"}, ["'asset:nothing' is no asset"]),
    ({"mesh": "asset:../../etc/passwd"}, ["is no asset"]),
    ({"scale": [1, 0, 1]}, ["scale is [1.0, 0.0, 1.0], expected no component nearer to 0"]),
    ({"rotation": [0, 0, 0, 2]}, ["quaternion length is 2, expected 1"]),
    ({"rotation": [0, 0, 0, 0]}, ["quaternion length is 0, expected 1"]),
    ({"position": [0, 0]}, ["position.2 is missing"]),
    ({"position": [0, 0, "up"]}, ["position.2 is 'up'"]),
    ({"position": [0, 0, 1e9]}, ["position.2 is 1000000000.0"]),
    ({"colour": "red"}, ["colour is an unknown key"]),
    ({"material": {"roughness": 1.5}}, ["material.roughness is 1.5"]),
    ({"material": {"shininess": 1}}, ["material.shininess is an unknown key"]),
    ({"id": "a/b"}, ["id is 'a/b'"]),
    ({"id": 5}, ["id is 5"]),
    ({"visible": "perhaps"}, ["visible is 'perhaps'"]),
    ({"mesh": 3}, ["mesh is 3"]),
])
def test_wrong_values_are_named(client: httpx.Client, change: dict[str, Any], texts: list[str]) -> None:
    assert_problem(client.post(OBJECTS, json={**BALL, **change}), 422, *texts)
    assert client.get(OBJECTS).json() == []


@pytest.mark.parametrize(("body", "text"), [
    ('{"mesh": "box", "position": [NaN, 0, 0]}', "nan is no json value"),
    ('{"mesh": "box", "position": [Infinity, 0, 0]}', "infinity is no json value"),
    ('{"mesh": "box", "position": [-Infinity, 0, 0]}', "-infinity is no json value"),
    ('{"mesh": "box"', "the body is no JSON"),
    ("", "the body is no JSON"),
    ("[" * 100_000, "the body is no JSON"),
    ("\x00", "the body is no JSON"),
])
def test_what_is_no_json_is_400(client: httpx.Client, body: str, text: str) -> None:
    response = client.post(OBJECTS, content=body, headers={"Content-Type": "application/json"})
    if body:
        assert_problem(response, 400, text)
    else:
        assert_problem(response, 422, "is missing")


@pytest.mark.parametrize(("body", "text"), [
    ('{"mesh": "box", "position": [1e999, 0, 0]}', "position.0 is inf"),
    ('{"mesh": "\\ud800"}', "mesh"),
    ('{"mesh": "box", "id": "\\ud800"}', "id"),
    ('[1, 2]', "body is [1, 2]"),
    ('null', "body"),
    ('"text"', "body is 'text'"),
])
def test_json_of_the_wrong_kind_is_422(client: httpx.Client, body: str, text: str) -> None:
    response = client.post(OBJECTS, content=body, headers={"Content-Type": "application/json"})
    assert_problem(response, 422, text)


def test_body_must_be_json_by_its_type(client: httpx.Client) -> None:
    for kind in ("text/plain", "application/x-www-form-urlencoded", ""):
        response = client.post(OBJECTS, content='{"mesh": "box"}', headers={"Content-Type": kind})
        assert_problem(response, 415, "expected application/json")


def test_a_body_too_large_is_413(client: httpx.Client) -> None:
    response = client.put(SCENE, content=b" " * (3 << 20), headers={"Content-Type": "application/json"})
    assert_problem(response, 413, "the body is longer than")


def test_scene_rules(client: httpx.Client) -> None:
    assert_problem(client.put(SCENE, json={"objects": [BALL, BALL]}), 422, "id 'ball' is used twice")
    assert_problem(client.put(SCENE, json={"camera_height": 0}), 422, "camera_height is 0")
    problem = assert_problem(client.put(SCENE, json={"objects": [{**BALL, "scale": [0, 0, 0]}]}), 422)
    assert problem["errors"][0]["pointer"] == "/objects/0/scale"
    assert_problem(client.put(SCENE, json={"objects": [{"id": "a", "mesh": "asset:none"}]}), 422, "'asset:none'")
    too_many = [{"id": str(number), "mesh": "box"} for number in range(300)]
    assert_problem(client.put(SCENE, json={"objects": too_many}), 422, "objects")


def test_unknown_stream_and_path_and_method(client: httpx.Client) -> None:
    assert_problem(client.get("/api/streams/none/scene"), 404, "no stream 'none'")
    assert_problem(client.get("/api/nothing"), 404, "no resource '/api/nothing'")
    assert_problem(client.post(SCENE, json={}), 405, "POST is not allowed on")
