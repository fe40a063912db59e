"""The clip as it lies in the cache."""

from __future__ import annotations

from pathlib import Path

import av
import pytest

from server.demo.camera import LOOP_SECONDS
from server.demo.clip import demo_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        made = demo_clip(256, 4)
        stamp = made.stat().st_mtime_ns
        assert demo_clip(256, 4) == made
        assert made.stat().st_mtime_ns == stamp, "the second call made it again"
        return made


def test_it_is_one_loop_of_tagged_video_without_b_frames(clip: Path) -> None:
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        frames = list(container.decode(stream))
        assert (stream.codec.name, stream.width, stream.height, stream.pix_fmt) == ("h264", 256, 128, "yuv420p")
        assert [frame.time for frame in frames] == pytest.approx([index / 4 for index in range(LOOP_SECONDS * 4)])
        assert not stream.codec_context.has_b_frames
        context = stream.codec_context
        tags = [int(value) for value in (context.colorspace, context.color_primaries, context.color_trc)]
        assert tags == [1, 1, 1]
        assert int(context.color_range) == 1
        keyframes = [index for index, frame in enumerate(frames) if frame.key_frame]
        assert keyframes == list(range(0, LOOP_SECONDS * 4, 4))


def test_nothing_half_made_is_left(clip: Path) -> None:
    assert list(clip.parent.iterdir()) == [clip]


@pytest.mark.parametrize("fps", [0, 121])
def test_a_rate_that_cannot_be_made_is_named(fps: int) -> None:
    with pytest.raises(ValueError, match=f"fps is {fps}, expected"):
        demo_clip(256, fps)
