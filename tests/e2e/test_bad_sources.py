"""Sources that are wrong: each becomes a clear state or error; the worker lives on and the next good source plays."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import pytest
from headless_viewer import HeadlessViewer
from media_servers import NginxRtmp, Publisher, RtspServer, write_byte_stream
from processes import PROJECT, Process, free_port, wait_for
from running_service import Service

pytestmark = pytest.mark.e2e

TOLD_WITHIN_S = 40.0    # the longest of FFmpeg's own timeouts, and some


@pytest.fixture
def service(shared_service: Service) -> Iterator[Service]:
    """Ends every test by asking whether the worker has come through it."""
    restarts = shared_service.stream()["worker"]["restarts"]
    yield shared_service
    assert shared_service.request("GET", "/readyz")["status"] == "ready"
    assert shared_service.stream()["worker"]["restarts"] == restarts, "the worker died of it"
    shared_service.pull(None, wait=False)
    shared_service.wait_state("live", "idle")


@pytest.fixture
def bad_feed(nginx_rtmp: NginxRtmp, tmp_path: Path) -> Iterator[Callable[[str], str]]:
    """Call it with a kind; it is published from then on, at the URL that is returned."""
    started: list[Process] = []

    def start(kind: str) -> str:
        script = Path(__file__).with_name("bad_feed.py")
        started.append(Process([sys.executable, script, kind, nginx_rtmp.url(kind)], tmp_path / f"{kind}.log"))
        return nginx_rtmp.url(kind)

    yield start
    for process in started:
        assert process.running(), process.output()
        process.kill()


@pytest.fixture
def tcp_server() -> Iterator[Callable[[bytes], int]]:
    """Call it with what to say to everybody who connects; returns the port."""
    listeners: list[socket.socket] = []
    threads: list[threading.Thread] = []

    def answer(listener: socket.socket, words: bytes) -> None:
        connections = []
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                break
            connections.append(connection)
            with contextlib.suppress(OSError):
                connection.sendall(words)
        for connection in connections:
            connection.close()

    def start(words: bytes) -> int:
        listener = socket.create_server(("127.0.0.1", 0))
        listeners.append(listener)
        threads.append(threading.Thread(target=answer, args=(listener, words)))
        threads[-1].start()
        port: int = listener.getsockname()[1]
        return port

    yield start
    for listener in listeners:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
    for thread in threads:
        thread.join(10)


def told(service: Service, *words: str) -> dict[str, Any]:
    """Wait until the stream's detail has one of the words; it is never live before."""
    details = set()

    def found() -> dict[str, Any]:
        stream = service.stream()
        assert stream["state"] != "live", stream
        details.add(stream["detail"])
        return stream if any(word in (stream["detail"] or "") for word in words) else {}

    try:
        return wait_for("word of it", found, TOLD_WITHIN_S)
    except AssertionError as error:
        raise AssertionError(f"{error}: expected one of {words} in {details}") from None


def accepted(service: Service, width: int, height: int) -> dict[str, Any]:
    """Wait until a picture of this size comes in and goes out."""
    def found() -> bool:
        stream = service.stream()
        size = (stream["input"]["width"], stream["input"]["height"]) if stream["input"] else None
        return stream["state"] == "live" and size == (width, height) and stream["output"] is not None

    wait_for(f"picture of {width}×{height}", found, TOLD_WITHIN_S)
    return service.stream()


@pytest.mark.parametrize("scheme", ["rtmp", "rtsp"])
def test_a_refused_connection_is_told(service: Service, scheme: str) -> None:
    service.pull(f"{scheme}://127.0.0.1:{free_port()}/live/camera", wait=False)
    assert told(service, "refused")["state"] in ("connecting", "lost")


@pytest.mark.parametrize("scheme", ["rtmp", "rtsp"])
def test_a_host_that_never_answers_is_told(service: Service, tcp_server: Callable[[bytes], int], scheme: str) -> None:
    service.pull(f"{scheme}://127.0.0.1:{tcp_server(b'')}/live/camera", wait=False)
    told(service, "timed out", "timeout", "no answer", "in time")


@pytest.mark.parametrize("scheme", ["rtmp", "rtsp"])
def test_a_host_that_speaks_something_else_is_told(service: Service, tcp_server: Callable[[bytes], int],
                                                   scheme: str) -> None:
    port = tcp_server(os.urandom(4096))
    service.pull(f"{scheme}://127.0.0.1:{port}/live/camera", wait=False)
    wait_for("detail", lambda: service.stream()["detail"], TOLD_WITHIN_S)
    assert service.stream()["state"] != "live"


@pytest.mark.parametrize("source", ["http://127.0.0.1/camera", "ftp://127.0.0.1/x", "camera", "rtsp://", "rtmp-listen://"])
def test_a_wrong_scheme_is_refused_over_rest(service: Service, source: str) -> None:
    problem = service.request("PATCH", "/api/streams/live", {"source": source}, expect=422)
    assert source in problem["detail"]
    assert "expected" in problem["detail"]
    assert service.stream()["source"] is None


