"""Where an output may connect to, asked anew for each connection: a name may lead elsewhere than when the output was made."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

from server.outputs.server_link import OutputFailedError
from server.source_url import SourceUrlError, UnknownHostError, check_source_network


async def check_network(url: str, networks: Sequence[str] | None) -> None:
    """`networks`: those outside the public internet that are allowed too; None: any address is.

    Raises OutputFailedError: hopeless when the address is not allowed, to be tried again soon when the name is not known.
    """
    if networks is None:
        return
    try:
        await check_source_network(url, [ipaddress.ip_network(text) for text in networks])
    except UnknownHostError as error:
        raise OutputFailedError(str(error)) from None
    except SourceUrlError as error:
        raise OutputFailedError(str(error), hopeless=True) from None
