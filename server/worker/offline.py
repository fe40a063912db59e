"""`mr360 render` and `mr360 lights`: the live pipeline on stills and clips."""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
from pydantic import ValidationError
from tqdm import tqdm

from renderer.color import linear_from_srgb
from renderer.frame import RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context, GLUnavailableError
from renderer.light.inverse_tone_mapping import radiance_from_linear
from renderer.pipeline import Pipeline, Rendered, TouchedRadiance
from renderer.scene import Lighting, Scene
from server.worker.clip import ClipWriter
from server.worker.images import PANORAMA_SUFFIXES, RADIANCE_SUFFIXES, ImageError, read_still, write_still
from server.worker.light_message import light_message
from server.worker.output_clock import CLOCK_RATE
from server.worker.picture import PictureReader, output_size
from server.worker.statistics import percentiles

BAD_INPUT = 2
STILL_OUTPUTS = {".png", ".exr"}
FAILURES = (ImageError, GLUnavailableError, OSError, ValueError, av.error.FFmpegError)


class UsageError(ValueError):
    """What was asked for does not exist or does not fit together."""


@dataclass
class _Report:
    frames_in: int = 0
    frames_out: int = 0
    render_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    touched_fraction: float = 0.0
    lights: dict[str, Any] | None = None
    started: float = field(default_factory=time.monotonic)

    def add(self, rendered: Rendered, elapsed_ms: float, name: str, pts: float) -> None:
        self.frames_out += 1
        self.render_ms.append(elapsed_ms)
        for stage, value in rendered.timings.stages.items():
            self.stages_ms.setdefault(stage, []).append(value)
        self.touched_fraction = rendered.touched_fraction
        self.lights = light_message(rendered.light, stream=name, frame=self.frames_out, pts=pts,
                                    rtp_timestamp=round(pts * CLOCK_RATE), captured_at=time.time())

    def as_json(self, renderer: str) -> dict[str, Any]:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        figures = percentiles(self.render_ms)
        return {"frames_in": self.frames_in, "frames_out": self.frames_out,
                "frames_dropped": self.frames_in - self.frames_out,
                "fps": round(self.frames_out / max(time.monotonic() - self.started, 1e-6), 3), "render_ms": figures,
                "latency_ms": figures,  # offline, a frame is late by its rendering alone
                "stages_ms": {stage: percentiles(values) for stage, values in self.stages_ms.items()},
                "renderer": renderer, "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 3),
                "touched_fraction": round(self.touched_fraction, 6),
                "lights": self.lights["lights"] if self.lights else [], "light_message": self.lights}


def run_render(arguments: argparse.Namespace) -> int:
    """Render INPUT with a scene to OUT. Returns the exit status."""
    try:
        scene, scene_folder = _scene(arguments.scene, arguments.preset)
        report, renderer = _render(arguments.input, arguments.output, scene, scene_folder)
        if arguments.report is not None:
            arguments.report.write_text(json.dumps(report.as_json(renderer), indent=1) + "\n")
    except FAILURES as error:
        return _refuse("render", error)
    return 0


def run_lights(arguments: argparse.Namespace) -> int:
    """Print the light message of a still, or of a video's first frame. Returns the exit status."""
    try:
        if arguments.count != "auto" and arguments.method != "probe":
            raise UsageError(f"count {arguments.count} for method {arguments.method!r}, expected method probe")
        lighting = Lighting(lights=arguments.method, light_count=arguments.count)
        suffix = arguments.input.suffix.lower()
        frame = (read_still(arguments.input) if suffix in PANORAMA_SUFFIXES | RADIANCE_SUFFIXES
                 else next(_video_frames(arguments.input))[0])
        context = Context()
        pipeline = Pipeline(context, type(frame), frame.size)
        light, _ = pipeline.analyse(frame, lighting=lighting)
        message = light_message(light, stream=arguments.input.name, frame=1, pts=0.0, rtp_timestamp=0, captured_at=time.time())
        pipeline.release()
        context.release()
        print(json.dumps(message))
    except FAILURES as error:
        return _refuse("lights", error)
    return 0


def _refuse(command: str, error: BaseException) -> int:
    print(f"mr360 {command}: {' '.join(str(error).split())}", file=sys.stderr)
    return BAD_INPUT


