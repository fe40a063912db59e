"""Recordings by their real process: what is in the files, and what is left of them after a crash."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from encoded_stream import FIRST_TIMESTAMP, FPS, SIZE, EncodedStream, beep_times, flash_times
from encoded_stream import pictures as encoded_pictures

from server.outputs import output as output_module
from server.outputs import process as process_module
from server.outputs.beginning import Beginning
from server.outputs.output import Output
from server.outputs.recording import Recording
from server.outputs.spec import OutputSpec
from server.worker.spherical import SPHERICAL_UUID

LIMIT_S = 30.0


@asynccontextmanager
async def recording(stream: EncodedStream, folder: Path, **spec: Any) -> AsyncIterator[Output]:
    made = OutputSpec.model_validate({"id": "rec", "kind": "record", "prefix": "show", **spec})
    output = Output(made, stream, recordings_dir=str(folder), networks=None, changed=lambda: None)
    output.source_changed("live", None, stream.input)
    output.start()
    try:
        yield output
    finally:
        await output.stop()


async def until(condition: Callable[[], object], limit_s: float = LIMIT_S) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


def pid(output: Output) -> int:
    assert output._process is not None
    return output._process.pid


def pictures(path: Path) -> list[tuple[float, float]]:
    """Time and mean luma of every picture."""
    with av.open(str(path)) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == SIZE
        return [(float(frame.time), float(frame.to_ndarray(format="gray").mean())) for frame in container.decode(video=0)]


def log_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.with_suffix(".scene.jsonl").read_text().splitlines()]


async def test_a_killed_recording_plays_and_the_next_one_is_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "BACKOFF_S", (1.1, 2.0))
    async with EncodedStream(speed=4) as stream, recording(stream, tmp_path / "new" / "folder") as output:
        await until(lambda: output.live)
        first = tmp_path / "new" / "folder" / str(output.detail)
        await until(lambda: output.frames > 8 * FPS)
        os.kill(pid(output), signal.SIGKILL)
        await until(lambda: output.state == "retrying")
        assert "SIGKILL" in str(output.detail)
        await until(lambda: output.live)
        second = first.with_name(str(output.detail))
        assert second != first
        assert output.restarts == 1
        frames_before = output.frames
        await until(lambda: output.frames > frames_before + FPS)
    assert re.fullmatch(r"show-\d{8}T\d{6}Z\.mp4", first.name)
    assert SPHERICAL_UUID in first.read_bytes()[:4096]
    times = [time for time, _ in pictures(first)]
    assert times[0] == 0
    assert np.allclose(np.diff(times), 1 / FPS, atol=1e-3)
    assert times[-1] > 4, "all but the last fragment, two seconds at most, must be there"
    assert len(pictures(second)) > FPS


async def test_flash_and_beep_are_together_in_the_file(tmp_path: Path) -> None:
    async with EncodedStream(speed=2, sound=True) as stream, recording(stream, tmp_path) as output:
        await until(lambda: output.frames > 5 * FPS)
    path, = tmp_path.glob("*.mp4")
    with av.open(str(path)) as container:
        assert container.streams.audio[0].codec_context.name == "aac"
        frames = list(container.decode(audio=0))
    samples = np.concatenate([frame.to_ndarray()[0] for frame in frames])
    assert frames[0].time is not None
    beeps = beep_times(samples, float(frames[0].time))
    flashes = flash_times(pictures(path))
    assert len(flashes) >= 4
    for flash in flashes:
        nearest = min(beeps, key=lambda beep: abs(beep - flash))
        assert abs(nearest - flash) < 0.045


async def test_the_log_tells_which_picture_shows_a_revision_first(tmp_path: Path) -> None:
    async with EncodedStream(speed=2) as stream, recording(stream, tmp_path) as output:
        await until(lambda: output.frames > FPS)
        stream.revision = 7
        await until(lambda: output.frames > 2 * FPS)
        output.source_changed("lost", "source ended", None)
        await until(lambda: output.frames > 3 * FPS)
    path, = tmp_path.glob("*.mp4")
    head, first, second, lost = log_lines(path)
    assert head["stream"] == "live"
    assert head["file"] == path.name
    assert head["geometry"] == {"width": SIZE[0], "height": SIZE[1], "projection": "equirectangular"}
    assert head["clock"]["rate"] == 90_000
    assert head["clock"]["origin"] >= FIRST_TIMESTAMP
    assert (first["time"], first["revision"], first["scene"]) == (0, 1, {"revision_of_the_test": 1})
    assert (second["revision"], second["scene"]) == (7, {"revision_of_the_test": 7})
    assert any(abs(time - second["time"]) < 1e-3 for time, _ in pictures(path))
    assert (lost["source"], lost["detail"]) == ("lost", "source ended")


async def test_a_hung_process_is_killed_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_module, "SILENCE_LIMIT_S", 1.5)
    async with EncodedStream() as stream, recording(stream, tmp_path) as output:
        await until(lambda: output.live)
        hung = pid(output)
        os.kill(hung, signal.SIGSTOP)
        await until(lambda: output.state == "retrying")
        assert "silent" in str(output.detail)
        await until(lambda: output.live)
        with pytest.raises(ProcessLookupError):
            os.kill(hung, 0)


async def test_a_folder_that_cannot_be_made_is_told_and_not_tried_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    async with EncodedStream() as stream, recording(stream, tmp_path / "file") as output:
        await until(lambda: output.state == "failed-config")
        assert output.detail == "file exists"
        await asyncio.sleep(1)
        assert output.restarts == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 KiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], check=False, capture_output=True).returncode:
        pytest.skip("no right to mount a small disk")
    yield folder
    subprocess.run(["umount", folder], check=True)


async def test_a_full_disk_is_the_output_s_trouble_alone(small_disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "HOPELESS_RETRY_S", 2.0)
    async with EncodedStream(speed=4) as stream, recording(stream, small_disk) as full, recording(stream, tmp_path) as healthy:
        ballast = small_disk / "ballast"
        ballast.write_bytes(bytes(50_000))
        await until(lambda: full.state == "failed-config")
        assert full.detail == "no space left on device"
        frames = healthy.frames
        await until(lambda: healthy.frames > frames + FPS)
        assert (healthy.state, healthy.restarts) == ("live", 0)
        for file in small_disk.iterdir():
            file.unlink()
        await until(lambda: full.live)


@pytest.mark.parametrize("free_bytes", [0, 4096])
async def test_tries_on_a_full_disk_leave_nothing_behind(small_disk: Path, free_bytes: int,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither an empty film nor, where its header finds room, one without pictures and its log."""
    monkeypatch.setattr(output_module, "HOPELESS_RETRY_S", 0.1)
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes((64 << 10) - free_bytes))
    async with EncodedStream(speed=4) as stream, recording(stream, small_disk) as output:
        await until(lambda: output.restarts >= 3 and output.state == "failed-config")
        assert output.detail == "no space left on device"
    assert list(small_disk.iterdir()) == [ballast]


