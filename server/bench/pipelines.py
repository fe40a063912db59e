"""Pipelines by kind and size of frame, so that frames of one size share theirs: compiling their shaders takes a second."""

from __future__ import annotations

from renderer.frame import Frame
from renderer.gl import Context
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Lighting


class Pipelines:
    """Owns all that it hands out."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self._known: dict[tuple[type[Frame], tuple[int, int]], Pipeline] = {}

    def of(self, frame: Frame) -> Pipeline:
        """As for the first frame of a stream: what earlier ones were like is forgotten."""
        key = (type(frame), frame.size)
        if key not in self._known:
            self._known[key] = Pipeline(self.context, *key)
        self._known[key].reset()
        return self._known[key]

    def light(self, frame: Frame, lighting: Lighting | None = None) -> FrameLight:
        return self.of(frame).analyse(frame, lighting=lighting)[0]

    def release(self) -> None:
        for pipeline in self._known.values():
            pipeline.release()
        self._known.clear()
