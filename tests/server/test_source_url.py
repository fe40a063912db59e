from __future__ import annotations

import ipaddress
from pathlib import Path

import pytest

from server.source_url import (
    SourceUrlError,
    check_command_line_source,
    check_network_source,
    check_source_network,
    is_file_source,
    masked,
)


@pytest.mark.parametrize("source", [
    "rtsp://camera.example/stream1",
    "rtsps://user:pass@10.0.0.5:8322/live?channel=1",
    "rtmp://127.0.0.1:1935/app/key",
    "rtmps://media.example/app/key",
    "rtmp-listen://0.0.0.0:1935/live/secret",
    "rtsp://[::1]:8554/x",
])
def test_network_sources_are_accepted_unchanged(source: str) -> None:
    assert check_network_source(source) == source


@pytest.mark.parametrize(("source", "complaint"), [
    ("http://camera/stream", "source scheme of 'http://camera/stream' is 'http', expected one of rtsp, rtsps, rtmp"),
    ("file:///etc/passwd", "is 'file', expected one of"),
    ("concat:a|b", "is 'concat', expected one of"),
    ("/etc/passwd", "is '', expected one of"),
    ("", "is '', expected one of"),
    ("rtsp:///path", "names no host, expected rtsp://HOST/PATH"),
    ("rtsp://host:99999/x", "is no URL: port out of range"),
    ("rtsp://host:0/x", "has port 0, expected 1 to 65535"),
    ("rtsp://host:abc/x", "is no URL: port could not be cast"),
    ("rtsp://[::1/x", "is no URL"),
    ("rtsp://ho st/x", "has blanks or unprintable characters"),
    ("rtsp://host/x\n-i /etc/passwd", "has blanks or unprintable characters"),
    ("rtsp://hö.example/x", "has blanks or unprintable characters"),
    ("rtmp-listen://127.0.0.1/app/key", "is incomplete, expected rtmp-listen://HOST:PORT/APP/KEY"),
    ("rtmp-listen://127.0.0.1:1935/app", "is incomplete"),
    ("rtsp://host/" + "a" * 3000, "has 3012 characters, expected at most 2048"),
])
def test_other_sources_are_refused_with_the_reason(source: str, complaint: str) -> None:
    with pytest.raises(SourceUrlError, match="source ") as error:
        check_network_source(source)
    assert complaint in str(error.value)


def test_refusal_does_not_show_the_password() -> None:
    with pytest.raises(SourceUrlError) as error:
        check_network_source("http://admin:hunter2@camera/x")
    assert "hunter2" not in str(error.value)


def test_command_line_takes_files_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = tmp_path / "clip.mp4"
    odd = tmp_path / "50% #1?.png"
    odd.write_bytes(b"x")
    clip.write_bytes(b"x")
    monkeypatch.chdir(tmp_path)
    assert check_command_line_source("clip.mp4") == f"file://{clip}"
    assert check_command_line_source(f"file://{clip}") == f"file://{clip}"
    assert check_command_line_source(str(odd)) == check_command_line_source(odd.as_uri()) == odd.as_uri()
    assert is_file_source(f"file://{clip}")
    assert not is_file_source("rtsp://host/x")
    assert not is_file_source(None)
    with pytest.raises(SourceUrlError, match=r"source 'missing\.mp4' does not exist"):
        check_command_line_source("missing.mp4")


@pytest.mark.parametrize(("text", "shown"), [
    ("rtsp://user:pass@host/x", "rtsp://***@host/x"),
    ("rtsp://user@host/x", "rtsp://***@host/x"),
    ("rtsp://a:b@c@host/x", "rtsp://***@host/x"),
    ("rtsp://host/x?channel=1&password=abc&subtype=0", "rtsp://host/x?channel=1&password=***&subtype=0"),
    ("rtmp://host/app/k?Token=abc", "rtmp://host/app/k?Token=***"),
    ("rtsp://host/x", "rtsp://host/x"),
    ("cannot open rtsp://u:p@host/x: refused", "cannot open rtsp://***@host/x: refused"),
    ("", ""),
])
def test_masked(text: str, shown: str) -> None:
    assert masked(text) == shown


@pytest.mark.parametrize("source", [
    "rtsp://127.0.0.1/x", "rtsp://localhost/x", "rtsp://10.1.2.3/x", "rtsp://169.254.169.254/x", "rtsp://[::1]/x",
    "rtsp://[fd00::1]/x", "rtsp://[::ffff:127.0.0.1]/x", "rtsp://0.0.0.0/x", "rtsp://2130706433/x", "rtsp://224.0.0.1/x",
    "rtmp-listen://0.0.0.0:1935/app/key",
])
async def test_addresses_that_are_not_public_are_refused(source: str) -> None:
    with pytest.raises(SourceUrlError, match="expected a public one or one in the setting source_networks"):
        await check_source_network(source, [])


async def test_public_and_allowed_addresses_pass() -> None:
    await check_source_network("rtsp://8.8.8.8/x", [])
    await check_source_network("rtsp://10.1.2.3/x", [ipaddress.ip_network("10.0.0.0/8")])
    both = [ipaddress.ip_network("10.0.0.0/8"), ipaddress.ip_network("fd00::/8")]
    await check_source_network("rtsp://[fd00::1]/x", both)


async def test_unknown_host_is_refused() -> None:
    with pytest.raises(SourceUrlError, match="does not resolve"):
        await check_source_network("rtsp://no-such-host.invalid/x", [])
