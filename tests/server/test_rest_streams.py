from __future__ import annotations

import io
from collections.abc import Iterator

import httpx
import pytest
from conftest import wait_for
from PIL import Image
from prometheus_client.parser import text_string_to_metric_families
from test_rest_scene import assert_problem

STREAMS = "/api/streams"


@pytest.fixture
def second_stream(client: httpx.Client) -> Iterator[str]:
    created = client.post(STREAMS, json={"name": "second", "source": "rtsp://user:secret@127.0.0.1:9/none"})
    assert created.status_code == 201
    assert created.headers["location"] == f"{STREAMS}/second"
    yield created.headers["location"]
    client.delete(f"{STREAMS}/second")


def test_the_live_stream(client: httpx.Client) -> None:
    live = client.get(f"{STREAMS}/live").json()
    assert set(live) == {"name", "source", "state", "detail", "input", "output", "flags", "viewers", "worker"}
    assert (live["name"], live["state"], live["viewers"]) == ("live", "live", 0)
    assert (live["input"]["width"], live["input"]["height"]) == (512, 256)
    assert live["worker"]["ready"] is True
    assert live["worker"]["renderer"]
    assert live in client.get(STREAMS).json()


def test_the_live_stream_stays(client: httpx.Client) -> None:
    assert_problem(client.delete(f"{STREAMS}/live"), 409, "'live' always exists")


def test_stream_life(client: httpx.Client, second_stream: str) -> None:
    described = client.get(second_stream).json()
    assert described["source"] == "rtsp://***@127.0.0.1:9/none"
    assert described["state"] in ("connecting", "lost")
    assert_problem(client.post(STREAMS, json={"name": "second"}), 409, "'second' exists already")
    assert client.patch(second_stream, json={"source": None}).json()["source"] is None
    wait_for(lambda: client.get(second_stream).json()["state"] == "idle", "the stream is idle")
    assert client.get(f"{second_stream}/scene").status_code == 200
    assert client.delete(second_stream).status_code == 204
    assert_problem(client.get(second_stream), 404, "no stream 'second'")
    assert 'stream="second"' not in client.get("/metrics").text


def test_an_unreachable_source_is_a_state_without_its_password(client: httpx.Client, second_stream: str) -> None:
    wait_for(lambda: client.get(second_stream).json()["detail"], "the state says why")
    described = client.get(second_stream).json()
    assert described["state"] in ("connecting", "lost")
    assert "secret" not in str(described)


@pytest.mark.parametrize("source", ["http://x/y", "file:///etc/passwd", "/etc/passwd", "rtsp://", "x" * 5000])
def test_sources_that_are_refused(client: httpx.Client, source: str) -> None:
    assert_problem(client.post(STREAMS, json={"name": "bad", "source": source}), 422, "source")
    assert_problem(client.patch(f"{STREAMS}/live", json={"source": source}), 422, "source")
    assert client.get(f"{STREAMS}/live").json()["state"] == "live"


@pytest.mark.parametrize("name", ["", "a b", "a/b", "..", "x" * 65, 5, None])
def test_names_that_are_refused(client: httpx.Client, name: object) -> None:
    assert_problem(client.post(STREAMS, json={"name": name}), 422, "name is")


def test_unknown_keys_are_refused(client: httpx.Client) -> None:
    assert_problem(client.post(STREAMS, json={"name": "x", "url": "y"}), 422, "url is an unknown key")
    assert_problem(client.patch(f"{STREAMS}/live", json={"name": "x"}), 422, "name is an unknown key")


def test_lights_are_of_a_frame_made_now(client: httpx.Client) -> None:
    one = client.get(f"{STREAMS}/live/lights").json()
    two = client.get(f"{STREAMS}/live/lights").json()
    assert one["stream"] == "live"
    assert two["frame"] > one["frame"]


def test_snapshot_is_the_composite(client: httpx.Client) -> None:
    response = client.get(f"{STREAMS}/live/snapshot.jpg")
    assert response.headers["content-type"] == "image/jpeg"
    picture = Image.open(io.BytesIO(response.content))
    assert picture.size == (512, 256)
    red, green, blue = picture.convert("RGB").resize((1, 1)).getpixel((0, 0))      # type: ignore[misc]
    assert blue > green > red


def test_stats(client: httpx.Client) -> None:
    client.get(f"{STREAMS}/live/lights")
    wait_for(lambda: client.get(f"{STREAMS}/live/stats").json().get("frames_rendered"), "a frame is counted")
    stats = client.get(f"{STREAMS}/live/stats").json()
    assert {"frames_in", "frames_encoded", "frames_dropped", "render_ms", "stages_ms", "viewers", "packets_delivered",
            "dropped_after_encoder", "latency_ms", "scene_revision", "light_interval"} <= set(stats)
    assert {"level", "reductions", "settings", "predicted_error", "load", "decisions", "last_decisions"} <= set(stats["quality"])
    assert stats["dropped_after_encoder"] == 0


def test_the_worker_gets_every_revision_at_last(client: httpx.Client) -> None:
    for height in range(20):
        client.put(f"{STREAMS}/live/scene", json={"camera_height": 1.0 + height / 10})
    revision = int(client.get(f"{STREAMS}/live/scene").headers["etag"].strip('"').rpartition("-")[2])

    def rendered() -> bool:
        client.get(f"{STREAMS}/live/lights")
        return bool(client.get(f"{STREAMS}/live/stats").json().get("scene_revision") == revision)

    wait_for(rendered, f"revision {revision} is rendered")


def test_health_and_readiness(client: httpx.Client) -> None:
    assert client.get("/healthz").json() == {"status": "alive"}
    wait_for(lambda: client.get("/readyz").status_code == 200, "ready")


def test_a_stream_that_starts_is_not_ready_and_is_named(client: httpx.Client, second_stream: str) -> None:
    response = client.get("/readyz")
    if response.status_code == 200:
        pytest.skip("its worker was ready before we could ask")
    assert_problem(response, 503, "not ready: second")
    wait_for(lambda: client.get("/readyz").status_code == 200, "ready")


def test_metrics(client: httpx.Client) -> None:
    families = {family.name: family for family in text_string_to_metric_families(client.get("/metrics").text)}
    assert {"mr360_frames_in", "mr360_frames_rendered", "mr360_frames_encoded", "mr360_frames_dropped",
            "mr360_render_seconds", "mr360_latency_seconds", "mr360_viewers", "mr360_worker_restarts",
            "mr360_worker_ready", "mr360_packets_delivered", "mr360_dropped_after_encoder", "mr360_load", "mr360_quality_level",
            "mr360_quality_predicted_error", "mr360_quality_decisions"} <= set(families)
    level, = (sample.value for sample in families["mr360_quality_level"].samples if sample.labels["stream"] == "live")
    assert level == client.get(f"{STREAMS}/live/stats").json()["quality"]["level"]
    frames = {sample.labels["stream"]: sample.value for sample in families["mr360_frames_in"].samples
              if sample.name == "mr360_frames_in_total"}
    assert frames["live"] > 0
