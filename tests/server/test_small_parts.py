"""The small values that carry state between the parts of the service."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from pydantic import ValidationError

from renderer.scene import MAX_OBJECTS, Scene, SceneObject
from server.event_outbox import MAX_EVENTS, EventOutbox
from server.live_scene import DuplicateObjectError, LiveScene, UnknownObjectError
from server.newest import Newest
from server.percentiles import Percentiles


def test_percentiles_by_nearest_rank_over_the_window() -> None:
    ring = Percentiles(window=100)
    assert ring.summary() is None
    for value in range(1000):
        ring.add(float(value))
    assert ring.summary() == {"p50": 950.0, "p95": 995.0, "max": 999.0}


async def test_newest_gives_the_newest_once() -> None:
    mailbox: Newest[int] = Newest()
    for value in range(5):
        mailbox.put(value)
    assert await mailbox.get() == 4
    waiting = asyncio.create_task(mailbox.get())
    await asyncio.sleep(0)
    assert not waiting.done()
    mailbox.put(0)      # a value that is false is a value
    assert await asyncio.wait_for(waiting, 5) == 0


def scene_event() -> dict[str, Any]:
    return {"type": "scene", "scene": "whole"}


async def drained(outbox: EventOutbox) -> list[dict[str, Any]]:
    events = []
    while True:
        try:
            events.append(await asyncio.wait_for(outbox.get(), 0.05))
        except TimeoutError:
            return events


async def test_outbox_keeps_the_newest_of_each_subject_in_order() -> None:
    outbox = EventOutbox(scene_event)
    outbox.put({"type": "object", "id": "a", "x": 1})
    outbox.put({"type": "object", "id": "b", "x": 1})
    outbox.put({"type": "viewers", "count": 1})
    outbox.put({"type": "object", "id": "a", "x": 2})
    assert await drained(outbox) == [{"type": "object", "id": "b", "x": 1}, {"type": "viewers", "count": 1},
                                     {"type": "object", "id": "a", "x": 2}]


async def test_outbox_scene_makes_earlier_objects_superfluous() -> None:
    outbox = EventOutbox(scene_event)
    outbox.put({"type": "object", "id": "a"})
    outbox.put(scene_event())
    outbox.put({"type": "object", "id": "b"})
    assert await drained(outbox) == [scene_event(), {"type": "object", "id": "b"}]


async def test_outbox_is_bounded_and_ends_at_the_present_state() -> None:
    outbox = EventOutbox(scene_event)
    for number in range(MAX_EVENTS + 1):
        outbox.put({"type": "object", "id": str(number)})
    assert await drained(outbox) == [scene_event()]


def live_scene() -> tuple[LiveScene, list[tuple[int, str | None]]]:
    changes: list[tuple[int, str | None]] = []
    return LiveScene(lambda live, changed: changes.append((live.revision, changed))), changes


def ball(object_id: str) -> SceneObject:
    return SceneObject(id=object_id, mesh="sphere")


def test_live_scene_counts_every_change_once() -> None:
    live, changes = live_scene()
    first = live.etag
    live.add(ball("a"))
    live.update(ball("a").model_copy(update={"visible": False}))
    live.remove("a")
    live.replace(Scene(camera_height=2.0))
    assert changes == [(2, "a"), (3, "a"), (4, "a"), (5, None)]
    assert live.etag != first
    assert live.scene == Scene(camera_height=2.0)


def test_live_scene_refuses_and_stays_as_it_was() -> None:
    live, changes = live_scene()
    live.replace(Scene(objects=tuple(ball(str(number)) for number in range(MAX_OBJECTS))))
    before = live.scene
    with pytest.raises(DuplicateObjectError):
        live.add(ball("0"))
    with pytest.raises(ValidationError, match="at most"):
        live.add(ball("one-too-many"))
    with pytest.raises(UnknownObjectError):
        live.update(ball("none"))
    with pytest.raises(UnknownObjectError):
        live.remove("none")
    assert live.scene is before
    assert len(changes) == 1


def test_etags_of_two_runs_differ() -> None:
    assert live_scene()[0].etag != live_scene()[0].etag
