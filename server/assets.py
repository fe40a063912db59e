"""Uploaded models: checked before they are kept, stored as `{assets_dir}/{name}.glb` with what the check found in `{name}.json`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import resource
import secrets
import struct
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, BinaryIO

from renderer.scene import Scene

MAX_ASSET_BYTES = 64 << 20
NAME_PATTERN = r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}$"
CHECK_COMMAND: tuple[str, ...] = (sys.executable, "-m", "server.worker.check_asset")
CHECK_LIMIT_S = 30.0
CHECK_CPU_S = 20
CHECK_MEMORY_BYTES = 4 << 30    # address space: numpy's libraries alone map a good part of it
MAX_COMPLAINT = 4096
MAX_FACTS = 256 << 10    # 256 clips, whose names have 64 characters, escaped

_GLB_HEADER = struct.Struct("<4sII")
_NAME = re.compile(NAME_PATTERN)


class AssetError(ValueError):
    """The uploaded file cannot be used, the text says why."""


class AssetTooLargeError(AssetError):
    """The file is longer than MAX_ASSET_BYTES."""


class DuplicateAssetError(AssetError):
    """The name is in use."""


class AssetStorageError(OSError):
    """The folder cannot be written."""


class Assets:
    """The folder of models."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._one_check_at_a_time = asyncio.Lock()

    def names(self) -> list[str]:
        return sorted(path.stem for path in self._folder.glob("*.glb") if _NAME.match(path.stem))

    def describe(self, name: str) -> dict[str, Any]:
        """What is known of a model: of one that was not uploaded, its name and size alone."""
        return {**self._facts(name), "name": name, "mesh": f"asset:{name}", "bytes": self._path(name).stat().st_size}

    def exists(self, name: str) -> bool:
        return _NAME.match(name) is not None and self._path(name).is_file()

    def unknown_in(self, scene: Scene) -> str | None:
        """The first `asset:NAME` mesh of the scene that does not exist."""
        for placed in (*scene.objects, *scene.local_scene):
            if placed.mesh.startswith("asset:") and not self.exists(placed.mesh.removeprefix("asset:")):
                return placed.mesh
        return None

    async def add(self, name: str | None, chunks: AsyncIterator[bytes]) -> dict[str, Any]:
        """Store a GLB under the name, or under a new one.

        Raises:
            AssetError: the name is in use, or the file is too large, no GLB or not usable.
            AssetStorageError: the folder cannot be written.
        """
        name = name or f"model-{secrets.token_hex(4)}"
        if self.exists(name):
            raise DuplicateAssetError(f"asset {name!r} exists already, expected a new name")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            upload = tempfile.TemporaryDirectory(dir=self._folder, prefix=".upload-")
        except OSError as error:
            raise AssetStorageError(f"assets_dir {str(self._folder)!r} cannot be written: {error.strerror}") from None
        with upload as folder:
            partial = Path(folder) / f"{name}.glb"      # its own name: the checker's message may cite it
            with partial.open("wb") as file:
                await _receive(chunks, file)
            async with self._one_check_at_a_time:
                facts = await _check(partial)
            facts_file = Path(folder) / f"{name}.json"
            facts_file.write_text(json.dumps(facts))
            try:
                os.link(partial, self._path(name))      # unlike a rename, never replaces
            except FileExistsError:
                raise DuplicateAssetError(f"asset {name!r} exists already, expected a new name") from None
            facts_file.replace(self._facts_path(name))
        return self.describe(name)

    def remove(self, name: str) -> None:
        self._path(name).unlink()
        self._facts_path(name).unlink(missing_ok=True)

    def _facts(self, name: str) -> dict[str, Any]:
        try:
            facts = json.loads(self._facts_path(name).read_bytes())
        except (OSError, ValueError):
            return {}
        return facts if isinstance(facts, dict) else {}

    def _facts_path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.glb"


async def _receive(chunks: AsyncIterator[bytes], file: BinaryIO) -> None:
    size, head = 0, b""
    async for chunk in chunks:
        size += len(chunk)
        if size > MAX_ASSET_BYTES:
            raise AssetTooLargeError(f"the file is longer than {MAX_ASSET_BYTES} bytes")
        if len(head) < _GLB_HEADER.size:
            head += chunk[:_GLB_HEADER.size]
        file.write(chunk)
    if len(head) < _GLB_HEADER.size:
        raise AssetError(f"the file has {size} bytes, expected a GLB with its {_GLB_HEADER.size} byte header")
    magic, version, length = _GLB_HEADER.unpack(head[:_GLB_HEADER.size])
    if magic != b"glTF" or version != 2:
        raise AssetError(f"the file begins with {magic!r} version {version}, expected b'glTF' version 2")
    if length != size:
        raise AssetError(f"the GLB header names {length} bytes, the file has {size}")


async def _check(path: Path) -> dict[str, Any]:
    """Load the model in a process of its own with limits: a hostile file may take that down, not the service."""
    process = await asyncio.create_subprocess_exec(
        *CHECK_COMMAND, str(path), stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, start_new_session=True)
    try:
        # Set from outside, right after the start: a function run between fork and exec is not safe beside threads.
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(process.pid, resource.RLIMIT_AS, (CHECK_MEMORY_BYTES, CHECK_MEMORY_BYTES))
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (CHECK_CPU_S, CHECK_CPU_S))
        async with asyncio.timeout(CHECK_LIMIT_S):
            output, complaint = await process.communicate()
    except TimeoutError:
        raise AssetError(f"the model took longer than {CHECK_LIMIT_S:g} s to load") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    lines = complaint.decode(errors="replace").strip().splitlines()
    if process.returncode != 0:
        raise AssetError(lines[-1][:MAX_COMPLAINT] if lines and process.returncode == 2
                         else f"the model cannot be loaded (status {process.returncode})")
    facts = json.loads(output[:MAX_FACTS])
    if not isinstance(facts, dict):
        raise TypeError(f"check_asset printed {facts!r}, expected a JSON object")
    return facts
