"""The ladder of renditions: the same picture at several sizes and bitrates, best first."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

CODECS = ("h264", "vp8")
AUDIO = "audio/opus"        # the name of the sound's track; those of pictures are rendition/codec


class Rendition(BaseModel):
    """One rung. `scale` is of the full picture's sides; without `bitrate_bps` the bitrate is the full picture's times scale²."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[a-z0-9-]{1,16}$")]
    scale: Annotated[float, Field(gt=0.1, le=1.0)]
    bitrate_bps: Annotated[int, Field(ge=50_000, le=200_000_000)] | None = None


LADDER = (Rendition(name="full", scale=1.0), Rendition(name="medium", scale=2 / 3), Rendition(name="low", scale=0.5))
