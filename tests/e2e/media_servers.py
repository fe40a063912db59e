"""Media servers of other people: nginx-rtmp, and gst-rtsp-server under Debian's Python."""

from __future__ import annotations

import sys
from pathlib import Path

import av
from processes import Process, accepts_connections, free_port, wait_for

NGINX_CONFIG = """
load_module /usr/lib/nginx/modules/ngx_rtmp_module.so;
user root;
daemon off;
master_process off;
pid {folder}/nginx.pid;
error_log {folder}/error.log info;
events {{ worker_connections 64; }}
rtmp {{
  access_log off;
  server {{
    listen 127.0.0.1:{port};
    chunk_size 4096;
    application live {{ live on; }}
  }}
}}
"""


class NginxRtmp:
    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self._folder = folder
        (folder / "nginx.conf").write_text(NGINX_CONFIG.format(folder=folder, port=self.port))
        self.start()

    def start(self) -> None:
        """Also again, after it was killed."""
        self.process = Process(["nginx", "-p", self._folder, "-c", self._folder / "nginx.conf", "-e", self._folder / "error.log"],
                               self._folder / "output.log")
        wait_for("nginx", lambda: accepts_connections(self.port), 10)

    def url(self, key: str) -> str:
        return f"rtmp://127.0.0.1:{self.port}/live/{key}"


class RtspServer:
    """Plays the H.264 of an MP4 or of a byte stream (.h264) for ever at `url`, in real time."""

    def __init__(self, clip: Path, folder: Path) -> None:
        self.port = free_port()
        byte_stream = clip
        if clip.suffix != ".h264":
            byte_stream = folder / f"{clip.stem}.h264"
            write_byte_stream(clip, byte_stream)
        self.process = _gst_rtsp_server("play", self.port, byte_stream, folder)

    @property
    def url(self) -> str:
        return f"rtsp://127.0.0.1:{self.port}/live"


class RtspRecorder:
    """Writes the H.264 that is published to `url` into `file`; with `sound`, H.264 and Opus, as Matroska."""

    def __init__(self, folder: Path, *, sound: bool = False) -> None:
        self.port = free_port()
        self.url = f"rtsp://127.0.0.1:{self.port}/live"
        self.file = folder / ("recorded.mkv" if sound else "recorded.h264")
        self._mode, self._folder = "record-sound" if sound else "record", folder
        self.start()

    def start(self) -> None:
        """Also again, after it was killed; the file begins anew."""
        self.process = _gst_rtsp_server(self._mode, self.port, self.file, self._folder)


def _gst_rtsp_server(mode: str, port: int, file: Path, folder: Path) -> Process:
    script = Path(__file__).with_name("rtsp_server.py")
    process = Process(["/usr/bin/python3", script, mode, str(port), file], folder / f"rtsp-{port}.log", {"PYTHONPATH": ""})
    wait_for("RTSP server", lambda: accepts_connections(port), 10)
    return process


class Publisher:
    """`mr360 publish` as a child."""

    def __init__(self, file: Path, url: str, log: Path, loop: bool = True) -> None:
        command = [sys.executable, "-m", "server.cli", "publish", file, url]
        self.process = Process([*command, "--loop"] if loop else command, log)


def write_byte_stream(clip: Path, target: Path) -> None:
    """Copy a file's H.264 into an Annex-B byte stream."""
    with av.open(str(clip)) as source, av.open(str(target), "w", format="h264") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                output.mux(packet)