def _scene(path: Path | None, preset: str | None) -> tuple[Scene, Path | None]:
    data: Any = {}
    if path is not None:
        if not path.is_file():
            raise UsageError(f"scene {str(path)!r} does not exist")
        try:
            data = json.loads(path.read_text())
        except ValueError as error:
            raise UsageError(f"scene {path.name!r} is not JSON: {error}") from None
    if preset is not None and isinstance(data, dict):
        data["lighting"] = {**(data.get("lighting") or {}), "preset": preset}
    try:
        scene = Scene.model_validate(data, context={"allow_mesh_paths": True})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "scene"
        name = path.name if path else "of the command line"
        raise UsageError(f"scene {name!r}: {where}: {first['msg']}, given {first['input']!r:.120}") from None
    return scene, path.parent if path else None


def _render(source: Path, output: Path, scene: Scene, scene_folder: Path | None) -> tuple[_Report, str]:
    suffix = source.suffix.lower()
    is_still = suffix in PANORAMA_SUFFIXES | RADIANCE_SUFFIXES
    expected = STILL_OUTPUTS if is_still else {".mp4"}
    if output.suffix.lower() not in expected:
        raise UsageError(f"output {output.name!r} for input {source.name!r}, expected {' or '.join(sorted(expected))}")
    if not output.parent.is_dir():
        raise UsageError(f"output folder {str(output.parent)!r} does not exist")
    context = Context()
    try:
        render = _render_still if is_still else _render_video
        return render(context, source, output, scene, scene_folder), context.renderer
    finally:
        context.release()


def _checked(rendered: Rendered) -> Rendered:
    if rendered.errors:
        raise UsageError("; ".join(rendered.errors.values()))
    return rendered


def _render_still(context: Context, source: Path, output: Path, scene: Scene, scene_folder: Path | None) -> _Report:
    report = _Report(frames_in=1)
    frame = read_still(source)
    pipeline = Pipeline(context, type(frame), frame.size, mesh_root=scene_folder)
    started = time.perf_counter()
    rendered = _checked(pipeline.render(frame, scene))
    report.add(rendered, (time.perf_counter() - started) * 1e3, source.name, 0.0)
    pipeline.release()
    result = rendered.frame
    assert isinstance(result, RgbFrame | RadianceFrame)
    if output.suffix.lower() == ".exr" and isinstance(frame, RgbFrame):
        result = _radiance(frame, rendered.touched)
    write_still(output, result)
    return report


def _radiance(frame: RgbFrame, touched: TouchedRadiance | None) -> RadianceFrame:
    """Of a panorama: what was composited as it is, all else by inverse tone mapping of its codes."""
    radiance = radiance_from_linear(linear_from_srgb(frame.rgb / 255.0)).astype(np.float32)
    return RadianceFrame(radiance if touched is None else np.where(touched.mask[..., None], touched.rgb, radiance))


def _video_frames(source: Path) -> Iterator[tuple[YuvFrame, float, float, int]]:
    """Frames with their time in seconds, the clip's rate and length in frames (0: unknown)."""
    if not source.is_file():
        raise UsageError(f"input {str(source)!r} does not exist")
    with av.open(str(source)) as container:
        if not container.streams.video:
            raise UsageError(f"input {source.name!r} has no video stream")
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 30)
        reader: PictureReader | None = None
        for index, frame in enumerate(container.decode(stream)):
            if reader is None:
                reader = PictureReader(output_size(frame.width, frame.height))
            yield reader.read(frame), frame.time if frame.time is not None else index / rate, rate, stream.frames


def _render_video(context: Context, source: Path, output: Path, scene: Scene, scene_folder: Path | None) -> _Report:
    report = _Report()
    pipeline: Pipeline | None = None
    frames = _video_frames(source)
    first = next(frames, None)
    if first is None:
        raise UsageError(f"input {source.name!r} has no frames")
    with ClipWriter(output, first[2]) as clip, tqdm(unit="frame", total=first[3] or None,
                                                    disable=not sys.stderr.isatty()) as progress:
        for picture, pts, _, _ in itertools.chain([first], frames):
            report.frames_in += 1
            if pipeline is None:
                pipeline = Pipeline(context, YuvFrame, picture.size, mesh_root=scene_folder)
            started = time.perf_counter()
            rendered = _checked(pipeline.render(picture, scene, moment=pts))
            report.add(rendered, (time.perf_counter() - started) * 1e3, source.name, pts)
            assert isinstance(rendered.frame, YuvFrame)
            clip.write(rendered.frame, pts)
            progress.update()
    if pipeline is not None:
        pipeline.release()
    return report
