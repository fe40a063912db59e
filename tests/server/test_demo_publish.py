"""`mr360 publish` as a process, received by FFmpeg's own RTMP listener."""

from __future__ import annotations

import itertools
import signal
import socket
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

FPS, FRAMES = 10, 15
LISTEN = {"listen": "1", "timeout": "30", "analyzeduration": "100000"}


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """1.5 s of H.264 with B-frames, so that decoding times differ from presentation times."""
    path = tmp_path / "video.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"bf": "2", "g": "15"})
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for index in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(np.full((64, 128, 3), index * 15, np.uint8), "rgb24")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def publish(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "server.cli", "publish", *map(str, arguments)],
                            stderr=subprocess.PIPE, text=True)


def receive(url: str, count: int) -> list[tuple[float, float, bool, float]]:
    """(dts, pts, keyframe, arrival) in seconds of the first `count` packets that a publisher sends to `url`."""
    with av.open(url, options=LISTEN, timeout=30) as container:
        packets = (packet for packet in container.demux(video=0) if packet.dts is not None)
        return [(float(packet.dts * packet.time_base), float(packet.pts * packet.time_base), packet.is_keyframe,
                 time.monotonic()) for packet in itertools.islice(packets, count)]


def test_time_stamps_start_at_0_and_run_on_across_the_loop(video: Path) -> None:
    url = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    started = time.monotonic()
    process = publish(video, url, "--loop")
    try:
        packets = receive(url, 3 * FRAMES)
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    decoding = [packet[0] for packet in packets]
    assert decoding[0] == 0
    assert np.diff(decoding) == pytest.approx(1 / FPS, abs=0.002)       # flv counts milliseconds
    presentation = sorted(packet[1] for packet in packets)
    assert np.diff(presentation)[:-2] == pytest.approx(1 / FPS, abs=0.002)
    assert [index for index, packet in enumerate(packets) if packet[2]] == [0, FRAMES, 2 * FRAMES]
    assert packets[-1][3] - started > decoding[-1], "it came faster than real time"


def test_sound_goes_along_across_the_loop(video: Path, tmp_path: Path) -> None:
    """Sound that is longer than the video loses what would overlap; its time stamps stay those of the video's clock."""
    file, rate = tmp_path / "with-sound.mp4", 44100
    with av.open(str(video)) as given, av.open(str(file), "w") as container:
        stream = container.add_stream_from_template(given.streams.video[0])
        sound = container.add_stream("aac", rate=rate, layout="mono")
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
        for index in range(70):     # 1.63 s beside 1.5 s of video
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = rate, index * 1024, Fraction(1, rate)
            container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    url = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    process = publish(file, url, "--loop")
    try:
        with av.open(url, options=LISTEN, timeout=30) as container:
            times: dict[str, list[float]] = {"video": [], "audio": []}
            for packet in itertools.islice(container.demux(), 300):
                if packet.dts is not None:
                    times[packet.stream.type].append(float(packet.dts * packet.time_base))
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert np.diff(times["video"]) == pytest.approx(1 / FPS, abs=0.002)
    steps = np.diff(times["audio"])
    assert times["audio"][0] < 0.3      # two B-frames before the first picture is shown
    assert times["audio"][-1] > 3 * FRAMES / FPS
    assert (steps > 0).all()
    assert steps.max() < 3 * 1024 / rate
    assert times["audio"][-1] == pytest.approx(times["video"][-1], abs=0.3)


@pytest.mark.parametrize("kind", ["picture of odd size", "another codec"])
def test_what_is_not_h264_is_encoded(tmp_path: Path, kind: str) -> None:
    if kind == "another codec":
        file = tmp_path / "video.avi"
        with av.open(str(file), "w") as container:
            stream = container.add_stream("mpeg4", rate=FPS)
            stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
            for _ in range(FRAMES):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 128, 3), np.uint8), "rgb24")))
            container.mux(stream.encode(None))
    else:
        file = tmp_path / "picture.png"
        Image.new("RGB", (129, 65), (200, 30, 30)).save(file)
    url = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    process = publish(file, url, "--loop")
    try:
        with av.open(url, options=LISTEN, timeout=30) as container:
            frames = list(itertools.islice(container.decode(video=0), 20))
            codec = container.streams.video[0].codec.name
    finally:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert codec == "h264"
    assert {(frame.width, frame.height) for frame in frames} == {(128, 64)}


def test_bad_input_is_status_2_and_one_line(video: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    closed = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    for arguments, expected in (
        ((video, "http://127.0.0.1/live"), "url scheme of 'http://127.0.0.1/live' is 'http', expected one of rtmp"),
        ((tmp_path / "none.mp4", closed), "does not exist, expected a video or a picture"),
        ((text, closed), "cannot be read"),
        ((video, closed), f"server of {closed!r} is lost: connection refused"),
    ):
        process = publish(*arguments)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 2
        assert expected in errors
        assert errors.count("\n") == 1


def test_a_lost_server_ends_it_and_a_loop_tries_again(video: Path) -> None:
    url = f"rtmp://127.0.0.1:{free_port()}/live/camera"
    process = publish(video, url, "--loop")
    try:
        first = receive(url, 5)
        again = receive(url, 5)
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert first[0][0] == again[0][0] == 0
    assert "trying again" in errors
