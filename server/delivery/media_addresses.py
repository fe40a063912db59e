"""Where our side of the viewers' connections lives, and where viewers are told that it does."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import logging
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field

from server.network_settings import OWN
from server.source_url import IpNetwork

logger = logging.getLogger(__name__)


class NoSocketError(RuntimeError):
    """There is no free port, or no address, for a viewer's media."""


class UdpPorts:
    """Hands out sockets. A port that was just left is the last to be taken again: its viewer's packets may still come."""

    def __init__(self, ports: range | None = None) -> None:
        """None: whatever port the system picks."""
        self._ports = ports
        self._next = 0

    def bind(self, addresses: Sequence[str]) -> list[socket.socket]:
        """A socket at each of the machine's addresses, all with the same port. Addresses that cannot be bound are left out.

        Raises:
            NoSocketError: no port of the range is free.
        """
        if self._ports is None:
            return _bind_all(addresses, 0)
        for offset in range(len(self._ports)):
            place = (self._next + offset) % len(self._ports)
            try:
                sockets = _bind_all(addresses, self._ports[place])
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                continue
            self._next = place + 1
            return sockets
        raise NoSocketError(f"no UDP port from {self._ports[0]} to {self._ports[-1]} is free, the setting udp_ports")


@dataclass(frozen=True, slots=True)
class MediaAddresses:
    """The settings udp_ports, advertised_addresses and ice_networks together."""

    ports: UdpPorts = field(default_factory=UdpPorts)
    advertised: tuple[str, ...] = (OWN,)
    """IP addresses in the place of the machine's own (1:1 address translation, containers); `own` stands for those."""
    networks: tuple[IpNetwork, ...] | None = None
    """Use only the machine's addresses in these networks; None: all."""

    def usable(self, addresses: Sequence[str]) -> list[str]:
        """Those of the machine's addresses to bind. Raises NoSocketError for none."""
        found = [address for address in addresses if self.shown(address) and self._allowed(address)]
        if not found:
            raise NoSocketError(f"none of the addresses {', '.join(addresses) or '(there are none)'} can be used for media, "
                                "see the settings ice_networks and advertised_addresses")
        return found

    def _allowed(self, address: str) -> bool:
        return self.networks is None or any(ipaddress.ip_address(address) in network for network in self.networks)

    def shown(self, address: str) -> list[str]:
        """What a viewer is told instead of `address`: the advertised ones of the same IP version."""
        version = ipaddress.ip_address(address).version
        given = [address if other == OWN else other for other in self.advertised]
        return [other for other in given if ipaddress.ip_address(other).version == version]


def _bind_all(addresses: Sequence[str], port: int) -> list[socket.socket]:
    """Raises OSError when the port is in use at one of the addresses."""
    with contextlib.ExitStack() as opened:
        sockets = []
        for address in addresses:
            family = socket.AF_INET6 if ipaddress.ip_address(address).version == 6 else socket.AF_INET
            bound = opened.enter_context(socket.socket(family, socket.SOCK_DGRAM))
            try:
                bound.bind((address, port))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise
                logger.info("no media from %s: %s", address, (error.strerror or str(error)).lower())
                bound.close()
                continue
            bound.setblocking(False)
            sockets.append(bound)
        opened.pop_all()
        return sockets
