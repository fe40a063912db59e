"""The service: owner of the streams, the WHEP sessions, the assets and the metrics."""

from __future__ import annotations

from server.assets import Assets
from server.config import Settings
from server.delivery.media_addresses import MediaAddresses, UdpPorts
from server.delivery.whep import WhepSessions
from server.metrics import Metrics
from server.network_settings import IceServer
from server.outputs.spec import OutputSpec
from server.source_url import check_network_source, check_source_network
from server.stream import Stream
from server.streams import LIVE, Streams


class Service:
    """Made by the application's lifespan: `start`, then `close`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.metrics = Metrics()
        self.assets = Assets(settings.assets_dir)
        self.streams = Streams(settings, self.metrics)
        self.whep = WhepSessions(settings.max_viewers, MediaAddresses(
            UdpPorts(settings.media_ports), settings.advertised_addresses, settings.ice_networks))
        self.ice_server_links = tuple(_link(server) for server in settings.ice_servers)

    def start(self) -> None:
        self.streams.add(LIVE, self.settings.source)

    async def close(self) -> None:
        await self.whep.close()
        await self.streams.close()

    async def remove_stream(self, stream: Stream) -> None:
        await self.whep.close_stream(stream)
        await self.streams.remove(stream.name)

    async def check_rest_source(self, source: str) -> str:
        """The source as a client of the API may name it. Raises SourceUrlError."""
        check_network_source(source)
        allowed = self.settings.allowed_source_networks
        if allowed is not None:
            await check_source_network(source, allowed)
        return source

    async def check_rest_output(self, spec: OutputSpec) -> tuple[str, ...] | None:
        """The networks outside the public internet that an output made over the API may connect to; None: any.

        Raises SourceUrlError when its host lies elsewhere.
        """
        allowed = self.settings.allowed_source_networks
        if allowed is None:
            return None
        if spec.url is not None:
            await check_source_network(spec.url, allowed)
        return tuple(str(network) for network in allowed)


def _link(server: IceServer) -> str:
    link = f'<{server.url}>; rel="ice-server"'
    if server.username:
        link += f'; username="{server.username}"; credential="{server.credential}"; credential-type="password"'
    return link