@pytest.mark.parametrize("source", ["http://127.0.0.1/camera", "no-such-file.mp4"])
def test_a_wrong_source_on_the_command_line_is_status_2(source: str) -> None:
    ended = subprocess.run([sys.executable, "-m", "server.cli", "serve", "--port", "0", "--source", source],
                           cwd=PROJECT, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert source in ended.stderr
    assert "expected" in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_stream_without_video_is_told(service: Service, bad_feed: Callable[[str], str]) -> None:
    service.pull(bad_feed("audio_only"), wait=False)
    told(service, "no video", "without video")


def test_video_that_cannot_be_decoded_is_told(service: Service, bad_feed: Callable[[str], str]) -> None:
    service.pull(bad_feed("undecodable"), wait=False)
    wait_for("detail", lambda: service.stream()["detail"], TOLD_WITHIN_S)
    assert service.stream()["state"] != "live"


def test_a_picture_that_is_not_2_to_1_is_accepted_and_flagged(service: Service, bad_feed: Callable[[str], str]) -> None:
    service.pull(bad_feed("not_2_to_1"))
    assert "not_2_to_1" in accepted(service, 480, 320)["flags"]


def test_an_odd_size_is_accepted_and_flagged(service: Service, bad_feed: Callable[[str], str],
                                             viewer: Callable[[str], HeadlessViewer]) -> None:
    service.pull(bad_feed("odd_size"))
    assert "odd_size" in accepted(service, 643, 321)["flags"]
    seen = viewer(service.url).wait_frames(10)
    output = service.stream()["output"]
    assert (seen["width"], seen["height"]) == (output["width"], output["height"])
    assert output["width"] % 2 == output["height"] % 2 == 0


@pytest.fixture
def changing_source(tmp_path: Path) -> Iterator[RtspServer]:
    """2 s of 640×320, 2 s of 320×160, over and over, in one RTSP session."""
    parts = []
    for width in (640, 320):
        clip, part = tmp_path / f"{width}.mp4", tmp_path / f"{width}.h264"
        with av.open(str(clip), "w") as container:
            stream = container.add_stream("libx264", rate=15, options={"bf": "0", "g": "15"})
            stream.width, stream.height, stream.pix_fmt = width, width // 2, "yuv420p"
            for _ in range(30):
                container.mux(stream.encode(av.VideoFrame(width, width // 2, "yuv420p")))
            container.mux(stream.encode(None))
        write_byte_stream(clip, part)
        parts.append(part.read_bytes())
    both = tmp_path / "both.h264"
    both.write_bytes(b"".join(parts))
    server = RtspServer(both, tmp_path)
    yield server
    server.process.stop()


def test_a_change_of_size_does_not_change_what_viewers_get(
        start_service: Callable[..., Service], changing_source: RtspServer,
        viewer: Callable[[str], HeadlessViewer]) -> None:
    service = start_service("--source", changing_source.url)
    service.wait_live()
    watching = viewer(service.url)
    first = watching.wait_frames(5)
    output = service.stream()["output"]
    sizes = set()

    def both_seen() -> bool:
        stream = service.stream()
        if stream["input"] is not None:
            sizes.add(stream["input"]["width"])
        assert stream["output"] == output
        return sizes == {640, 320}

    wait_for("both sizes", both_seen, 60)
    last = watching.wait_frames(60)
    assert (first["width"], first["height"]) == (last["width"], last["height"]) == (output["width"], output["height"])


def test_a_source_lost_for_a_minute_comes_back_and_the_scene_stays_editable_meanwhile(
        service: Service, nginx_rtmp: NginxRtmp, publisher: Callable[..., Publisher], clip: Path,
        viewer: Callable[[str], HeadlessViewer]) -> None:
    url = nginx_rtmp.url("lost")
    camera = publisher(clip, url)
    service.pull(url)
    watching = viewer(service.url)
    watching.wait_frames(5)
    camera.process.stop()
    service.wait_state("live", "lost", seconds=TOLD_WITHIN_S)
    back_at = time.monotonic() + 60
    empty = snapshot(service)
    service.place(id="ball", mesh="sphere", position=[0, -1, -2], material={"base_color": [1, 0, 1]})
    wait_for("object in the standing picture", lambda: snapshot(service) != empty, 20)
    time.sleep(max(0.0, back_at - time.monotonic()))
    assert service.stream()["state"] == "lost"
    assert watching.progress()["state"] == "connected"
    publisher(clip, url)
    service.wait_live("live")
    watching.wait_frames(30)
    service.request("DELETE", "/api/streams/live/objects/ball")


def snapshot(service: Service) -> bytes:
    answer = service.http.get("/api/streams/live/snapshot.jpg")
    assert answer.status_code == 200, answer.text
    return answer.content
