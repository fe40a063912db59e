"""A real worker process on a real picture: how many frames an edit takes to be seen."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from server.worker.messages import encode_message, receive_message

WIDTH, HEIGHT = 512, 256
LIMIT_S = 60.0
SCENE = {"objects": [{"id": "box", "mesh": "box", "position": [0, -0.6, -2], "scale": [2, 2, 2],
                      "material": {"base_color": [0.9, 0.05, 0.05], "metallic": 0, "roughness": 0.8}}]}


class RealWorker:
    """`python -m server.worker` with one viewer, on a still picture that is shown 30 times a second."""

    def __init__(self, picture: Path) -> None:
        self._socket, theirs = socket.socketpair()
        self._socket.settimeout(LIMIT_S)
        self._process = subprocess.Popen([sys.executable, "-m", "server.worker", "--fd", str(theirs.fileno())],
                                         pass_fds=[theirs.fileno()])
        theirs.close()
        self.send({"type": "start", "stream": "live", "source": str(picture), "allow_files": True, "scene": {}, "revision": 0})
        self.send({"type": "demand", "tracks": ["full/h264"], "lights": 0})
        self._decoder = av.CodecContext.create("h264", "r")

    def send(self, message: dict[str, Any]) -> None:
        self._socket.sendall(encode_message(message))

    def pictures(self) -> Iterator[tuple[int, np.ndarray[Any, np.dtype[np.uint8]]]]:
        """Frame numbers and (height, width, 3) pictures as they come."""
        while True:
            message, payload = receive_message(self._socket)
            if message["type"] == "packet":
                for frame in self._decoder.decode(av.Packet(payload)):
                    yield int(message["frame"]), frame.to_ndarray(format="rgb24")

    def light_methods(self) -> Iterator[str]:
        """The method of each light message as it comes."""
        while True:
            message, _ = receive_message(self._socket)
            if message["type"] == "lights":
                yield str(message["message"]["method"])

    def stop(self) -> None:
        self.send({"type": "stop"})
        assert self._process.wait(LIMIT_S) == 0
        self._socket.close()


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[RealWorker]:
    picture = tmp_path / "grey.png"
    Image.new("RGB", (WIDTH, HEIGHT), (120, 120, 120)).save(picture)
    running = RealWorker(picture)
    yield running
    running.stop()


def test_an_edit_is_in_the_picture_within_three_frames(worker: RealWorker) -> None:
    """Placed, repainted and moved: counted from the newest frame that had been received when the edit was sent."""
    pictures = worker.pictures()
    centre, beside = (HEIGHT * 5 // 8, WIDTH // 2), (HEIGHT * 5 // 8, WIDTH * 3 // 4)
    placed, painted, moved = SCENE, {"objects": [{**SCENE["objects"][0]}]}, {"objects": [{**SCENE["objects"][0]}]}
    painted["objects"][0]["material"] = {"base_color": [0.05, 0.05, 0.9], "metallic": 0, "roughness": 0.8}
    moved["objects"][0]["position"] = [2, -0.6, 0]
    edits = [(placed, centre, 0), (painted, centre, 2), (moved, beside, 0)]
    for _ in range(10):
        newest, picture = next(pictures)
    for revision, (scene, where, channel) in enumerate(edits, start=1):
        assert not _dominates(picture[where], channel)
        worker.send({"type": "scene", "scene": scene, "revision": revision})
        seen_in, picture = next((number, picture) for number, picture in pictures if _dominates(picture[where], channel))
        assert seen_in - newest <= 3, f"edit {revision}: the first frame after {newest} that shows it is {seen_in}"
        for _ in range(5):
            newest, picture = next(pictures)


def test_the_scene_chooses_the_methods_while_it_runs(worker: RealWorker) -> None:
    methods = worker.light_methods()
    assert next(methods) == "default"
    for revision, method in enumerate(("threshold", "probe", "default"), start=1):
        lighting = {"lights": method, "diffuse": "map32x16", "glossy": "rings36"}
        worker.send({"type": "scene", "scene": {**SCENE, "lighting": lighting}, "revision": revision})
        assert method in (found for found, _ in zip(methods, range(30), strict=False))


def _dominates(color: np.ndarray[Any, np.dtype[np.uint8]], channel: int) -> bool:
    """Whether the pixel is mainly of that colour."""
    rest = np.delete(color.astype(int), channel)
    return bool(color[channel] > 1.3 * rest.max() + 10)
