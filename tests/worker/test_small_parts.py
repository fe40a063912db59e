from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.worker.light_schedule import PREPARE, READ, LightSchedule
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
    moments = [clock.moment(index / 30, 50.0 + index / 30 + jitter) for index, jitter in enumerate([0, 0.02, -0.01, 0.03])]
    ticks = [clock.ticks(moment) for moment in moments]
    assert ticks == [1000 + index * 3000 for index in range(4)]
    assert clock.discontinuities == 0


def test_the_output_clock_survives_a_restart_of_the_source() -> None:
    clock = OutputClock(0)
    first = [clock.ticks(clock.moment(100 + index / 30, index / 30)) for index in range(30)]
    again = [clock.ticks(clock.moment(index / 30, 5 + index / 30)) for index in range(30)]
    assert again[0] - first[-1] == pytest.approx(4 * CLOCK_RATE, abs=CLOCK_RATE / 10)
    assert clock.discontinuities == 1


def test_sound_moves_with_the_pictures() -> None:
    """Whatever the source's time does, what was captured together stands together; sound waits for a picture to tie it."""
    clock = OutputClock(9000)
    assert clock.sound_moment(100.0, 7.0) is None
    assert clock.moment(100.0, 7.0) == 0.0
    assert clock.sound_moment(100.25, 7.0) == 0.25
    clock.moment(3.0, 8.0)      # the source's time has jumped
    moment = clock.sound_moment(3.0, 8.1)
    assert moment == 1.0
    assert clock.sound_ticks(moment) == clock.ticks(moment) * 8 / 15 == (9000 + 90_000) * 8 / 15
    assert clock.sound_moment(103.0, 8.1) is None, "from before the jump"
    clock.new_source()
    assert clock.sound_moment(3.2, 8.2) is None
    clock.moment(3.2, 8.2)
    assert clock.sound_moment(3.2, 8.2) == pytest.approx(1.2)


@given(st.lists(st.tuples(st.one_of(st.none(), st.floats(-1e6, 1e6)), st.floats(0, 0.5)), min_size=2, max_size=50))
def test_the_output_clock_never_goes_back(steps: list[tuple[float | None, float]]) -> None:
    clock = OutputClock(7)
    now, last = 100.0, 7 - MIN_STEP
    for pts, step in steps:
        now += step
        ticks = clock.ticks(clock.moment(pts, now))
        assert ticks >= last + MIN_STEP
        last = ticks


def test_a_step_is_taken_when_it_ends_before_the_next_frame() -> None:
    now = [10.010]
    schedule = LightSchedule(clock=lambda: now[0])
    for step, seconds in ((READ, 0.010), (PREPARE, 0.012)):
        assert schedule.has_time(step, due_at=10.033), "what it takes is not known yet"
        schedule.took(step, seconds)
    assert schedule.has_time(READ, due_at=10.033)
    now[0] = 10.022
    assert not schedule.has_time(PREPARE, due_at=10.033)
    assert schedule.has_time(READ, due_at=10.033)


def test_without_time_a_step_is_taken_every_third_frame() -> None:
    now = [10.020]
    schedule = LightSchedule(clock=lambda: now[0])
    schedule.took(READ, 0.020)
    taken = []
    for _ in range(9):
        taken.append(schedule.has_time(READ, due_at=10.033))
        if taken[-1]:
            schedule.took(READ, 0.020)
    assert taken == [False, False, True] * 3
    now[0] = 10.010
    assert schedule.has_time(READ, due_at=10.033)


def test_two_values_of_one_burst_are_both_delivered() -> None:
    slot: Newest[int] = Newest(patience_s=0.5)
    for value in range(3):
        slot.put(value)
    assert (slot.take(0), slot.take(0), slot.take(0), slot.dropped) == (1, 2, None, 1)


def test_a_value_that_has_waited_too_long_gives_way_to_a_newer_one() -> None:
    slot: Newest[int] = Newest(patience_s=0.02)
    slot.put(1)
    slot.put(2)
    time.sleep(0.03)
    assert (slot.take(0), slot.take(0), slot.dropped) == (2, None, 1)
    slot.put(3)
    time.sleep(0.03)
    assert slot.take(0) == 3, "without a newer one it is not lost"
