from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.worker.load_control import LoadControl
from server.worker.newest import Newest
from server.worker.output_clock import CLOCK_RATE, MIN_STEP, OutputClock


def test_the_newest_value_wins_and_the_others_are_counted() -> None:
    slot: Newest[int] = Newest()
    for value in range(5):
        slot.put(value)
    assert (slot.take(0), slot.take(0), slot.dropped) == (4, None, 4)


def test_a_wake_ends_the_wait() -> None:
    slot: Newest[int] = Newest()
    threading.Timer(0.05, slot.wake).start()
    started = time.monotonic()
    assert slot.take(timeout=30) is None
    assert time.monotonic() - started < 20


def test_the_output_clock_keeps_the_sources_spacing_under_jitter() -> None:
    clock = OutputClock(1000)
    ticks = [clock.timestamp(index / 30, 50.0 + index / 30 + jitter) for index, jitter in enumerate([0, 0.02, -0.01, 0.03])]
    assert ticks == [1000 + index * 3000 for index in range(4)]
    assert clock.discontinuities == 0


def test_the_output_clock_survives_a_restart_of_the_source() -> None:
    clock = OutputClock(0)
    first = [clock.timestamp(100 + index / 30, index / 30) for index in range(30)]
    again = [clock.timestamp(index / 30, 5 + index / 30) for index in range(30)]
    assert again[0] - first[-1] == pytest.approx(4 * CLOCK_RATE, abs=CLOCK_RATE / 10)
    assert clock.discontinuities == 1


@given(st.lists(st.tuples(st.one_of(st.none(), st.floats(-1e6, 1e6)), st.floats(0, 0.5)), min_size=2, max_size=50))
def test_the_output_clock_never_goes_back(steps: list[tuple[float | None, float]]) -> None:
    clock = OutputClock(7)
    now, last = 100.0, 7 - MIN_STEP
    for pts, step in steps:
        now += step
        ticks = clock.timestamp(pts, now)
        assert ticks >= last + MIN_STEP
        last = ticks


def test_under_load_the_light_is_read_less_often_and_again_when_there_is_room() -> None:
    now = [0.0]
    control = LoadControl(clock=lambda: now[0])

    def share_reused(seconds: float, drops_per_s: float) -> float:
        nonlocal dropped
        reused = 0
        frames = int(seconds * 30)
        for frame in range(frames):
            now[0] += 1 / 30
            dropped += drops_per_s / 30
            reused += control.reuse_light(frame, int(dropped))
        return reused / frames

    dropped = 0.0
    assert share_reused(5, 0) == 0
    share_reused(0.5, 5)
    assert control.environment_interval == 2
    share_reused(2, 5)
    assert control.environment_interval == 4
    assert share_reused(2, 5) == pytest.approx(0.75, abs=0.02)
    share_reused(12, 0)
    assert control.environment_interval == 1


def test_an_attempt_that_fails_is_repeated_ever_more_rarely() -> None:
    now, dropped, attempts = [0.0], 0, 0
    control = LoadControl(clock=lambda: now[0])
    for frame in range(60 * 30):
        now[0] += 1 / 30
        before = control.environment_interval
        dropped += before == 1
        control.reuse_light(frame, dropped)
        attempts += before == 2 and control.environment_interval == 1
    assert 2 <= attempts <= 5
