"""Sound through a real worker: in time with its picture, whatever the source does, and never in the picture's way."""

from __future__ import annotations

import itertools
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tests.worker.flash_and_beep import Packet, Receiver, receive, write_clip
from tests.worker.real_worker import RealWorker

IN_SYNC_MS = 45
BOTH = ("full/h264", "audio/opus")
State = dict[str, Any]


@contextmanager
def worker_on(source: str | Path, tracks: tuple[str, ...] = BOTH) -> Iterator[RealWorker]:
    running = RealWorker(source, tracks)
    try:
        yield running
    finally:
        running.stop()


def states_until(worker: RealWorker, wanted: Callable[[State], bool]) -> State:
    return next(message for message, _ in worker.messages() if message["type"] == "state" and wanted(message))


def assert_in_sync(receiver: Receiver, flashes: int) -> None:
    skews = receiver.skews_ms()
    assert len(skews) == flashes - 1
    assert max(map(abs, skews)) < IN_SYNC_MS, skews


def threads_of(pid: int) -> list[str]:
    return [(folder / "comm").read_text().strip() for folder in Path(f"/proc/{pid}/task").iterdir()]


@pytest.mark.parametrize(("suffix", "codec", "rate", "layout", "sound_s"), [
    ("mp4", "aac", 44100, "stereo", 3.0), ("mp4", "aac", 48000, "mono", 2.8), ("mkv", "libopus", 48000, "stereo", 3.3),
    ("mkv", "libmp3lame", 32000, "stereo", 3.0), ("mov", "pcm_alaw", 8000, "mono", 3.0)])
def test_flash_and_beep_stay_together_across_the_loop(tmp_path: Path, suffix: str, codec: str, rate: int, layout: str,
                                                      sound_s: float) -> None:
    clip = write_clip(tmp_path / f"clip.{suffix}", codec=codec, rate=rate, layout=layout, sound_s=sound_s)
    with worker_on(clip) as worker:
        live = states_until(worker, lambda state: state["output"] is not None)
        receiver = receive(worker.messages(), flashes=8)
    assert (live["input"]["audio"]["sample_rate"], live["input"]["audio"]["channels"]) == (rate, 1 if layout == "mono" else 2)
    assert live["flags"] == []
    assert_in_sync(receiver, 8)
    steps = np.diff(receiver.sound_ticks)
    assert (steps == 960).all(), "sound that is continuous, or interrupted briefly, comes in contiguous packets"


def test_sound_is_encoded_only_while_it_is_wanted(tmp_path: Path) -> None:
    with worker_on(write_clip(tmp_path / "clip.mp4"), ("full/h264",)) as worker:
        silent = receive(worker.messages(), flashes=2)
        assert silent.sound_ticks == []
        assert "sound" not in threads_of(worker.pid)
        worker.demand(*BOTH)
        first = receive(worker.messages(), flashes=3)
        assert "sound" in threads_of(worker.pid)
        worker.demand("full/h264")
        after = receive(itertools.dropwhile(lambda item: item[0].get("track") == "audio/opus", worker.messages()), flashes=2)
        assert "sound" not in threads_of(worker.pid)
        worker.demand("audio/opus")
        alone = [message["timestamp"] for message, _ in itertools.islice(
            (item for item in worker.messages() if item[0].get("track") == "audio/opus"), 60)]
    assert_in_sync(first, 3)
    assert len(after.sound_ticks) < 5
    assert alone[0] > first.sound_ticks[-1]
    assert np.diff(alone) == pytest.approx(960)


def test_a_source_without_sound_sends_none(tmp_path: Path) -> None:
    with_sound, clip = write_clip(tmp_path / "with.mp4"), tmp_path / "clip.mp4"
    with av.open(str(with_sound)) as given, av.open(str(clip), "w") as container:
        stream = container.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    with worker_on(clip) as worker:
        live = states_until(worker, lambda state: state["output"] is not None)
        receiver = receive(worker.messages(), flashes=2)
    assert live["input"]["audio"] is None
    assert receiver.sound_ticks == []


def test_broken_sound_is_given_up_by_name_and_the_picture_goes_on(tmp_path: Path) -> None:
    def broken(index: int, packet: Packet) -> Packet:
        wrong = av.Packet(bytes(200))
        wrong.pts, wrong.dts, wrong.time_base, wrong.duration = packet.pts, packet.dts, packet.time_base, packet.duration
        wrong.stream = packet.stream
        return wrong

    with worker_on(write_clip(tmp_path / "clip.mkv", damage=broken)) as worker:
        flagged = states_until(worker, lambda state: "no_sound" in state["flags"])
        receiver = receive(worker.messages(), flashes=4)
    assert flagged["source"] == "live"
    assert receiver.sound_ticks == []
    assert np.diff(receiver.flashes) == pytest.approx(1.0, abs=0.04)


def test_sound_that_is_lost_and_comes_back_is_in_time_again(tmp_path: Path) -> None:
    """Packets 30 to 40 are missing (0.26 s: silence is put in), and 70 to 106 (0.86 s: the time stamps jump)."""
    missing = {*range(30, 41), *range(70, 107)}
    clip = write_clip(tmp_path / "clip.mkv", seconds=4, damage=lambda index, packet: None if index in missing else packet)
    with worker_on(clip) as worker:
        receiver = receive(worker.messages(), flashes=9)
    near = [skew for skew in receiver.skews_ms() if abs(skew) < 500]      # the others have lost their beep
    assert len(near) >= 6
    assert max(map(abs, near)) < IN_SYNC_MS, near
    steps = np.diff(receiver.sound_ticks)
    jumps = steps[steps != 960]
    assert len(jumps) in (2, 3)
    assert jumps / 48_000 == pytest.approx(0.86, abs=0.05)


def test_sound_over_rtmp_stays_in_time_when_the_publisher_starts_again(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mp4")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"127.0.0.1:{probe.getsockname()[1]}/live/camera"
    command = [sys.executable, "-m", "server.cli", "publish", str(clip), f"rtmp://{url}", "--loop"]
    with worker_on(f"rtmp-listen://{url}") as worker:
        publisher = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            states_until(worker, lambda state: state["source"] == "live")
            first = receive(worker.messages(), flashes=5)
            publisher.kill()
            publisher.wait()
            states_until(worker, lambda state: state["source"] == "lost")
            time.sleep(0.7)
            publisher = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            states_until(worker, lambda state: state["source"] == "live")
            again = receive(worker.messages(), flashes=5)
        finally:
            publisher.send_signal(signal.SIGKILL)
            publisher.wait()
    for receiver in (first, again):
        assert_in_sync(receiver, 5)
    assert again.sound_ticks[0] > first.sound_ticks[-1]
    assert (np.diff(again.sound_ticks) >= 960).all()
