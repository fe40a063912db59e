from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from server.worker.sound_timeline import BLOCK, LONGEST_SILENCE, Samples, SoundTimeline

RATE = 48_000


def numbered(first: int, count: int) -> Samples:
    """Samples that tell their own place in their two channels; none is silent."""
    places = np.arange(first, first + count)
    return np.stack((places % 30_000 + 1, places // 30_000), axis=1).astype(np.int16)


def place(sample: np.ndarray[Any, np.dtype[np.int16]]) -> int | None:
    """Of a numbered sample; None for silence."""
    low, high = map(int, sample)
    return 30_000 * high + low - 1 if low else None


def laid(pieces: list[tuple[int, Samples]]) -> list[tuple[int, Samples]]:
    timeline = SoundTimeline()
    return [block for tick, samples in pieces for block in timeline.lay(samples, tick)]


def test_pieces_of_any_length_become_blocks_that_follow_each_other() -> None:
    blocks = laid([(500 + first, numbered(first, 1024)) for first in range(0, 20 * 1024, 1024)])
    assert [tick for tick, _ in blocks] == [500 + index * BLOCK for index in range(20 * 1024 // BLOCK)]
    assert (np.concatenate([block for _, block in blocks]) == numbered(0, 20 * 1024)[:len(blocks) * BLOCK]).all()


def test_time_stamps_rounded_to_milliseconds_change_nothing() -> None:
    pieces = [(round(first / 48) * 48 + 30 * (-1) ** first, numbered(first, 1023)) for first in range(0, 200 * 1023, 1023)]
    sound = np.concatenate([block for _, block in laid(pieces)])
    assert (sound == numbered(0, len(sound))).all()


def test_a_gap_is_silence_and_what_follows_is_in_its_place() -> None:
    gap = RATE // 5
    blocks = laid([(0, numbered(0, 4800)), (4800 + gap, numbered(4800 + gap, 9600))])
    assert [tick for tick, _ in blocks] == [index * BLOCK for index in range(len(blocks))]
    sound = np.concatenate([block for _, block in blocks])
    assert (sound[4800:4800 + gap] == 0).all()
    assert (sound[4800 + gap:] == numbered(0, len(sound))[4800 + gap:]).all()


def test_after_a_long_gap_the_time_stamps_jump_instead() -> None:
    start = 4900 + LONGEST_SILENCE + 1000
    blocks = laid([(0, numbered(0, 4900)), (start, numbered(start, 4800))])
    assert [tick for tick, _ in blocks] == [*range(0, 6 * BLOCK, BLOCK), *range(start, start + 4800, BLOCK)]
    assert (blocks[5][1][4900 - 5 * BLOCK:] == 0).all()
    assert (blocks[6][1] == numbered(start, BLOCK)).all()


def test_what_overlaps_is_dropped() -> None:
    blocks = laid([(0, numbered(0, 9600)), (4800, numbered(4800, 9600))])
    sound = np.concatenate([block for _, block in blocks])
    assert (sound == numbered(0, len(sound))).all()
    assert len(sound) == 14_400


def test_a_clock_that_runs_slower_than_the_samples_is_followed() -> None:
    """0.1 % too few samples: the count is put right before it is off by more than 15 ms."""
    timeline, beside_s = SoundTimeline(), []
    for index in range(2000):
        for tick, block in timeline.lay(numbered(index * 1024, 1024), round(index * 1024 * 1.001)):
            found = place(block[0])
            if found is not None:
                beside_s.append((found * 1.001 - tick) / RATE)
    assert len(beside_s) > 2000
    assert max(map(abs, beside_s)) < 0.015


@given(st.lists(st.tuples(st.integers(-3 * RATE, 3 * RATE), st.integers(0, 5000)), min_size=1, max_size=40))
def test_blocks_never_overlap_whatever_the_source_says(steps: list[tuple[int, int]]) -> None:
    tick, pieces = 10 * RATE, []
    for jump, length in steps:
        tick = max(0, tick + jump)
        pieces.append((tick, numbered(0, length)))
    ticks = [found for found, _ in laid(pieces)]
    assert all(after - before >= BLOCK for before, after in itertools.pairwise(ticks))
    assert all(block.shape == (BLOCK, 2) for _, block in laid(pieces))


def test_small_lasting_errors_are_put_right() -> None:
    shift = round(0.02 * RATE)
    pieces = [(first + (shift if first >= 20_000 else 0), numbered(first, 1000)) for first in range(0, 60_000, 1000)]
    blocks = laid(pieces)
    last, block = blocks[-1]
    assert place(block[0]) == last - shift
