from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from conftest import Served, wait_for
from test_rest_scene import assert_problem

from server.assets import MAX_ASSET_BYTES
from tests.models import bent_bar, glb, one_triangle, triangle

ASSETS = "/api/assets"
OBJECTS = "/api/streams/live/objects"
GLB_TYPE = {"Content-Type": "model/gltf-binary"}


def flawed(**accessor: Any) -> bytes:
    """A triangle whose positions' accessor is changed."""
    model = one_triangle()
    model.json["accessors"][0].update(accessor)
    return model.bytes()


@pytest.fixture
def no_assets(served: Served, client: httpx.Client) -> Iterator[None]:
    yield
    client.put("/api/streams/live/scene", json={})
    for asset in client.get(ASSETS).json():
        client.delete(f"{ASSETS}/{asset['name']}")


@pytest.mark.usefixtures("no_assets")
def test_asset_life(client: httpx.Client) -> None:
    created = client.post(ASSETS, content=triangle(), headers=GLB_TYPE, params={"name": "flag"})
    assert created.status_code == 201, created.text
    assert created.headers["location"] == f"{ASSETS}/flag"
    assert created.json() | {"name": "flag", "mesh": "asset:flag", "triangles": 1} == created.json()
    assert [asset["name"] for asset in client.get(ASSETS).json()] == ["flag"]
    again = client.post(ASSETS, content=triangle(), headers=GLB_TYPE, params={"name": "flag"})
    assert_problem(again, 409, "'flag' exists already")

    placed = client.post(OBJECTS, json={"id": "pole", "mesh": "asset:flag"})
    assert placed.status_code == 201
    assert_problem(client.delete(f"{ASSETS}/flag"), 409, "'flag' is the mesh of 'pole' in stream 'live'")
    client.delete(f"{OBJECTS}/pole")
    assert client.delete(f"{ASSETS}/flag").status_code == 204
    assert_problem(client.delete(f"{ASSETS}/flag"), 404, "no asset 'flag'")
    assert_problem(client.post(OBJECTS, json={"mesh": "asset:flag"}), 422, "'asset:flag' is no asset")


@pytest.mark.usefixtures("no_assets")
def test_the_clips_of_a_model_are_listed(served: Served, client: httpx.Client) -> None:
    created = client.post(ASSETS, content=bent_bar().bytes(), headers=GLB_TYPE, params={"name": "bar"}).json()
    assert created["clips"] == [{"name": "bend", "seconds": 1.0}]
    assert client.get(ASSETS).json() == [created]
    (served.assets_dir / "bar.json").write_text("broken")       # what is not there is not told
    assert client.get(ASSETS).json() == [{"name": "bar", "mesh": "asset:bar", "bytes": created["bytes"]}]
    client.delete(f"{ASSETS}/bar")
    assert list(served.assets_dir.iterdir()) == []


@pytest.mark.usefixtures("no_assets")
def test_names(client: httpx.Client) -> None:
    generated = client.post(ASSETS, content=triangle(), headers=GLB_TYPE).json()["name"]
    assert generated.startswith("model-")
    named = client.post(ASSETS, content=triangle(),
                        headers=GLB_TYPE | {"Content-Disposition": 'attachment; filename="chair.glb"'})
    assert named.json()["name"] == "chair"
    for wrong in ("../x", "a/b", "", ".hidden", "x" * 65):
        assert_problem(client.post(ASSETS, content=triangle(), headers=GLB_TYPE, params={"name": wrong}), 422, "name")
    climbing = {"Content-Disposition": 'attachment; filename="../../x.glb"'}
    assert_problem(client.post(ASSETS, content=triangle(), headers=GLB_TYPE | climbing), 422, "file name is '../../x'")


@pytest.mark.parametrize(("content", "text"), [
    (b"", "the file has 0 bytes, expected a GLB"),
    (b"glTF", "the file has 4 bytes"),
    (b"x" * 100, "the file begins with b'xxxx'"),
    (struct.pack("<4sII", b"glTF", 1, 12), "version 1, expected b'glTF' version 2"),
    (struct.pack("<4sII", b"glTF", 2, 100), "the GLB header names 100 bytes, the file has 12"),
    (triangle()[:-4], "the GLB header names"),
])
@pytest.mark.usefixtures("no_assets")
def test_what_is_no_glb_is_refused(served: Served, client: httpx.Client, content: bytes, text: str) -> None:
    assert_problem(client.post(ASSETS, content=content, headers=GLB_TYPE), 422, text)
    assert list(served.assets_dir.iterdir()) == []


@pytest.mark.parametrize("content", [
    struct.pack("<4sII", b"glTF", 2, 12),                                                   # no chunk at all
    glb({"asset": {"version": "2.0"}}, b""),                                                # nothing to draw
    flawed(count=1000),                                                                   # reads past its buffer
    flawed(count=1 << 40),
    flawed(bufferView=7),
    flawed(componentType=1),
    glb({"asset": {"version": "2.0"}, "buffers": [{"uri": "file:///etc/passwd", "byteLength": 10}]}, b""),
])
@pytest.mark.usefixtures("no_assets")
def test_a_corrupt_model_is_refused_and_not_kept(served: Served, client: httpx.Client, content: bytes) -> None:
    assert_problem(client.post(ASSETS, content=content, headers=GLB_TYPE), 422)
    assert list(served.assets_dir.iterdir()) == []
    assert client.get("/healthz").status_code == 200


def test_other_media_types_are_refused(client: httpx.Client) -> None:
    response = client.post(ASSETS, content=triangle(), headers={"Content-Type": "text/plain"})
    assert_problem(response, 415, "expected model/gltf-binary")


@pytest.mark.usefixtures("no_assets")
def test_a_model_too_large_is_413(served: Served, client: httpx.Client) -> None:
    def chunks() -> Iterator[bytes]:
        yield struct.pack("<4sII", b"glTF", 2, MAX_ASSET_BYTES + 12)
        for _ in range(MAX_ASSET_BYTES >> 20):
            yield bytes(1 << 20)

    assert_problem(client.post(ASSETS, content=chunks(), headers=GLB_TYPE), 413, "longer than")
    assert list(served.assets_dir.iterdir()) == []


def test_an_upload_that_breaks_off_leaves_nothing(served: Served, client: httpx.Client) -> None:
    def chunks() -> Iterator[bytes]:
        yield triangle()[:20]
        raise ConnectionError("the client went away")

    with pytest.raises(ConnectionError), httpx.Client(base_url=served.url) as other:
        other.post(ASSETS, content=chunks(), headers=GLB_TYPE)
    wait_for(lambda: list(served.assets_dir.iterdir()) == [], "the partial file is gone")
