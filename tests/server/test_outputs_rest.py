"""The outputs' REST resources, events, metrics and the list of ways to watch, on the running service."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from conftest import Served, start_service, stop_service, wait_for
from prometheus_client.parser import text_string_to_metric_families
from websockets.sync.client import connect

OUTPUTS = "/api/streams/live/outputs"
SECRET = "s3cr3t-k3y"
NOBODY = f"rtmp://user:{SECRET}@127.0.0.1:9/live/{SECRET}"


@pytest.fixture(scope="module")
def recorder(panorama: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service with a folder for recordings, a ladder and two ways to watch in its settings."""
    folder = tmp_path_factory.mktemp("recorder")
    config = folder / "mr360.toml"
    config.write_text(f'''
recordings_dir = "{folder / 'recordings'}"
max_outputs = 3
renditions = [{{name = "best", scale = 1.0}}, {{name = "half", scale = 0.5}}]
[[outputs]]
id = "configured"
kind = "record"
prefix = "configured"
enabled = false
[[playback]]
protocol = "hls"
url = "https://cdn.example/live.m3u8"
[[playback]]
stream = "other"
protocol = "hls"
url = "https://cdn.example/other.m3u8"
''')
    served = start_service("--source", str(panorama), "--config", str(config), assets_dir=folder / "assets")
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get("/api/streams/live").json()["state"] == "live", "stream is live", 60)
        yield served
    finally:
        stop_service(served)


@pytest.fixture
def rest(recorder: Served) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=recorder.url, timeout=30) as client:
        yield client
        for output in client.get(OUTPUTS).json():
            if output["id"] != "configured":
                assert client.delete(f"{OUTPUTS}/{output['id']}").status_code == 204


def test_a_recording_from_post_to_delete(rest: httpx.Client, recorder: Served) -> None:
    answer = rest.post(OUTPUTS, json={"id": "rec", "kind": "record", "prefix": "show"})
    assert answer.status_code == 201
    assert answer.headers["location"] == f"{OUTPUTS}/rec"
    assert (answer.json()["state"], answer.json()["rendition"]) == ("connecting", "best")

    def output() -> dict[str, Any]:
        found: dict[str, Any] = rest.get(f"{OUTPUTS}/rec").json()
        return found

    wait_for(lambda: output()["state"] == "live" and output()["frames"] > 10, "recording is live")
    assert output()["detail"].startswith("show-")
    assert rest.get("/api/streams/live").json()["viewers"] == 0
    status = next(one for one in rest.get("/api/streams/live/stats").json()["outputs"] if one["id"] == "rec")
    assert (status["state"], status["restarts"]) == ("live", 0)
    assert status["bytes"] > 0
    samples = {sample.name: sample.value for family in text_string_to_metric_families(rest.get("/metrics").text)
               for sample in family.samples if sample.labels.get("output") == "rec"}
    assert samples["mr360_output_up"] == 1
    assert samples["mr360_output_bytes_total"] >= status["bytes"]
    assert samples["mr360_output_restarts_total"] == 0

    first = output()["detail"]
    assert rest.patch(f"{OUTPUTS}/rec", json={"playback": [{"protocol": "hls", "url": "https://e.example/x"}]}).status_code == 200
    assert output()["detail"] == first, "playback is no reason for another file"
    assert rest.patch(f"{OUTPUTS}/rec", json={"prefix": "other"}).json()["state"] == "connecting"
    wait_for(lambda: output()["state"] == "live", "recording is live")
    assert output()["detail"].startswith("other-")
    assert rest.patch(f"{OUTPUTS}/rec", json={"enabled": False}).json()["state"] == "disabled"
    assert rest.delete(f"{OUTPUTS}/rec").status_code == 204
    assert rest.get(f"{OUTPUTS}/rec").status_code == 404
    assert 'output="rec"' not in rest.get("/metrics").text


def test_what_fails_is_tried_again_and_its_secrets_are_nowhere(rest: httpx.Client) -> None:
    with connect(f"{str(rest.base_url).replace('http', 'ws').rstrip('/')}/api/streams/live/events", proxy=None) as events:
        answer = rest.post(OUTPUTS, json={"id": "push", "url": NOBODY})
        sfu = {"id": "sfu", "url": f"whip+http://127.0.0.1:9/{SECRET}{SECRET}{SECRET}", "token": SECRET}
        told = [answer.text, rest.post(OUTPUTS, json=sfu).text]
        assert answer.json()["url"] == "rtmp://***@127.0.0.1:9/live/***"
        seen: set[tuple[str, str]] = set()
        end = time.monotonic() + 30
        while not {("push", "retrying"), ("sfu", "retrying")} <= seen and time.monotonic() < end:
            text = str(events.recv(timeout=30))
            told.append(text)
            event = json.loads(text)
            if event["type"] == "outputs":
                seen |= {(one["id"], one["state"]) for one in event["outputs"]}
        assert {("push", "retrying"), ("sfu", "retrying")} <= seen
    assert rest.get(f"{OUTPUTS}/sfu").json()["token_set"] is True
    for path in (OUTPUTS, f"{OUTPUTS}/push", "/api/streams", "/api/streams/live/stats", "/api/streams/live/playback", "/metrics"):
        told.append(rest.get(path).text)
    assert "refused" in rest.get(f"{OUTPUTS}/push").json()["detail"]
    assert not [text for text in told if SECRET in text]


