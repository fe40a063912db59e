"""Who is shaded when: what is new at once, the rest in turn, and nobody for ever left out."""

from __future__ import annotations

from renderer.objects.shading_turns import Turns

MEMBERS = {0: 1000, 1: 2000, 2: 1500}


def test_what_is_new_never_waits() -> None:
    turns = Turns()
    assert turns.ahead(MEMBERS, (1, 0), 0) == [0, 1, 2]
    assert turns.ahead(MEMBERS, (1, 0), 0) == []
    assert turns.ahead({**MEMBERS, 5: 10**9}, (1, 0), 0) == [5]


def test_those_that_waited_longest_come_first() -> None:
    turns = Turns()
    turns.ahead(MEMBERS, (1, 0), 0)
    served = [turns.ahead(MEMBERS, (number, 0), 3000) for number in range(2, 8)]
    assert served[:3] == [[0, 1], [2, 0], [1]]
    assert all(set(served[i] + served[i + 1] + served[i + 2]) == {0, 1, 2} for i in range(4))


def test_an_object_larger_than_there_are_pixels_saves_them_up() -> None:
    turns, alone = Turns(), {0: 30_000}
    turns.ahead(alone, (1, 0), 0)
    served = [turns.ahead(alone, (number, 0), 12_000) for number in range(2, 8)]
    assert served == [[], [], [0], [], [], [0]]
    assert turns.ahead(alone, (9, 0), 12_000) == []
    assert turns.waited == 1, "views whose objects have waited are served first"


def test_turns_tell_whether_any_object_is_behind() -> None:
    turns = Turns()
    turns.ahead(MEMBERS, (1, 0), 0)
    assert not turns.is_behind
    turns.ahead(MEMBERS, (2, 0), 1000)
    assert turns.is_behind
    turns.now(MEMBERS, (2, 0), patient=True)
    assert turns.is_behind
    turns.ahead(MEMBERS, (2, 0), 5000)
    assert not turns.is_behind


def test_a_frame_waits_only_for_what_had_a_turn_ahead_of_it() -> None:
    turns = Turns()
    assert turns.now(MEMBERS, (1, 0), patient=True) == [0, 1, 2]
    turns.ahead(MEMBERS, (2, 0), 1000)
    assert turns.now(MEMBERS, (2, 0), patient=True) == []
    turns.ahead(MEMBERS, (3, 0), 0)
    assert turns.now(MEMBERS, (3, 0), patient=False) == [1, 2, 0]


def test_without_time_ahead_of_frames_objects_are_shaded_one_after_another() -> None:
    turns = Turns()
    turns.now(MEMBERS, (1, 0), patient=True)
    served = []
    for _ in range(4):
        served += turns.now(MEMBERS, (2, 0), patient=True)
        assert turns.is_behind == (len(served) < 3)
    assert served == [0, 1, 2]
    assert turns.now({**MEMBERS, 7: 500}, (3, 0), patient=True) == [7, 0], "what is new does not wait"
