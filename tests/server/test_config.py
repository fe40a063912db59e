from __future__ import annotations

from ipaddress import ip_network
from pathlib import Path

import pytest
from pydantic import ValidationError

from server.config import ConfigError, Settings, load_settings


def test_defaults() -> None:
    settings = load_settings({}, environment={})
    assert (settings.host, settings.port, settings.source) == ("127.0.0.1", 8360, None)
    assert settings.assets_dir.is_absolute()


def test_command_line_over_environment_over_file_over_default(tmp_path: Path) -> None:
    file = tmp_path / "mr360.toml"
    file.write_text('port = 1111\nhost = "::1"\nmax_viewers = 3\n')
    environment = {"MR360_PORT": "2222", "MR360_HOST": "127.0.0.2", "OTHER": "x"}
    settings = load_settings({"port": "3333"}, file, environment)
    assert (settings.port, settings.host, settings.max_viewers, settings.max_streams) == (3333, "127.0.0.2", 3, 4)


def test_settings_are_frozen() -> None:
    with pytest.raises(ValidationError):
        Settings().port = 1     # type: ignore[misc]


def test_lists_from_the_environment() -> None:
    settings = load_settings({}, environment={
        "MR360_ALLOWED_ORIGINS": "https://a.example, https://b.example:8443",
        "MR360_SOURCE_NETWORKS": "10.0.0.0/8,fd00::/8",
        "MR360_ICE_SERVERS": '[{"url": "turn:turn.example:3478", "username": "u", "credential": "c"}]'})
    assert settings.allowed_origins == ("https://a.example", "https://b.example:8443")
    assert settings.allowed_source_networks == (ip_network("10.0.0.0/8"), ip_network("fd00::/8"))
    assert settings.ice_servers[0].username == "u"


@pytest.mark.parametrize(("host", "networks"), [
    ("127.0.0.1", None), ("localhost", None), ("::1", None), ("0.0.0.0", ())])
def test_private_sources_by_default_only_when_the_service_is_private(host: str, networks: tuple[()] | None) -> None:
    assert Settings(host=host).allowed_source_networks == networks


@pytest.mark.parametrize(("given", "environment", "complaint"), [
    ({"port": "abc"}, {}, "port is 'abc' (command line), expected a valid integer"),
    ({"port": "70000"}, {}, "port is '70000' (command line), expected less than or equal to 65535"),
    ({}, {"MR360_MAX_VIEWERS": "0"}, "max_viewers is '0' (environment), expected greater than or equal to 1"),
    ({}, {"MR360_PROT": "1"}, "setting 'prot' (environment) is unknown, expected one of host, port"),
    ({"source": "http://x/y"}, {}, "source scheme of 'http://x/y' is 'http', expected one of rtsp"),
    ({"source": "/no/such/file"}, {}, "source '/no/such/file' does not exist"),
    ({}, {"MR360_ALLOWED_ORIGINS": "example.com"}, "origin is 'example.com', expected https://HOST"),
    ({}, {"MR360_SOURCE_NETWORKS": "10.0.0.1/8"}, "source_networks.0"),
    ({}, {"MR360_ICE_SERVERS": "turn:x"}, "MR360_ICE_SERVERS is 'turn:x', expected a JSON list"),
    ({}, {"MR360_REQUIRE_GPU": "perhaps"}, "require_gpu is 'perhaps' (environment)"),
])
def test_messages_name_value_and_expectation(given: dict[str, str], environment: dict[str, str],
                                             complaint: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_settings(given, environment=environment)
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("text", "complaint"), [
    ("prot = 1", "is unknown"), ("port = ", "is no TOML"), ("port = 1.5", "port is 1.5"), ("\udcff", "is no TOML"),
])
def test_bad_files(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "mr360.toml"
    file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=complaint):
        load_settings({}, file, {})


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: no such file or directory"):
        load_settings({}, tmp_path / "none.toml", {})


@pytest.mark.parametrize(("renditions", "complaint"), [
    ([{"name": "a", "scale": 0.5}, {"name": "b", "scale": 1.0}], "expected the largest first"),
    ([{"name": "a", "scale": 1.0}, {"name": "a", "scale": 0.5}], "expected different names"),
    ([], "at least 1"),
    ([{"name": "a", "scale": 2.0}], "renditions.0.scale is 2.0"),
])
def test_a_ladder_that_cannot_be_climbed_is_refused(renditions: list[dict[str, object]], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        load_settings({"renditions": renditions}, environment={})


def test_a_ladder_of_ones_own() -> None:
    settings = load_settings({}, environment={"MR360_RENDITIONS": '[{"name": "only", "scale": 1.0, "bitrate_bps": 8000000}]'})
    assert [(rung.name, rung.bitrate_bps) for rung in settings.renditions] == [("only", 8_000_000)]
