"""Marks an MP4 file as an equirectangular panorama (Google's Spherical Video V1: an XML box in the video track)."""

from __future__ import annotations

import struct
from pathlib import Path
from uuid import UUID

SPHERICAL_UUID = UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
_XML = (b'<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
        b'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
        b"<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:StitchingSoftware>mr360</GSpherical:StitchingSoftware>"
        b"<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>")


def add_spherical_metadata(path: Path) -> None:
    """Insert the box in place. The movie header must stand behind the media data, so that no offset changes.

    Raises ValueError when the file has no movie header at its end or no track in it.
    """
    data = path.read_bytes()
    moov = _find(data, 0, len(data), b"moov")
    if moov + _size(data, moov) != len(data):
        raise ValueError(f"file {path.name!r} has data behind its movie header, expected it to be last")
    path.write_bytes(_grown(data, moov))


def with_spherical_metadata(beginning: bytes) -> bytes | None:
    """The beginning of a fragmented file with the box inserted; None while its movie header is not whole yet.

    Nothing in such a file counts from its beginning, apart from an index at its end. Raises ValueError when there is no track.
    """
    try:
        moov = _find(beginning, 0, len(beginning), b"moov")
    except ValueError:
        return None
    if len(beginning) < moov + _size(beginning, moov):
        return None
    return _grown(beginning, moov)


def _grown(data: bytes, moov: int) -> bytes:
    trak = _find(data, moov + 8, moov + _size(data, moov), b"trak")
    box = struct.pack(">I4s", 24 + len(_XML), b"uuid") + SPHERICAL_UUID + _XML
    end = trak + _size(data, trak)
    grown = bytearray(data[:end] + box + data[end:])
    for start in (moov, trak):
        struct.pack_into(">I", grown, start, _size(data, start) + len(box))
    return bytes(grown)


def _size(data: bytes, start: int) -> int:
    size = int(struct.unpack_from(">I", data, start)[0])
    return int(struct.unpack_from(">Q", data, start + 8)[0]) if size == 1 else size


def _find(data: bytes, start: int, end: int, kind: bytes) -> int:
    """Offset of the first box of that kind among those from `start` to `end`."""
    while start + 8 <= end:
        if data[start + 4:start + 8] == kind:
            return start
        size = _size(data, start)
        if size < 8:
            break
        start += size
    raise ValueError(f"no {kind.decode()!r} box in the file")
