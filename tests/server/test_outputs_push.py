"""Pushes by FFmpeg's muxers to servers that are not there or do not answer."""

from __future__ import annotations

import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from encoded_stream import EncodedStream
from test_outputs_recording import pid, until

from server.outputs import process as process_module
from server.outputs.output import Output
from server.outputs.spec import OutputSpec


@asynccontextmanager
async def pushing(stream: EncodedStream, url: str, networks: tuple[str, ...] | None = None) -> AsyncIterator[Output]:
    output = Output(OutputSpec.model_validate({"id": "push", "url": url}), stream, recordings_dir="/", networks=networks,
                    changed=lambda: None)
    output.source_changed("live", None, stream.input)
    output.start()
    try:
        yield output
    finally:
        await output.stop()


@pytest.mark.parametrize("url", ["rtmp://127.0.0.1:9/live/s3cr3t", "rtsp://user:s3cr3t@127.0.0.1:9/live"])
async def test_nobody_there(url: str) -> None:
    async with EncodedStream() as stream, pushing(stream, url) as output:
        await until(lambda: output.state == "retrying")
        assert "refused" in str(output.detail)
        assert "s3cr3t" not in str(output.description())
        await until(lambda: output.restarts >= 1)


@pytest.mark.parametrize("scheme", ["rtmp", "rtsp"])
async def test_a_server_that_takes_the_connection_and_says_nothing(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg waits for it with the interpreter in its hands; only an end from outside helps."""
    monkeypatch.setattr(process_module, "SILENCE_LIMIT_S", 1.5)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        url = f"{scheme}://127.0.0.1:{mute.getsockname()[1]}/live/key"
        async with EncodedStream() as stream, pushing(stream, url) as output:
            await until(lambda: output._process is not None)
            hung = pid(output)
            await until(lambda: output.state == "retrying")
            assert str(output.detail).startswith("no answer within")
            with pytest.raises(ProcessLookupError):
                os.kill(hung, 0)
            assert not len(stream.tracks.fanout("full/h264")), "nothing is encoded between two tries"


@pytest.mark.parametrize("scheme", ["rtmp", "rtsp"])
async def test_a_name_that_leads_into_the_own_network_by_now_is_not_connected_to(scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as inside:
        inside.settimeout(0.5)
        url = f"{scheme}://localhost:{inside.getsockname()[1]}/live/key"
        async with EncodedStream() as stream, pushing(stream, url, networks=("10.0.0.0/8",)) as output:
            await until(lambda: output.state not in ("connecting", "live"))
            assert output.state == "failed-config"
            assert "'localhost' has the address" in str(output.detail)
            assert "source_networks" in str(output.detail)
            with pytest.raises(TimeoutError):
                inside.accept()
            assert output.restarts == 0


async def test_a_name_that_is_unknown_is_asked_for_again_soon() -> None:
    async with EncodedStream() as stream, pushing(stream, "rtsp://nobody.invalid/live", networks=()) as output:
        await until(lambda: output.state == "retrying")
        assert "'nobody.invalid' does not resolve" in str(output.detail)
        await until(lambda: output.restarts >= 1)
