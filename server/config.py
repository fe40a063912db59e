"""Settings of the service: one frozen object; command line over environment over file over default."""

from __future__ import annotations

import ipaddress
import json
import os
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails

from server.auth import Token
from server.network_settings import OWN, EdgeUrl, IceServer, PortRange, Turn, comma_separated, resolved
from server.outputs.spec import ConfiguredOutput, ConfiguredPlayback
from server.renditions import LADDER, Rendition
from server.source_url import IpNetwork, SourceUrlError, check_command_line_source

ENVIRONMENT_PREFIX = "MR360_"
JSON_SETTINGS = {
    "ice_servers": "a JSON list of objects with url, username, credential",
    "turn": "a JSON object with urls, secret, ttl_s",
    "tokens": "a JSON list of objects with token, may, streams",
    "outputs": "a JSON list of objects with id, url, kind, …",
    "renditions": "a JSON list of objects with name, scale, bitrate_bps",
    "playback": "a JSON list of objects with protocol, url, …",
}
SECRET_SETTINGS = ("turn", "tokens", "outputs")     # their values are never shown, not even when they are wrong


class ConfigError(ValueError):
    """A setting is unknown or has a value that cannot be used."""


def _data_folder(name: str) -> Path:
    data_home = os.environ.get("XDG_DATA_HOME")
    return (Path(data_home) if data_home else Path.home() / ".local" / "share") / "mr360" / name


class Settings(BaseModel):
    """Every setting, in the order of the documentation."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: Annotated[str, Field(min_length=1, max_length=253)] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8360          # 0: any free port
    source: str | None = None                                   # of the stream `live`
    assets_dir: Path = Field(default_factory=lambda: _data_folder("assets"))
    max_viewers: Annotated[int, Field(ge=1, le=1000)] = 40      # of all streams together; two cores carry so many at 10 Mbps
    max_streams: Annotated[int, Field(ge=1, le=64)] = 4
    require_gpu: bool = False
    bitrate_bps: Annotated[int, Field(ge=100_000, le=200_000_000)] | None = None    # None: by geometry
    renditions: Annotated[tuple[Rendition, ...], Field(min_length=1, max_length=6)] = LADDER
    """The ladder that viewers move on, best first; each rung is encoded while somebody watches it."""
    source_networks: Annotated[tuple[IpNetwork, ...], BeforeValidator(comma_separated)] | None = None
    """Networks outside the public internet that a source given over REST may lie in. None: any, as long as the
    service itself listens on loopback only; otherwise none."""
    allowed_origins: Annotated[tuple[str, ...], BeforeValidator(comma_separated)] = ()
    """Foreign web origins (`https://host`) that may use the API, WHEP and the WebSockets; `*` is any."""
    ice_servers: tuple[IceServer, ...] = ()
    turn: Turn | None = None
    root_path: Annotated[str, Field(pattern=r"^(/[A-Za-z0-9._~-]+)*$")] = ""
    """Where a reverse proxy that cuts it off has put the service: `/mr360` for `https://host/mr360/view/live`."""
    trusted_proxies: Annotated[tuple[str, ...], BeforeValidator(comma_separated)] = ("127.0.0.1", "::1")
    """Addresses or networks whose X-Forwarded-For and -Proto headers are believed."""
    tokens: tuple[Token, ...] = ()
    """Who may view and control what. Empty: everybody everything."""
    edges: tuple[EdgeUrl, ...] = ()
    """WHEP endpoints to which viewers are sent on when max_viewers is reached; `{stream}` stands for the stream's name."""
    udp_ports: PortRange | None = None
    """Ports for the viewers' media, `40000-40100`; one for each viewer. None: any."""
    advertised_addresses: Annotated[tuple[str, ...], BeforeValidator(resolved)] = (OWN,)
    """Addresses that viewers are told to send to, in the place of the machine's own (containers, 1:1 address translation):
    IP addresses, host names, which are looked up at the start, and `own` for the machine's own beside them."""
    ice_networks: Annotated[tuple[IpNetwork, ...], BeforeValidator(comma_separated)] | None = None
    """Use only the machine's addresses in these networks for media. None: all of them."""
    outputs: tuple[ConfiguredOutput, ...] = ()                  # more can be made over REST
    max_outputs: Annotated[int, Field(ge=0, le=64)] = 8         # of one stream
    recordings_dir: Path = Field(default_factory=lambda: _data_folder("recordings"))
    playback: tuple[ConfiguredPlayback, ...] = ()               # ways to watch that hold whatever this service does

    @field_validator("source")
    @classmethod
    def _usable_source(cls, value: str | None) -> str | None:
        return check_command_line_source(value) if value else None

    @field_validator("assets_dir", "recordings_dir")
    @classmethod
    def _absolute(cls, value: Path) -> Path:
        return value.expanduser().absolute()

    @field_validator("renditions")
    @classmethod
    def _a_ladder(cls, value: tuple[Rendition, ...]) -> tuple[Rendition, ...]:
        names, scales = [rung.name for rung in value], [rung.scale for rung in value]
        if len(set(names)) < len(names):
            raise ValueError(f"renditions are named {', '.join(names)}, expected different names")
        if scales != sorted(scales, reverse=True):
            given = ", ".join(f"{scale:g}" for scale in scales)
            raise ValueError(f"renditions have the scales {given}, expected the largest first")
        return value

    @field_validator("allowed_origins")
    @classmethod
    def _plain_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for origin in value:
            scheme, _, rest = origin.partition("://")
            if origin != "*" and (scheme not in ("http", "https") or not rest or "/" in rest):
                raise ValueError(f"origin is {origin!r}, expected https://HOST, https://HOST:PORT or *")
        return value

    @model_validator(mode="after")
    def _outputs_fit(self) -> Settings:
        names = [rung.name for rung in self.renditions]
        for output in self.outputs:
            try:
                output.check_rendition(names)
            except ValueError as error:
                raise ValueError(f"outputs has {output.id!r}, whose {error}") from None
        ids = Counter((output.stream, output.id) for output in self.outputs)
        for (stream, output_id), count in ids.items():
            if count > 1:
                raise ValueError(f"outputs has {count} with the id {output_id!r} for stream {stream!r}, expected one")
        for stream, count in Counter(output.stream for output in self.outputs).items():
            if count > self.max_outputs:
                raise ValueError(f"outputs has {count} for stream {stream!r}, expected at most max_outputs, {self.max_outputs}")
        return self

    @property
    def loopback_only(self) -> bool:
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def media_ports(self) -> range | None:
        if self.udp_ports is None:
            return None
        first, _, last = self.udp_ports.partition("-")
        return range(int(first), int(last) + 1)

    @property
    def allowed_source_networks(self) -> tuple[IpNetwork, ...] | None:
        """Networks a REST source may lie in beside the public internet; None: anywhere."""
        if self.source_networks is not None:
            return self.source_networks
        return None if self.loopback_only else ()


