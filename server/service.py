"""The service: owner of the streams, the WHEP sessions, the assets and the metrics."""

from __future__ import annotations

import logging

from server.assets import Assets
from server.auth import Tokens
from server.config import Settings
from server.delivery.media_addresses import MediaAddresses, UdpPorts
from server.delivery.whep_sessions import WhepSessions
from server.metrics import Metrics
from server.outputs.playback import whep_edge
from server.outputs.spec import OutputSpec
from server.rate_limit import RateLimit
from server.source_url import check_network_source, check_source_network
from server.stream import Stream
from server.streams import LIVE, Streams
from server.turn import turn_credentials

logger = logging.getLogger(__name__)


class Service:
    """Made by the application's lifespan: `start`, then `close`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.metrics = Metrics()
        self.assets = Assets(settings.assets_dir)
        self.streams = Streams(settings, self.metrics)
        self.whep = WhepSessions(settings.max_viewers, MediaAddresses(
            UdpPorts(settings.media_ports), settings.advertised_addresses, settings.ice_networks))
        self.tokens = Tokens(settings.tokens)
        self.offers = RateLimit(burst=2 * settings.max_viewers, per_second=min(20.0, settings.max_viewers / 5.0))

    def start(self) -> None:
        if not self.tokens.required and not self.settings.loopback_only:
            logger.warning("everybody who reaches %s may view and control: the setting tokens is empty", self.settings.host)
        self.streams.add(LIVE, self.settings.source)

    async def close(self) -> None:
        await self.whep.close()
        await self.streams.close()

    async def remove_stream(self, stream: Stream) -> None:
        await self.whep.close_stream(stream)
        await self.streams.remove(stream.name)

    def ice_server_links(self) -> list[str]:
        """Values of `Link` headers (draft-ietf-wish-whep section 4.4), with TURN credentials of their own each time."""
        links = [_link(server.url, server.username, server.credential) for server in self.settings.ice_servers]
        turn = self.settings.turn
        if turn is not None:
            username, credential = turn_credentials(turn.secret.get_secret_value(), turn.ttl_s)
            links += [_link(url, username, credential) for url in turn.urls]
        return links

    def edge(self, stream: Stream) -> str | None:
        """A WHEP endpoint elsewhere with the same stream: of a live output's, else of the settings `edges` and `playback`."""
        return whep_edge(stream, self.settings)

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


def _link(url: str, username: str, credential: str) -> str:
    link = f'<{url}>; rel="ice-server"'
    if username:
        link += f'; username="{username}"; credential="{credential}"; credential-type="password"'
    return link
