"""Every way to watch a stream: from this service, and from the media servers that it goes out to."""

from __future__ import annotations

import random
from collections.abc import Iterable
from typing import Any

from server.outputs.spec import ConfiguredPlayback
from server.renditions import CODECS
from server.stream import Stream


def ways_to_watch(stream: Stream, base_url: str, configured: Iterable[ConfiguredPlayback]) -> list[dict[str, Any]]:
    """Ours first, then what the live outputs name, then the settings' entries. `base_url` is ours, without a slash at its end."""
    output = stream.output or {}
    renditions = output.get("renditions") or [rendition.model_dump(include={"name"}) for rendition in stream.renditions]
    source = stream.input or {}
    return [
        {"protocol": "whep", "url": f"{base_url}/whep/{stream.name}", "renditions": renditions, "codecs": list(CODECS),
         "sound": source.get("audio") is not None},
        {"protocol": "page", "url": f"{base_url}/view/{stream.name}"},
        *({"protocol": entry.protocol, "url": entry.url, "rendition": rendition, "via": output_id}
          for output_id, entry, rendition in stream.outputs.playback()),
        *(entry.model_dump(exclude={"stream"}, exclude_none=True) for entry in configured if entry.stream == stream.name),
    ]


def whep_edge(stream: Stream, configured: Iterable[ConfiguredPlayback] = ()) -> str | None:
    """The WHEP URL of a media server that has this stream now, where a viewer can be sent to (307) when we are at capacity.

    One at random of those behind live outputs; else one of the settings, which nobody here knows to be alive; None: nowhere.
    """
    live = [entry.url for _, entry, _ in stream.outputs.playback() if entry.protocol == "whep"]
    static = [entry.url for entry in configured if entry.stream == stream.name and entry.protocol == "whep"]
    edges = live or static
    return random.choice(edges) if edges else None