def load_settings(command_line: Mapping[str, Any], config_file: Path | None = None,
                  environment: Mapping[str, str] | None = None) -> Settings:
    """Merge the three places a setting can come from.

    Args:
        command_line: setting to value, only those that were given.
        config_file: a TOML file with settings at the top level.
        environment: `MR360_*` variables; the process's own by default.

    Raises:
        ConfigError: names the value, where it came from and what was expected.
    """
    places = {
        "command line": dict(command_line),
        "environment": _from_environment(os.environ if environment is None else environment),
        str(config_file): _from_file(config_file) if config_file else {},
    }
    merged: dict[str, Any] = {}
    for values in reversed(places.values()):
        merged |= values
    try:
        return Settings.model_validate(merged)
    except ValidationError as error:
        raise ConfigError(_first_error(error.errors()[0], places)) from None


def _from_environment(environment: Mapping[str, str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for variable, text in environment.items():
        if variable.startswith(ENVIRONMENT_PREFIX):
            name = variable.removeprefix(ENVIRONMENT_PREFIX).lower()
            values[name] = _json(name, variable, text) if name in JSON_SETTINGS else text
    return values


def _json(name: str, variable: str, text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        shown = "no JSON" if name in SECRET_SETTINGS else repr(text)
        raise ConfigError(f"{variable} is {shown}, expected {JSON_SETTINGS[name]}") from None


def _from_file(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise ConfigError(f"config file {str(path)!r} cannot be read: {(error.strerror or '').lower()}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"config file {str(path)!r} is no TOML: {error}") from None


def _first_error(error: ErrorDetails, places: Mapping[str, Mapping[str, Any]]) -> str:
    name = str(error["loc"][0]) if error["loc"] else "outputs"      # a rule about several settings: all of these are
    place = next((place for place, values in places.items() if name in values), "default")
    if error["type"] == "extra_forbidden" and len(error["loc"]) == 1:
        return f"setting {name!r} ({place}) is unknown, expected one of {', '.join(Settings.model_fields)}"
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, SourceUrlError):
        return f"{cause} ({place})"
    expected = str(cause) if cause else error["msg"].lower().replace("input should be", "expected")
    setting = ".".join(str(part) for part in error["loc"] if "[" not in str(part)) or name     # no types of pydantic's own
    given = "" if name in SECRET_SETTINGS else f" is {error['input']!r}"
    return f"{setting}{given} ({place}), {expected}"
