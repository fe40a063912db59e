"""A file's skins and animations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from renderer.models.animation import Clip, Interpolation, Path, Track
from renderer.models.gltf.accessors import Buffers
from renderer.models.gltf.document import GltfError, item, printable, shown
from renderer.models.hierarchy import Array, Indices
from renderer.models.skeleton import MAX_COORDINATE

MAX_CHANNELS = 16_384
MAX_KEY_VALUES = 8_000_000      # numbers in all channels
MAX_CLIP_SECONDS = 1e6
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclass(frozen=True)
class _Channel:
    path: Path
    node: int
    times: NDArray[np.float32]
    values: NDArray[np.float32]     # (k, 1 or 3, w)
    interpolation: Interpolation


def skin(document: Any, index: Any, buffers: Buffers, part: str) -> tuple[Indices, Array]:
    """The (j,) nodes that are a skin's joints and their (j, 4, 4) inverse bind matrices."""
    found = item(document.skins, index, "skin", part)
    where = f"skin {index}"
    joints = found.joints or []
    for joint in joints:
        item(document.nodes, joint, "node", f"{where} joints")
    if found.inverseBindMatrices is None:
        return np.array(joints, dtype=np.int64), np.tile(np.eye(4), (len(joints), 1, 1))
    values = buffers.accessor(found.inverseBindMatrices, f"{where} inverseBindMatrices", ("MAT4",))
    if len(values) < len(joints) or not (np.abs(values) <= MAX_COORDINATE).all():
        raise GltfError(f"{where}: has {len(values)} inverse bind matrices for {len(joints)} joints, expected as many, of finite "
                        f"numbers")
    binds = values[:len(joints)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1).copy()
    binds[:, 3] = (0, 0, 0, 1)
    return np.array(joints, dtype=np.int64), binds


class Animations:
    """Reads the clips of one document. `morphs` is the number of morph targets of each node that has any."""

    def __init__(self, document: Any, buffers: Buffers, morphs: dict[int, int]) -> None:
        self._document, self._buffers, self._morphs = document, buffers, morphs
        self._values = self._channels = 0

    def clips(self) -> tuple[Clip, ...]:
        clips: dict[str, Clip] = {}
        for index, animation in enumerate(self._document.animations or []):
            name = printable(animation.name) if isinstance(animation.name, str) else ""
            name = name if name and name not in clips else str(index)
            while name in clips:
                name += "'"
            clips[name] = self._clip(name, animation, f"animation {index}")
        return tuple(clips.values())

    def _clip(self, name: str, animation: Any, part: str) -> Clip:
        channels: dict[tuple[int, str], _Channel] = {}
        for number, channel in enumerate(animation.channels or []):
            read = self._channel(animation, channel, f"{part} channel {number}")
            if read is not None:
                if (read.node, read.path) in channels:
                    raise GltfError(f"{part} channel {number}: {read.path} of node {read.node} has a channel already")
                channels[read.node, read.path] = read
        tracks = _tracks(list(channels.values()))
        return Clip(name, max((float(track.times[-1]) for track in tracks), default=0.0), tracks)

    def _channel(self, animation: Any, channel: Any, part: str) -> _Channel | None:
        self._channels += 1
        if self._channels > MAX_CHANNELS:
            raise GltfError(f"{part}: is one of more than {MAX_CHANNELS} channels in the model")
        target = channel.target
        if target.node is None or target.path == "pointer":     # glTF: left to extensions
            return None
        node = item(self._document.nodes, target.node, "node", part)
        width = self._morphs.get(target.node, 0) if target.path == "weights" else _WIDTHS.get(str(target.path))
        if width is None:
            raise GltfError(f"{part}: path is {shown(target.path)}, expected translation, rotation, scale or weights")
        if width == 0:
            return None
        if node.matrix and target.path != "weights":
            raise GltfError(f"{part}: node {target.node} has a matrix, expected translation, rotation and scale where animated")
        sampler = item(animation.samplers, channel.sampler, "sampler", part)
        kind = "LINEAR" if sampler.interpolation is None else sampler.interpolation
        if kind not in _INTERPOLATIONS:
            raise GltfError(f"{part}: interpolation is {shown(kind)}, expected {', '.join(_INTERPOLATIONS)}")
        times = self._times(sampler.input, f"{part} input")
        values = self._keys(sampler.output, len(times), 3 if kind == "CUBICSPLINE" else 1, width, f"{part} output")
        return _Channel(cast(Path, target.path), target.node, times, values, cast(Interpolation, kind))

    def _times(self, index: Any, part: str) -> NDArray[np.float32]:
        times = self._buffers.accessor(index, part, ("SCALAR",)).ravel().astype(np.float32)
        good = (times >= 0) & (times <= MAX_CLIP_SECONDS)
        good[1:] &= times[1:] > times[:-1]
        if not good.all():
            wrong = int(good.argmin())
            raise GltfError(f"{part}: time {wrong} is {times[wrong]:g} s, expected finite times from 0 to {MAX_CLIP_SECONDS:g} s "
                            f"that increase")
        return times

    def _keys(self, index: Any, keys: int, each: int, width: int, part: str) -> NDArray[np.float32]:
        values = self._buffers.accessor(index, part, ("SCALAR", "VEC3", "VEC4"))
        self._values += values.size
        if self._values > MAX_KEY_VALUES:
            raise GltfError(f"{part}: has {values.size} numbers, with them all channels have {self._values}, expected at most "
                            f"{MAX_KEY_VALUES}")
        if values.size != keys * each * width:
            raise GltfError(f"{part}: has {values.size} numbers, expected {each} x {width} for each of {keys} times")
        if values.dtype.kind != "f" or not (np.abs(values) <= MAX_COORDINATE).all():
            raise GltfError(f"{part}: has values that are not finite floats")
        return values.astype(np.float32).reshape(keys, each, width)


def _tracks(channels: list[_Channel]) -> tuple[Track, ...]:
    """Channels that have the same times are evaluated at once."""
    groups: dict[tuple[Any, ...], list[_Channel]] = {}
    for channel in channels:
        key = (channel.path, channel.interpolation, channel.times.tobytes(), channel.values.shape)
        groups.setdefault(key, []).append(channel)
    return tuple(Track(group[0].path, np.array([channel.node for channel in group]), group[0].times,
                       np.stack([channel.values for channel in group], axis=2), group[0].interpolation)
                 for group in groups.values())
