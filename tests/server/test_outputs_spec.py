"""Which outputs are accepted, and how their secrets stay out of sight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from encoded_stream import EncodedStream
from pydantic import ValidationError

from server.config import ConfigError, load_settings
from server.outputs.output import Output
from server.outputs.spec import OutputSpec, PlaybackEntry, masked_output_url


@pytest.mark.parametrize(("given", "kind", "url"), [
    ({"url": "rtmp://h/live/key"}, "rtmp", "rtmp://h/live/key"),
    ({"url": "RTMPS://h:443/app/key?a=b"}, "rtmp", "rtmps://h:443/app/key?a=b"),
    ({"url": "rtsp://u:p@h/x"}, "rtsp", "rtsp://u:p@h/x"),
    ({"url": "whip+https://h/whip/live"}, "whip", "https://h/whip/live"),
    ({"url": "http://h/whip/live", "kind": "whip"}, "whip", "http://h/whip/live"),
    ({"kind": "record", "prefix": "show"}, "record", None),
])
def test_kinds(given: dict[str, Any], kind: str, url: str | None) -> None:
    spec = OutputSpec.model_validate({"id": "a", **given})
    assert (spec.kind, spec.url, spec.rendition, spec.enabled) == (kind, url, None, True)


@pytest.mark.parametrize(("given", "complaint"), [
    ({}, "Field required"),
    ({"url": "http://h/x"}, "url scheme is 'http', expected one of rtmp, rtmps, rtsp, rtsps, whip+http, whip+https"),
    ({"url": "file:///etc/passwd"}, "url scheme is 'file'"),
    ({"url": "rtmp://h/live/key", "kind": "whip"}, "url scheme is 'rtmp', expected http or https for kind whip"),
    ({"url": "rtmp://h/live"}, "url is incomplete, expected rtmp://HOST/APP/KEY"),
    ({"url": "rtmp:///live/key"}, "names no host"),
    ({"url": "rtmp://h:0/live/key"}, "port 0"),
    ({"url": "rtmp://h:99999/live/key"}, "url is no URL"),
    ({"url": "rtmp://h/live/a b"}, "blanks"),
    ({"url": "rtmp://h/live/***"}, "url is masked"),
    ({"url": "rtmp://h/live/" + "k" * 3000}, "characters, expected at most 2048"),
    ({"url": "nonsense"}, "url is no URL"),
    ({"url": 5}, "expected a URL as text"),
    ({"kind": "whip"}, "url is missing"),
    ({"kind": "record"}, "a recording has no url but a prefix"),
    ({"kind": "record", "prefix": "../up"}, "String should match pattern"),
    ({"kind": "record", "prefix": "a/b"}, "String should match pattern"),
    ({"kind": "record", "prefix": ".hidden"}, "String should match pattern"),
    ({"kind": "record", "prefix": "a", "url": "rtsp://h/x"}, "a recording has no url"),
    ({"url": "rtsp://h/x", "prefix": "a"}, "prefix is for kind record"),
    ({"url": "rtsp://h/x", "token": "t"}, "token is for kind whip"),
    ({"url": "whip+http://user:word@h/x"}, "expected a token beside it"),
    ({"url": "whip+http://h/x", "token": "a\r\nb"}, "expected a bearer token"),
    ({"url": "rtsp://h/x", "tokn": "t"}, "Extra inputs"),
    ({"url": "rtsp://h/x", "id": "a/b"}, "String should match pattern"),
    ({"url": "rtsp://h/x", "playback": [{"protocol": "whep", "url": "javascript://x/alert(1)"}]}, "playback url scheme"),
    ({"url": "rtsp://h/x", "playback": [{"protocol": "whep", "url": "rtsp://h/x"}]}, "expected http or https for whep"),
    ({"url": "rtsp://h/x", "playback": [{"protocol": "hls", "url": "https://u:p@h/x"}]}, "has credentials"),
    ({"url": "rtsp://h/x", "playback": [{"protocol": "hls", "url": "https://h/x"}] * 9}, "at most 8"),
])
def test_refusals(given: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError) as error:
        OutputSpec.model_validate({"id": "a", **given})
    assert complaint in str(error.value)


@pytest.mark.parametrize(("url", "shown"), [
    ("rtmp://h/live/key", "rtmp://h/live/***"),
    ("rtmps://u:p@h:443/app/inst/key?token=x", "rtmps://***@h:443/app/inst/***"),
    ("rtsp://u:p@h/x?token=abc&y=1", "rtsp://***@h/x?token=***&y=***"),
    ("rtsp://h/x;jwt=abc/track?abc", "rtsp://h/x;***/track?***"),
    ("https://h/whip?sid=abc&e=1#abc", "https://h/whip?sid=***&e=***#***"),
    ("rtmp://h/live/key/", "rtmp://h/live/***"),
    ("rtmp://h//live//key//?x=y#z", "rtmp://h/live/***"),
    ("https://h/whip/live", "https://h/whip/live"),
    ("https://customer.example/0123456789abcdef0123456789abcdef/webRTC/publish", "https://customer.example/***/webRTC/publish"),
])
def test_urls_are_shown_without_secrets(url: str, shown: str) -> None:
    assert masked_output_url(url) == shown


def test_texts_are_shown_without_secrets() -> None:
    rtmp = OutputSpec(id="a", kind="rtmp", url="rtmp://user:word@h/live/sekret?sig=hidden")
    text = rtmp.conceal("cannot open rtmp://user:word@h/live/sekret?sig=hidden (publish sekret with hidden, word)")
    assert not any(secret in text for secret in ("sekret", "hidden", "word@"))
    whip = OutputSpec(id="a", kind="whip", url="https://h/0123456789abcdef0123456789abcdef", token="tok.en")
    assert "0123456789" not in whip.conceal("404 for /0123456789abcdef0123456789abcdef with tok.en")
    assert "tok.en" not in whip.conceal("404 for /x with tok.en")


@pytest.mark.parametrize(("url", "secrets"), [
    ("rtmp://us%21er:wo%40rd@h/live/key%2Bone/", ["us%21er", "us!er", "wo%40rd", "wo@rd", "key%2Bone", "key+one"]),
    ("rtsp://Us%21er:wo%40rd@h/x", ["Us%21er", "Us!er", "wo%40rd", "wo@rd"]),
    ("rtsp://h/x;jwt=Xy%3Dz?sid=ab+cd%3D&bare%2Fone", ["Xy%3Dz", "Xy=z", "ab+cd%3D", "ab cd=", "bare%2Fone", "bare/one"]),
    ("whip+https://h/whip?k=ab%2Bcd#frag%21", ["ab%2Bcd", "ab+cd", "frag%21", "frag!"]),
    ("whip+https://h/0123456789%2Babcdef012345", ["0123456789%2Babcdef012345", "0123456789+abcdef012345"]),
])
def test_secrets_are_concealed_as_written_decoded_and_in_lower_case(url: str, secrets: list[str]) -> None:
    spec = OutputSpec.model_validate({"id": "a", "url": url})
    assert spec.shown_url is not None
    for secret in secrets:
        assert spec.conceal(f"cannot open <{secret}>") == spec.conceal(f"cannot open <{secret.lower()}>") == "cannot open <***>"
        assert secret not in spec.shown_url


@pytest.mark.parametrize("given", [
    {"url": "rtmp://s3cr3t:s3cr3t@h/live/s3cr3t/?a=s3cr3t#s3cr3t"},
    {"url": "rtsp://s3cr3t:s3cr3t@h/x;a=s3cr3t?a=s3cr3t&s3cr3t#s3cr3t"},
    {"url": "whip+https://h/s3cr3ts3cr3ts3cr3ts3cr3t?a=s3cr3t", "token": "s3cr3t"},
])
async def test_what_everybody_with_the_right_to_view_sees_has_no_secret(given: dict[str, Any]) -> None:
    output = Output(OutputSpec.model_validate({"id": "a", **given}), EncodedStream(), recordings_dir="/", networks=None,
                    changed=lambda: None)
    assert "s3cr3t" not in json.dumps(output.description())


def test_playback_entries_of_any_protocol() -> None:
    assert PlaybackEntry(protocol="srt", url="srt://h:9000?streamid=x").rendition is None


def test_outputs_in_the_settings(tmp_path: Path) -> None:
    file = tmp_path / "mr360.toml"
    file.write_text('''
recordings_dir = "/recordings"
[[outputs]]
id = "sfu"
url = "whip+https://sfu.example/whip/live"
token = "abc"
playback = [{protocol = "whep", url = "https://sfu.example/whep/live"}]
[[outputs]]
id = "rec"
stream = "second"
kind = "record"
prefix = "show"
[[playback]]
protocol = "hls"
url = "https://cdn.example/live.m3u8"
''')
    settings = load_settings({}, file, {})
    assert [(output.stream, output.id, output.spec.kind) for output in settings.outputs] == [
        ("live", "sfu", "whip"), ("second", "rec", "record")]
    assert settings.outputs[0].spec.token == "abc"
    assert settings.recordings_dir == Path("/recordings")
    assert settings.playback[0].stream == "live"
    assert settings.max_outputs == 8


SECRET = "s3cr3t-value"


@pytest.mark.parametrize(("outputs", "complaint"), [
    ([{"id": "a", "url": f"rtmp://h/live/{SECRET} x"}], "blanks"),
    ([{"id": "a", "url": "whip+http://h/x", "token": f"{SECRET} "}], "expected a bearer token"),
    ([{"id": "a", "url": "whip+http://h/x", "tokn": SECRET}], "outputs.0.tokn"),
    ([{"url": f"rtmp://h/live/{SECRET}"}], "outputs.0.id"),
    ([{"id": "a", "url": f"rtmp://h/live/{SECRET}", "enabled": "perhaps"}], "outputs.0.enabled"),
    ([{"id": "a", "url": f"rtmp://h/live/{SECRET}"}] * 2, "has 2 with the id 'a'"),
    ([{"id": str(number), "url": f"rtmp://h/live/{SECRET}"} for number in range(9)], "expected at most max_outputs, 8"),
    (SECRET, "outputs (config)"),
])
def test_bad_outputs_in_the_settings_are_told_without_secrets(outputs: Any, complaint: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_settings({"outputs": outputs}, environment={})
    assert complaint.replace("config", "command line") in str(error.value)
    assert SECRET not in str(error.value)
    assert "\n" not in str(error.value)


def test_renditions_of_configured_outputs_are_of_the_ladder_of_the_settings() -> None:
    settings = {"renditions": [{"name": "uhd", "scale": 1.0}, {"name": "hd", "scale": 0.5}]}
    output = {"id": "rec", "kind": "record", "prefix": "p"}
    loaded = load_settings({**settings, "outputs": [output, {**output, "id": "small", "rendition": "hd"}]}, environment={})
    assert [one.spec.rendition for one in loaded.outputs] == [None, "hd"]
    with pytest.raises(ConfigError) as error:
        load_settings({**settings, "outputs": [{**output, "rendition": "full"}]}, environment={})
    assert "outputs has 'rec', whose rendition is 'full', expected one of uhd, hd" in str(error.value)


def test_outputs_in_the_environment_are_json() -> None:
    with pytest.raises(ConfigError) as error:
        load_settings({}, environment={"MR360_OUTPUTS": f"[{SECRET}"})
    assert SECRET not in str(error.value)
    settings = load_settings({}, environment={"MR360_OUTPUTS": '[{"id": "a", "kind": "record", "prefix": "p"}]'})
    assert settings.outputs[0].spec.prefix == "p"
