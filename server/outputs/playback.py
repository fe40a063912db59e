"""Every way to watch a stream: from this service, and from the media servers that it goes out to."""

from __future__ import annotations

import random
from typing import Any

from server.config import Settings
from server.renditions import CODECS
from server.stream import Stream


def ways_to_watch(stream: Stream, base_url: str, settings: Settings) -> list[dict[str, Any]]:
    """Ours first, then what the live outputs name, then the settings' entries. `base_url` is ours, without a slash at its end."""
    output = stream.output or {}
    renditions = output.get("renditions") or [{"name": name} for name in stream.rendition_names]
    source = stream.input or {}
    return [
        {"protocol": "whep", "url": f"{base_url}/whep/{stream.name}", "renditions": renditions, "codecs": list(CODECS),
         "sound": source.get("audio") is not None},
        {"protocol": "page", "url": f"{base_url}/view/{stream.name}"},
        *({"protocol": entry.protocol, "url": entry.url, "rendition": rendition, "via": output_id}
          for output_id, entry, rendition in stream.outputs.playback()),
        *_configured(stream, settings),
    ]


def whep_edge(stream: Stream, settings: Settings) -> str | None:
    """The WHEP URL of a media server that has this stream, where a viewer can be sent to (307) when we are at capacity.

    One at random of those behind live outputs; else one of the settings, which nobody here knows to be alive; None: nowhere.
    """
    live = [entry.url for _, entry, _ in stream.outputs.playback() if entry.protocol == "whep"]
    edges = live or [entry["url"] for entry in _configured(stream, settings) if entry["protocol"] == "whep"]
    return random.choice(edges) if edges else None


def _configured(stream: Stream, settings: Settings) -> list[dict[str, Any]]:
    own = [entry for entry in settings.playback if entry.stream == stream.name]
    entries = [entry.model_dump(exclude={"stream"}, exclude_none=True) for entry in own]
    return entries + [{"protocol": "whep", "url": edge.replace("{stream}", stream.name)} for edge in settings.edges]
