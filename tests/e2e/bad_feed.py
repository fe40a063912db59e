"""A publisher of streams that no sane camera sends, in real time until it is interrupted.

usage: bad_feed.py KIND URL     KIND: audio_only, undecodable, not_2_to_1, odd_size
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from fractions import Fraction

import av
import numpy as np
from av.container import OutputContainer

FPS = 15
SAMPLE_RATE, AUDIO_FRAME = 44100, 1024
START_CODE = b"\0\0\0\1"


def audio_only(output: OutputContainer) -> Iterator[av.Packet]:
    stream = output.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
    for index in itertools.count():
        frame = av.AudioFrame.from_ndarray(np.zeros((1, AUDIO_FRAME), np.float32), "fltp", "mono")
        frame.sample_rate, frame.pts, frame.time_base = SAMPLE_RATE, index * AUDIO_FRAME, Fraction(1, SAMPLE_RATE)
        yield from stream.encode(frame)


def video(output: OutputContainer, width: int, height: int, pix_fmt: str = "yuv420p") -> Iterator[av.Packet]:
    stream = output.add_stream("libx264", rate=FPS, options={"tune": "zerolatency", "g": str(FPS)})
    stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
    rows = np.linspace(40, 200, height).astype(np.uint8)
    picture = np.broadcast_to(rows[:, None, None], (height, width, 3)).copy()
    for index in itertools.count():
        frame = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(format=pix_fmt)
        frame.pts, frame.time_base = index, Fraction(1, FPS)
        yield from stream.encode(frame)


def undecodable(output: OutputContainer) -> Iterator[av.Packet]:
    """Sound containers, time stamps and NAL unit headers around slices that begin past the end of the picture."""
    for packet in video(output, 128, 64):
        units = bytes(packet).replace(START_CODE[1:], START_CODE).split(START_CODE)
        damaged = b"".join(START_CODE + unit[:1] + b"\1" * max(len(unit) - 1, 200) for unit in units
                           if unit.strip(b"\0") and unit[0] & 31 in (1, 5))
        bad = av.Packet(damaged)
        bad.pts, bad.dts, bad.time_base, bad.stream = packet.pts, packet.dts, packet.time_base, packet.stream
        bad.is_keyframe = packet.is_keyframe
        yield bad


KINDS = {
    "audio_only": audio_only,
    "undecodable": undecodable,
    "not_2_to_1": lambda output: video(output, 480, 320),
    "odd_size": lambda output: video(output, 643, 321, "yuv444p"),
}


def main() -> int:
    with av.open(sys.argv[2], "w", format="flv", options={"flush_packets": "1"}) as output:
        packets = KINDS[sys.argv[1]](output)
        started = time.monotonic()
        for packet in packets:
            time.sleep(max(0.0, started + float(packet.dts * packet.time_base) - time.monotonic()))
            output.mux(packet)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(0)
