"""Sources from files; network sources are tested against real servers in tests/e2e."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from server.worker.ingest import Ingest
from server.worker.newest import Newest
from server.worker.source import Decoded, Source, SourceError, local_path, network_options


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for index in range(6):
            frame = av.VideoFrame.from_ndarray(np.full((64, 128, 3), 40 * index, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def test_a_clip_loops_with_continuous_time(clip: Path) -> None:
    source = Source(str(clip), allow_files=True)
    times = [decoded.pts for decoded in itertools.islice(source.frames(), 14)]
    source.close()
    assert times == pytest.approx([index / 20 for index in range(14)], abs=1e-6)
    assert (source.info.width, source.info.height, source.info.fps) == (128, 64, 20.0)


def test_a_still_repeats_in_real_time(tmp_path: Path) -> None:
    Image.new("RGB", (64, 32), (200, 30, 30)).save(tmp_path / "still.png")
    source = Source(f"file://{tmp_path}/still.png", allow_files=True)
    started = time.monotonic()
    frames = list(itertools.islice(source.frames(), 7))
    source.close()
    assert time.monotonic() - started >= 6 / 30 - 0.01
    assert frames[0].pts == 0.0
    assert all(a.pts < b.pts for a, b in itertools.pairwise(frames))


def bad_files(folder: Path) -> dict[str, str]:
    (folder / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(20_000))
    (folder / "empty.mp4").write_bytes(b"")
    with av.open(str(folder / "sound.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    return {"noise.mp4": "does not open", "empty.mp4": "does not open", "sound.wav": "no video", "gone.mp4": "does not exist"}


def test_unusable_files_say_why(tmp_path: Path) -> None:
    for name, expected in bad_files(tmp_path).items():
        with pytest.raises(SourceError, match=expected):
            Source(str(tmp_path / name), allow_files=True)


def test_files_are_refused_where_they_are_not_allowed(clip: Path) -> None:
    with pytest.raises(SourceError, match="is a file, expected an rtsp, rtmp or rtmp-listen url"):
        Source(str(clip), allow_files=False)


def test_a_wrong_scheme_is_named() -> None:
    with pytest.raises(SourceError, match="source scheme 'http' is not supported"):
        network_options("http://127.0.0.1/x")
    assert network_options("rtmp-listen://127.0.0.1:1935/live/a")[0] == "rtmp://127.0.0.1:1935/live/a"
    assert local_path("rtsp://127.0.0.1/x") is None


def test_ingest_retries_until_the_source_is_there_and_reports_each_state(tmp_path: Path) -> None:
    path = tmp_path / "late.png"
    states: list[tuple[str, str | None]] = []
    frames: Newest[Decoded] = Newest()
    ingest = Ingest(str(path), allow_files=True, frames=frames, on_state=lambda state, detail, info: states.append((state, detail)))
    try:
        deadline = time.monotonic() + 20
        while not any(state == "lost" for state, _ in states) and time.monotonic() < deadline:
            time.sleep(0.02)
        partial = tmp_path / "partial.png"
        Image.new("RGB", (64, 32)).save(partial)
        partial.rename(path)
        assert frames.take(timeout=20) is not None
    finally:
        ingest.stop()
    assert states[0] == ("connecting", None)
    assert states[1][0] == "lost"
    assert "does not exist" in str(states[1][1])
    assert states[-1] == ("live", None)


def test_a_stopped_ingest_delivers_nothing_more(clip: Path) -> None:
    frames: Newest[Decoded] = Newest()
    ingest = Ingest(str(clip), allow_files=True, frames=frames, on_state=lambda *_: None)
    assert frames.take(timeout=20) is not None
    ingest.stop(join_timeout=5)
    frames.take(timeout=0)
    assert frames.take(timeout=0.3) is None
