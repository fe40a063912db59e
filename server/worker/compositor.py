"""The renderer at a stream's fixed geometry: composites pictures, and reads their light when there is need and time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from av.video.frame import VideoFrame

from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Lighting, Scene
from server.worker.accuracy import Effort, Situation
from server.worker.light_follower import LightFollower
from server.worker.picture import FramePool, PictureReader
from server.worker.warm_up import warm_up

Stages = dict[str, float]       # milliseconds


@dataclass(frozen=True)
class Composite:
    """A picture with the objects in it, and the frame that its planes lie in; `light` if it had to be read before."""

    picture: YuvFrame
    video: VideoFrame
    stages: Stages
    errors: dict[str, str]
    touched_fraction: float
    light: FrameLight | None


class Compositor:
    """For one picture: `composite`, then `read_light` when the picture is on its way; or `analyse` alone. Moments are monotonic."""

    def __init__(self, context: Context, size: tuple[int, int], assets: Path | None) -> None:
        self._reader, self._pool = PictureReader(size), FramePool(size)
        self._pipeline = Pipeline(context, YuvFrame, size, assets=assets)
        warm_up(self._pipeline, size)
        self._follower = LightFollower(self._pipeline, size[0])

    @property
    def size(self) -> tuple[int, int]:
        return self._reader.size

    def planes(self, frame: VideoFrame) -> YuvFrame:
        """Of a source's frame, valid until the next call. Raises PictureError for one that cannot be read."""
        return self._reader.read(frame)

    def composite(self, picture: YuvFrame, scene: Scene, moment: float) -> Composite:
        """The picture lit by the light that is in use."""
        self._follower.look(picture)
        output, video = self._pool.take(picture.format)
        light = self._follower.light
        rendered = self._pipeline.render(picture, scene, light=light, moment=moment, output=output)
        return Composite(output, video, rendered.timings.stages, rendered.errors, rendered.touched_fraction,
                         rendered.light if light is None else None)

    def read_light(self, made: Composite, lighting: Lighting, moment: float, interval_s: float, *,
                   every_frame: bool) -> tuple[FrameLight | None, Stages]:
        """Of the picture just composited, for those that follow; as `LightFollower.follow`."""
        if made.light is not None:
            self._follower.take(made.light, moment)
            return made.light, {}
        return self._follower.follow(moment, interval_s, lighting, every_frame=every_frame)

    def analyse(self, picture: YuvFrame, lighting: Lighting, moment: float) -> tuple[FrameLight, Stages]:
        """The light of a picture that is not composited."""
        self._follower.look(picture)
        light, timings = self._pipeline.analyse(picture, moment, lighting)
        self._follower.take(light, moment)
        return light, timings.stages

    def still(self, picture: YuvFrame, scene: Scene) -> YuvFrame:
        """The picture composited with its own light, beside the stream."""
        rendered = self._pipeline.render(picture, scene)
        assert isinstance(rendered.frame, YuvFrame)
        return rendered.frame

    def disturb(self) -> None:
        """The scene is another."""
        self._follower.disturb()

    def situation(self, interval_s: float) -> Situation:
        return self._follower.situation(interval_s)

    def spend(self, effort: Effort) -> None:
        """No more than this from now on."""
        self._pipeline.quality = effort.quality
        self._follower.tolerance = effort.light_tolerance

    @property
    def light_interval(self) -> float:
        """Frames a reading of the light, of the last ones."""
        return self._follower.mean_interval

    def release(self) -> None:
        self._pipeline.release()
