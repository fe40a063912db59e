"""The ways out, into media servers of other people and into files, and back again."""

from __future__ import annotations

import io
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from flashing_clip import check_in_sync, write_flashing_clip
from media_servers import NginxRtmp, RtspRecorder
from numpy.typing import NDArray
from PIL import Image
from placed_objects import LEFT, is_magenta
from processes import wait_for
from running_service import Service

from server.worker.spherical import SPHERICAL_UUID

pytestmark = pytest.mark.e2e
OUTPUTS = "/api/streams/live/outputs"
KEY = "s3cr3t-k3y"
BALL = {"id": "ball", "mesh": "sphere", "position": LEFT, "scale": [0.9, 0.9, 0.9],
        "material": {"base_color": [0.9, 0.02, 0.9], "metallic": 0.0, "roughness": 0.9}}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def playing(clip: Path, recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service with the synthetic camera's clip as its stream `live`."""
    yield from _serving(clip, recordings, tmp_path_factory.mktemp("service"))


@pytest.fixture(scope="module")
def sounding(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service with a clip that flashes and beeps."""
    folder = tmp_path_factory.mktemp("sounding")
    yield from _serving(write_flashing_clip(folder / "flash.mp4"), recordings, folder)


def _serving(clip: Path, recordings: Path, folder: Path) -> Iterator[Service]:
    service = Service(folder, "--source", str(clip), environment={"MR360_RECORDINGS_DIR": str(recordings)})
    try:
        service.wait_ready()
        service.wait_live()
        yield service
        assert KEY not in service.process.output()
    finally:
        service.stop()


@pytest.fixture
def output() -> Iterator[Callable[..., dict[str, Any]]]:
    """Call it with a service and an output: creates it, waits until it is live, and deletes it at the end."""
    made: list[tuple[Service, str]] = []

    def create(service: Service, **spec: Any) -> dict[str, Any]:
        service.request("POST", OUTPUTS, spec)
        made.append((service, spec["id"]))
        return wait_output(service, spec["id"], "live")

    yield create
    for service, output_id in made:
        service.request("DELETE", f"{OUTPUTS}/{output_id}")


def wait_output(service: Service, output_id: str, state: str, seconds: float = 30) -> dict[str, Any]:
    last: dict[str, Any] = {}

    def reached() -> bool:
        last.update(service.request("GET", f"{OUTPUTS}/{output_id}"))
        return last["state"] == state

    wait_for(f"{state} output {output_id} (it is {last})", reached, seconds)
    return last


def pull(url: str) -> av.container.InputContainer:
    """Open what a media server plays; keyframes come every two seconds, and FFmpeg would listen for five."""
    return av.open(url, options={"analyzeduration": "3000000", "rtsp_transport": "tcp"}, timeout=15)


def pictures(container: av.container.InputContainer, count: int) -> list[NDArray[np.uint8]]:
    found = []
    for frame in container.decode(video=0):
        found.append(frame.to_ndarray(format="rgb24"))
        if len(found) == count:
            break
    return found


def check_like_snapshot(service: Service, pixels: NDArray[np.uint8]) -> None:
    """The clip moves: the sun, its shadows, a few other things; all else has to be alike."""
    answer = service.http.get("/api/streams/live/snapshot.jpg")
    snapshot = np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), float)
    assert pixels.shape == snapshot.shape
    difference = np.abs(pixels.astype(float) - snapshot).max(-1)
    assert np.median(difference) < 6
    assert np.mean(difference < 24) > 0.9


def test_rtmp_comes_back_as_the_snapshot_even_after_the_server_was_gone(
        playing: Service, output: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    nginx = NginxRtmp(tmp_path)
    try:
        made = output(playing, id="nginx", url=nginx.url(KEY))
        assert made["url"] == nginx.url("***")
        with pull(nginx.url(KEY)) as container:
            check_like_snapshot(playing, pictures(container, 5)[-1])
        nginx.process.kill()
        assert KEY not in json.dumps(wait_output(playing, "nginx", "retrying"))
        nginx.start()
        again = wait_output(playing, "nginx", "live")
        assert again["restarts"] >= 1
        with pull(nginx.url(KEY)) as container:
            check_like_snapshot(playing, pictures(container, 5)[-1])
        assert playing.stream()["viewers"] == 0
    finally:
        nginx.process.kill()


def test_rtsp_comes_back_as_the_snapshot_even_after_the_server_was_gone(
        playing: Service, output: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    recorder = RtspRecorder(tmp_path)
    try:
        output(playing, id="rtsp", url=recorder.url)
        check_like_snapshot(playing, recorded(recorder)[-1])
        recorder.process.kill()
        wait_output(playing, "rtsp", "retrying")
        recorder.file.unlink()
        recorder.start()
        wait_output(playing, "rtsp", "live")
        check_like_snapshot(playing, recorded(recorder)[-1])
    finally:
        recorder.process.kill()


def recorded(recorder: RtspRecorder) -> list[NDArray[np.uint8]]:
    wait_for("recorded video", lambda: recorder.file.exists() and recorder.file.stat().st_size > 150_000, 30)
    with av.open(io.BytesIO(recorder.file.read_bytes()), format="h264") as container:
        return pictures(container, 10)


def test_a_half_size_rendition_goes_out(playing: Service, output: Callable[..., dict[str, Any]], nginx_rtmp: NginxRtmp) -> None:
    output(playing, id="low", url=nginx_rtmp.url("low"), rendition="low")
    with pull(nginx_rtmp.url("low")) as container:
        assert pictures(container, 1)[0].shape == (256, 512, 3)


def test_a_killed_recording_shows_each_object_from_its_line_in_the_log(
        playing: Service, output: Callable[..., dict[str, Any]], recordings: Path) -> None:
    made = output(playing, id="rec", kind="record", prefix="killed")
    film = recordings / made["detail"]
    wait_frames(playing, "rec", 20)
    playing.place(**BALL)
    wait_frames(playing, "rec", 60)     # the ball's pictures are in a fragment that is whole, two seconds at most each
    os.kill(output_process(playing), signal.SIGKILL)
    playing.request("DELETE", "/api/streams/live/objects/ball")
    head, *lines = [json.loads(line) for line in film.with_suffix(".scene.jsonl").read_text().splitlines()]
    assert head["geometry"] == {"width": 1024, "height": 512, "projection": "equirectangular"}
    placed = next(line for line in lines if [one["id"] for one in line["scene"]["objects"]] == ["ball"])
    with av.open(str(film)) as container:
        shown = [(float(frame.time), is_magenta(frame.to_ndarray(format="rgb24"), LEFT)) for frame in container.decode(video=0)]
    assert SPHERICAL_UUID in film.read_bytes()[:4096]
    first = next(time for time, magenta in shown if magenta)
    assert first == pytest.approx(placed["time"], abs=0.002)
    assert all(magenta for time, magenta in shown if time >= first)


def wait_frames(service: Service, output_id: str, more: int) -> None:
    wanted = service.request("GET", f"{OUTPUTS}/{output_id}")["frames"] + more
    wait_for(f"{more} frames more", lambda: service.request("GET", f"{OUTPUTS}/{output_id}")["frames"] >= wanted, 30)


def output_process(service: Service) -> int:
    """The one output's process."""
    found, = [pid for pid in service.process.descendants() if b"server.outputs" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return found


def test_sound_goes_out_with_its_picture(sounding: Service, output: Callable[..., dict[str, Any]], nginx_rtmp: NginxRtmp,
                                         recordings: Path, tmp_path: Path) -> None:
    assert sounding.stream()["input"]["audio"]["codec"] == "aac"
    recorder = RtspRecorder(tmp_path, sound=True)
    try:
        film = recordings / output(sounding, id="rec", kind="record", prefix="sound")["detail"]
        output(sounding, id="rtsp", url=recorder.url)
        output(sounding, id="nginx", url=nginx_rtmp.url("sound"))
        with pull(nginx_rtmp.url("sound")) as container:
            assert {stream.codec_context.name for stream in container.streams} == {"h264", "aac"}
            check_in_sync(container, 4)
        with av.open(io.BytesIO(recorder.file.read_bytes())) as container:
            assert {stream.codec_context.name for stream in container.streams} == {"h264", "opus"}
            check_in_sync(container, 5, by_arrival=True)
        with av.open(io.BytesIO(film.read_bytes())) as container:
            assert {stream.codec_context.name for stream in container.streams} == {"h264", "aac"}
            check_in_sync(container, 5)
    finally:
        recorder.process.kill()