def test_a_recording_that_ends_before_its_first_picture_leaves_nothing_and_one_of_a_picture_is_kept(tmp_path: Path) -> None:
    frame = next(encoded_pictures(1.0))
    for age_s, kept in ((1.0, 0), (-1.0, 1)):       # the first picture is younger than the file
        film = Recording(tmp_path, "show", "live", Beginning(lambda: None, sound=False), sound=False)
        film.note({"type": "scene", "scene": {}})
        picture = {"timestamp": frame.timestamp, "revision": 1, "keyframe": True, "decoded_at": time.monotonic() - age_s}
        assert film.write_picture(picture, frame.data) == bool(kept)
        film.close()
        film.discard_empty()
        assert len(list(tmp_path.glob("*.mp4"))) == len(list(tmp_path.glob("*.jsonl"))) == kept


async def test_a_full_disk_is_not_tried_again_at_once(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "BACKOFF_S", (0.1, 0.2))
    (small_disk / "ballast").write_bytes(bytes(64 << 10))
    async with EncodedStream(speed=4) as stream, recording(stream, small_disk) as output:
        await until(lambda: output.detail == "no space left on device")
        await asyncio.sleep(1)
        assert output.restarts == 0


async def test_sound_that_comes_begins_another_file(tmp_path: Path) -> None:
    async with EncodedStream(speed=2) as stream, recording(stream, tmp_path) as output:
        await until(lambda: output.frames > FPS)
        stream._sound = True
        output.source_changed("live", None, stream.input)
        await until(lambda: output.state == "retrying")
        assert output.detail == "the source's sound has come"
        await until(lambda: output.live)
        frames = output.frames
        await until(lambda: output.frames > frames + 2 * FPS)
    silent, loud = sorted(tmp_path.glob("*.mp4"))
    with av.open(str(silent)) as container:
        assert not container.streams.audio
    with av.open(str(loud)) as container:
        assert sum(frame.samples for frame in container.decode(audio=0)) > 48_000


async def test_an_output_waits_for_a_source_without_a_process(tmp_path: Path) -> None:
    async with EncodedStream() as stream:
        output = Output(OutputSpec(id="rec", kind="record", prefix="show"), stream, recordings_dir=str(tmp_path), networks=None,
                        changed=lambda: None)
        output.start()
        await asyncio.sleep(0.5)
        assert (output.state, output.detail, output._process) == ("connecting", "the stream has no source yet", None)
        assert not len(stream.tracks.fanout("full/h264"))
        output.source_changed("live", None, stream.input)
        await until(lambda: output.live)
        assert len(stream.tracks.fanout("full/h264")) == 1
        assert stream.tracks.viewers == 0
        await output.stop()
        assert not len(stream.tracks.fanout("full/h264"))


async def test_changes_at_the_same_time_leave_one_process_and_none_after_the_end(tmp_path: Path) -> None:
    async with EncodedStream() as stream, recording(stream, tmp_path) as output:
        await until(lambda: output.live)
        specs = [output.spec.model_copy(update={"prefix": f"p{number}"}) for number in range(3)]
        await asyncio.gather(*(output.replace(spec, None) for spec in specs))
        await until(lambda: output.live)
        assert str(output.detail).startswith("p2-")
        assert len(stream.tracks.fanout("full/h264")) == 1
        await asyncio.gather(output.replace(specs[0], None), output.stop())
        await asyncio.sleep(0.3)
        assert not len(stream.tracks.fanout("full/h264"))
