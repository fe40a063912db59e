"""The light of live frames on the real renderer, by a clock of our own on which there is time for everything."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from server.demo.camera import Camera, sun_direction
from server.demo.sample_scene import sample_scene
from server.worker.light_follower import LightFollower
from server.worker.light_schedule import LightSchedule

FPS = 30
SIZE = WIDTH, HEIGHT = 512, 256
Picture = Callable[[int], YuvFrame]


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    context = Context()
    yield context
    context.release()


class Stream:
    """Renders frame after frame with a follower, as the render loop does."""

    def __init__(self, context: Context) -> None:
        self.pipeline = Pipeline(context, YuvFrame, SIZE)
        self.follower = LightFollower(self.pipeline, WIDTH, LightSchedule(clock=lambda: 0.0))
        self.scene = Scene.model_validate(sample_scene())
        self._frame = 0

    def show(self, frames: int, picture: Picture, *, every_frame: bool = False) -> list[int]:
        """Those of the next so many frames whose light has been read."""
        read = []
        for number in range(self._frame, self._frame + frames):
            frame, moment = picture(number), number / FPS
            self.follower.look(frame)
            light = self.follower.light
            rendered = self.pipeline.render(frame, self.scene, light=light, moment=moment)
            if light is None:
                self.follower.take(rendered.light, moment)
                read.append(number)
                continue
            found, _ = self.follower.follow(moment, 1 / FPS, self.scene.lighting, every_frame=every_frame)
            read += [number] if found is not None else []
        self._frame += frames
        return read


@pytest.fixture
def stream(context: Context) -> Iterator[Stream]:
    stream = Stream(context)
    yield stream
    stream.pipeline.release()


def room(number: int, lamp_radius_deg: float = 0.0) -> YuvFrame:
    """A dim room with a camera's noise, and a lamp."""
    directions = pixel_directions(HEIGHT, WIDTH)
    lamp = directions @ np.array([0.6, 0.64, -0.48]) > np.cos(np.radians(lamp_radius_deg))
    codes = np.where(lamp & (lamp_radius_deg > 0), 235, 70 + 30 * directions[..., 1])
    noisy = codes + np.random.default_rng(number).normal(0, 1.2, codes.shape)
    return YuvFrame(np.clip(noisy.round(), 16, 235).astype(np.uint8), *(np.full((HEIGHT // 2, WIDTH // 2), 128, np.uint8),) * 2)


def test_a_still_room_is_read_a_few_times_a_second_for_all_its_noise(stream: Stream) -> None:
    assert len(stream.show(60, room)) > 12, "at first the light is read until all has settled"
    assert len(stream.show(90, room)) <= 9
    assert stream.follower.need.interval_s() > 0.3


def test_a_lamp_that_is_switched_on_is_read_at_once_and_lights_within_a_few_frames(stream: Stream) -> None:
    stream.show(120, room)
    assert not stream.follower.light.detection.lights
    read = stream.show(3, lambda number: room(number, 4.0))
    assert read == [120, 121, 122], "as many as a birth takes"
    lit, = stream.follower.light.detection.lights
    stream.show(9, lambda number: room(number, 4.0))
    now, = stream.follower.light.detection.lights
    assert now.irradiance.mean() > 3 * lit.irradiance.mean(), "it fades in in a quarter of a second"
    assert len(stream.show(120, lambda number: room(number, 4.0))) < 40, "the power of what is clipped is smoothed for seconds"
    assert len(stream.show(30, lambda number: room(number, 4.0))) <= 4
    read = stream.show(3, room)
    assert read[0] == 282, "it is switched off"
    assert not stream.follower.light.detection.lights


def test_a_cut_is_read_before_it_is_shown(stream: Stream) -> None:
    stream.show(60, room)
    bright = stream.show(1, lambda number: YuvFrame(np.full((HEIGHT, WIDTH), 180, np.uint8),
                                                    *(np.full((HEIGHT // 2, WIDTH // 2), 128, np.uint8),) * 2))
    assert bright == [60]


def test_a_sun_that_moves_is_followed_from_frame_to_frame(stream: Stream) -> None:
    camera = Camera(WIDTH)

    def sunny(number: int) -> YuvFrame:
        return YuvFrame(*camera.frame(number / FPS))

    stream.show(30, sunny)
    assert len(stream.show(30, sunny)) >= 28
    sun = max(stream.follower.light.detection.lights, key=lambda light: float(light.irradiance.sum()))
    assert np.degrees(np.arccos(sun.direction @ np.array(sun_direction(59 / FPS)))) < 1.0


def test_subscribers_to_the_light_have_every_frame_read(stream: Stream) -> None:
    stream.show(90, room)
    assert len(stream.show(20, room, every_frame=True)) == 20


def test_after_an_edit_the_light_is_read_until_all_has_settled(stream: Stream) -> None:
    stream.show(150, room)
    stream.follower.disturb()
    assert len(stream.show(10, room)) >= 7


def test_what_the_budget_tolerates_neither_glance_nor_surprise_reads_all_the_same(stream: Stream) -> None:
    camera = Camera(WIDTH)

    def sunny(number: int) -> YuvFrame:
        return YuvFrame(*camera.frame(number / FPS))

    stream.show(45, sunny)
    assert stream.follower.situation(1 / FPS).rate > 20.0
    stream.follower.tolerance = 8.0
    stream.show(15, sunny)
    assert len(stream.show(60, sunny)) <= 20
    sun = max(stream.follower.light.detection.lights, key=lambda light: float(light.irradiance.sum()))
    assert np.degrees(np.arccos(sun.direction @ np.array(sun_direction(119 / FPS)))) < 5.0
