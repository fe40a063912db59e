"""Pictures and sound in one container: what becomes of gaps, late sound, and other encoders."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator

import av
import numpy as np
import pytest
from encoded_stream import FIRST_TIMESTAMP, FPS, SIZE, opus_packets, pictures

from server.delivery.fanout import EncodedFrame
from server.outputs.beginning import SOUND_LIMIT_S, Beginning
from server.outputs.h264 import split_parameter_sets
from server.outputs.muxing import Muxing
from server.outputs.server_link import OutputFailedError
from server.outputs.sound import CopiedOpus, EncodedAac

FIRST_SOUND = FIRST_TIMESTAMP * 8 // 15
MakeSound = Callable[[av.container.OutputContainer], CopiedOpus | EncodedAac]


def written(frames: Iterator[EncodedFrame], sound: Callable[[float], list[EncodedFrame]], make_sound: MakeSound) -> io.BytesIO:
    """Three seconds of pictures in Matroska; after each, the sound that `sound` gives for its time in seconds."""
    file = io.BytesIO()
    muxing = Muxing(file, "matroska", {}, make_sound, sets_in_band=True)
    for number, frame in enumerate(frames):
        if not muxing.opened:
            muxing.open(frame.data)
        seconds = muxing.write_picture(frame.timestamp, frame.data, keyframe=frame.keyframe)
        assert seconds == pytest.approx(number / FPS, abs=1e-4)
        for packet in sound(seconds):
            muxing.write_sound(packet.timestamp, packet.data)
    muxing.close()
    file.seek(0)
    return file


def loud_and_quiet(file: io.BytesIO) -> tuple[np.ndarray, np.ndarray]:
    """Times in seconds of each millisecond of sound, and how loud it is."""
    times, levels = [], []
    with av.open(file) as container:
        for frame in container.decode(audio=0):
            samples = np.abs(frame.to_ndarray()[0])
            for index in range(0, len(samples), 48):
                times.append(float(frame.time) + index / 48_000)
                levels.append(float(samples[index:index + 48].max()))
    return np.array(times), np.array(levels)


@pytest.mark.parametrize("make_sound", [CopiedOpus, EncodedAac])
def test_a_gap_becomes_silence_and_what_follows_is_in_its_place(make_sound: MakeSound) -> None:
    packets = list(opus_packets(3.0, always=True))

    def sound(seconds: float) -> list[EncodedFrame]:
        return [packet for packet in packets if seconds - 1 / FPS < (packet.timestamp - FIRST_SOUND) / 48_000 <= seconds
                and not 1.0 <= (packet.timestamp - FIRST_SOUND) / 48_000 < 2.0]

    times, levels = loud_and_quiet(written(pictures(3.0), sound, make_sound))
    assert np.diff(times).max() < 0.025, "the track has no holes"
    assert levels[(times > 1.05) & (times < 1.95)].max() < 0.01
    assert levels[(times > 0.3) & (times < 0.95)].min() > 0.1
    assert levels[(times > 2.1) & (times < 2.7)].min() > 0.1


@pytest.mark.parametrize("make_sound", [CopiedOpus, EncodedAac])
def test_sound_that_is_always_late_is_not_lost(make_sound: MakeSound) -> None:
    packets = list(opus_packets(3.0, always=True))

    def sound(seconds: float) -> list[EncodedFrame]:
        late = seconds - 0.25
        return [packet for packet in packets if late - 1 / FPS < (packet.timestamp - FIRST_SOUND) / 48_000 <= late]

    times, levels = loud_and_quiet(written(pictures(3.0), sound, make_sound))
    assert levels[(times > 0.3) & (times < 2.6)].min() > 0.1


@pytest.mark.parametrize("make_sound", [CopiedOpus, EncodedAac])
def test_pictures_do_not_wait_for_sound_that_has_stopped(make_sound: MakeSound) -> None:
    """Silence is written beside them at once, and what comes too late for its place is left out."""
    file = io.BytesIO()
    muxing = Muxing(file, "matroska", {"flush_packets": "1", "cluster_time_limit": "1"}, make_sound, sets_in_band=True)
    sizes = []
    for frame in pictures(3.0):
        if not muxing.opened:
            muxing.open(frame.data)
        muxing.write_picture(frame.timestamp, frame.data, keyframe=frame.keyframe)
        sizes.append(file.tell())
    grown = np.diff(sizes)[FPS // 2:]
    assert (grown > 0).all(), "each picture pushes an earlier one out"
    muxing.write_sound(FIRST_SOUND + 48_000, next(opus_packets(0.1)).data)
    muxing.close()
    times, levels = loud_and_quiet(io.BytesIO(file.getvalue()))
    assert levels.max() < 0.01
    assert times[-1] > 2.5


def test_another_encoder_s_parameters_need_another_header() -> None:
    muxing = Muxing(io.BytesIO(), "matroska", {}, None, sets_in_band=True)
    first, other = next(pictures(1.0)), next(pictures(1.0, size=(SIZE[0] * 2, SIZE[1] * 2)))
    muxing.open(first.data)
    muxing.write_picture(first.timestamp, first.data, keyframe=True)
    with pytest.raises(OutputFailedError) as error:
        muxing.write_picture(other.timestamp + 6000, other.data, keyframe=True)
    assert error.value.at_once
    muxing.close()


def test_parameter_sets_are_split_off() -> None:
    keyframe = next(pictures(1.0)).data
    sets, rest = split_parameter_sets(keyframe)
    assert sets[4] & 31 == 7
    assert sets.count(b"\0\0\0\1") == 2
    assert rest[4] & 31 in (5, 6)
    assert split_parameter_sets(b"\0\0\1\x09\xf0" + keyframe) == (sets, rest)
    assert split_parameter_sets(rest) == (b"", rest)
    assert split_parameter_sets(b"") == (b"", b"")


def test_beginning_with_a_keyframe_that_is_younger_than_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    now, asked = [100.0], []
    monkeypatch.setattr("server.outputs.beginning.time.monotonic", lambda: now[0])
    beginning = Beginning(lambda: asked.append(now[0]), sound=False)
    assert not beginning.reached_by(100.0, keyframe=True)
    now[0] = 101.0
    beginning.opened()
    assert asked == [101.0]
    assert not beginning.reached_by(100.9, keyframe=True)
    assert not beginning.reached_by(101.1, keyframe=False)
    assert beginning.reached_by(101.1, keyframe=True)


def test_beginning_waits_for_the_sound_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    now, asked = [100.0], []
    monkeypatch.setattr("server.outputs.beginning.time.monotonic", lambda: now[0])
    patient, lucky = (Beginning(lambda: asked.append(now[0]), sound=True) for _ in range(2))
    patient.opened()
    lucky.opened()
    assert not lucky.reached_by(100.1, keyframe=True)
    now[0] = 100.5
    lucky.sound_came()
    assert asked == [100.5]
    assert lucky.reached_by(100.6, keyframe=True)
    assert not patient.reached_by(100.6, keyframe=True)
    now[0] = 100.1 + SOUND_LIMIT_S
    assert not patient.reached_by(100.6, keyframe=True)
    assert patient.reached_by(now[0], keyframe=True)