def test_a_new_url_loses_the_token(rest: httpx.Client) -> None:
    """Or whoever may write could have it sent to himself."""
    rest.post(OUTPUTS, json={"id": "sfu", "url": "whip+http://127.0.0.1:9/a", "token": SECRET, "enabled": False})
    assert rest.patch(f"{OUTPUTS}/sfu", json={"url": "https://127.0.0.1:9/b"}).json()["token_set"] is False
    answer = rest.patch(f"{OUTPUTS}/sfu", json={"url": "rtsp://127.0.0.1:9/b"}).json()
    assert (answer["kind"], answer["url"]) == ("rtsp", "rtsp://127.0.0.1:9/b")


@pytest.mark.parametrize(("body", "status", "complaint"), [
    ({"id": "a", "url": "ftp://h/x"}, 422, "url scheme is 'ftp', expected one of rtmp"),
    ({"id": "a", "url": f"rtmp://h/live/{SECRET} x"}, 422, "blanks"),
    ({"id": "a", "url": "whip+http://h/x", "token": f"{SECRET}\n"}, 422, "token: expected a bearer token"),
    ({"id": "a", "url": f"rtmp://h/live/{SECRET}", "keys": SECRET}, 422, "keys is an unknown key"),
    ({"url": f"rtmp://h/live/{SECRET}"}, 422, "id is missing"),
    ({"id": "a"}, 422, "kind is missing"),
    ({"id": "configured", "kind": "record", "prefix": "x"}, 409, "output 'configured' exists already"),
    ({"id": "a", "kind": "record", "prefix": "/etc/x"}, 422, "prefix is '/etc/x'"),
    ({"id": "a", "kind": "record", "prefix": "x", "rendition": "full"}, 422, "rendition is 'full', expected one of best, half"),
])
def test_refusals_name_what_was_expected(rest: httpx.Client, body: dict[str, Any], status: int, complaint: str) -> None:
    answer = rest.post(OUTPUTS, json=body)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert complaint in answer.json()["detail"]
    assert SECRET not in answer.text


def test_more_refusals(rest: httpx.Client) -> None:
    assert rest.get(f"{OUTPUTS}/none").status_code == 404
    assert rest.patch(f"{OUTPUTS}/none", json={}).status_code == 404
    assert rest.delete(f"{OUTPUTS}/none").status_code == 404
    assert rest.get("/api/streams/none/outputs").status_code == 404
    assert rest.patch(f"{OUTPUTS}/configured", json={"id": "other"}).status_code == 422
    assert rest.patch(f"{OUTPUTS}/configured", json={"url": "rtmp://h/live/k"}).status_code == 422
    assert rest.patch(f"{OUTPUTS}/configured", json={"rendition": "full"}).status_code == 422
    assert rest.patch(f"{OUTPUTS}/configured", json={"rendition": "half"}).json()["rendition"] == "half"
    assert rest.patch(f"{OUTPUTS}/configured", json={"rendition": None}).json()["rendition"] == "best"
    for number in range(2):
        rest.post(OUTPUTS, json={"id": str(number), "kind": "record", "prefix": "x", "enabled": False})
    answer = rest.post(OUTPUTS, json={"id": "a", "kind": "record", "prefix": "x"})
    assert (answer.status_code, answer.json()["detail"]) == (409, "3 outputs exist, the setting max_outputs")


def test_ways_to_watch(rest: httpx.Client) -> None:
    base = str(rest.base_url).rstrip("/")
    edge = {"protocol": "whep", "url": "https://edge.example/whep/live"}
    rest.post(OUTPUTS, json={"id": "rec", "kind": "record", "prefix": "x", "rendition": "half", "playback": [edge]})
    rest.post(OUTPUTS, json={"id": "down", "url": NOBODY, "playback": [{"protocol": "rtmp", "url": "rtmp://down.example/live"}]})
    wait_for(lambda: rest.get(f"{OUTPUTS}/rec").json()["state"] == "live", "recording is live")
    ours, page, *others = rest.get("/api/streams/live/playback").json()
    assert (ours["protocol"], ours["url"]) == ("whep", f"{base}/whep/live")
    assert [rendition["name"] for rendition in ours["renditions"]]== ["best", "half"]
    assert (page["protocol"], page["url"]) == ("page", f"{base}/view/live")
    assert others == [{**edge, "rendition": "half", "via": "rec"}, {"protocol": "hls", "url": "https://cdn.example/live.m3u8"}]


def test_outputs_elsewhere_in_the_network_are_refused_by_a_public_service(panorama: Path, tmp_path: Path) -> None:
    served = start_service("--host", "0.0.0.0", assets_dir=tmp_path / "assets")
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            for url in ("rtmp://127.0.0.1/live/k", "rtsp://192.168.1.1/x", "whip+http://169.254.169.254/latest"):
                answer = client.post(OUTPUTS, json={"id": "a", "url": url})
                assert answer.status_code == 422
                assert "expected a public one or one in the setting source_networks" in answer.json()["detail"]
    finally:
        stop_service(served)


def test_no_output_outlives_a_service_that_is_killed(panorama: Path, tmp_path: Path) -> None:
    config = tmp_path / "mr360.toml"
    config.write_text(f'''
recordings_dir = "{tmp_path / 'recordings'}"
outputs = [{{id = "rec", kind = "record", prefix = "x"}}, {{id = "push", url = "{NOBODY}"}}]
''')
    served = start_service("--source", str(panorama), "--config", str(config), assets_dir=tmp_path / "assets")
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get(f"{OUTPUTS}/rec").json()["state"] == "live", "recording is live", 60)
        children = Path(f"/proc/{served.process.pid}/task/{served.process.pid}/children").read_text().split()
        pids = [int(pid) for pid in children if b"server.outputs" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        assert pids
        assert SECRET.encode() not in b"".join(Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids)
        served.process.kill()
        served.process.wait()
        wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids), "the outputs end by themselves", 10)
    finally:
        stop_service(served)
