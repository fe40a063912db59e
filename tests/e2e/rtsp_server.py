"""A real RTSP server (gst-rtsp-server) at rtsp://127.0.0.1:PORT/live. Runs under Debian's /usr/bin/python3.

usage: rtsp_server.py play PORT FILE      plays an H.264 byte stream for ever
       rtsp_server.py record PORT FILE    writes the H.264 that is published to it
       rtsp_server.py record-sound PORT FILE    writes the H.264 and Opus that are published to it, as Matroska
Prints one line when it listens.
"""

import signal
import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtsp", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtsp, GstRtspServer  # noqa: E402


def give_presentation_times(factory, media):
    """A bare byte stream has decoding times only; without B-frames they are the same."""
    def stamp(pad, info):
        buffer = info.get_buffer()
        buffer.pts = buffer.dts
        return Gst.PadProbeReturn.OK

    payloader = media.get_element().get_by_name("pay0")
    payloader.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, stamp)


def main() -> int:
    mode, port, path = sys.argv[1:]
    Gst.init(None)
    factory = GstRtspServer.RTSPMediaFactory()
    if mode == "play":
        factory.set_launch(f"( multifilesrc location=\"{path}\" loop=true ! h264parse config-interval=-1 "
                           "! rtph264pay name=pay0 pt=96 )")
        factory.connect("media-configure", give_presentation_times)
    else:
        file = f"filesink buffer-mode=2 location=\"{path}\""
        factory.set_transport_mode(GstRtspServer.RTSPTransportMode.RECORD)
        factory.set_launch(
            f"( rtph264depay name=depay0 ! h264parse config-interval=-1 ! video/x-h264,stream-format=byte-stream ! {file} )"
            if mode == "record" else
            f"( rtph264depay name=depay0 ! h264parse ! queue ! matroskamux name=mux streamable=true ! {file} "
            "rtpopusdepay name=depay1 ! opusparse ! queue ! mux. )")
    factory.set_protocols(GstRtsp.RTSPLowerTrans.TCP)
    factory.set_shared(True)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    server.get_mount_points().add_factory("/live", factory)
    if not server.attach(None):
        print(f"cannot listen on port {port}", file=sys.stderr)
        return 2
    loop = GLib.MainLoop()
    for number in (signal.SIGINT, signal.SIGTERM):
        GLib.unix_signal_add(GLib.PRIORITY_DEFAULT, number, loop.quit)
    print("listening", flush=True)
    loop.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
