"""Meshes by the names that scenes use, loaded once: built-in, `asset:NAME`, or a path beside a scene file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path

from renderer.models.gltf import GltfError, load
from renderer.models.gpu_mesh import GpuMesh
from renderer.models.mesh import BUILT_IN, Mesh


class MeshLibrary:
    """Owns the GPU copy of every mesh in use. A file that changes on disk is loaded anew."""

    def __init__(self, upload: Callable[[Mesh], GpuMesh], assets: Path | None, mesh_root: Path | None) -> None:
        self._upload = upload
        self._assets = assets
        self._mesh_root = mesh_root
        self._loaded: dict[tuple[str, str], tuple[float, GpuMesh | GltfError]] = {}

    def get(self, name: str, owner: str = "") -> GpuMesh:
        """The mesh of that name; with an `owner` one of its own, because its vertices move. Raises GltfError, the same one again
        without reading the file again."""
        path = self._path(name)
        modified = _modified(path)
        kept = self._loaded.get((name, owner))
        if kept is None or kept[0] != modified:
            if kept is not None and isinstance(kept[1], GpuMesh):
                kept[1].release()
            kept = self._loaded[name, owner] = (modified, self._load(name, path))
        if isinstance(kept[1], GltfError):
            raise kept[1]
        return kept[1]

    def keep(self, wanted: set[tuple[str, str]]) -> None:
        """Release the meshes of owners that are not among these names and owners."""
        for key in [key for key in self._loaded if key[1] and key not in wanted]:
            mesh = self._loaded.pop(key)[1]
            if isinstance(mesh, GpuMesh):
                mesh.release()

    def state(self, names: Iterable[str]) -> dict[str, float]:
        """When each of these was last changed on disk; equal states mean equal meshes."""
        return {name: _modified(self._path_or_none(name)) for name in set(names)}

    def _path_or_none(self, name: str) -> Path | None:
        try:
            return self._path(name)
        except GltfError:
            return None

    def _path(self, name: str) -> Path | None:
        if name in BUILT_IN:
            return None
        if name == "teapot":
            return Path(str(resources.files("renderer.models.builtin") / "teapot.glb"))
        if name.startswith("asset:"):
            if self._assets is None:
                raise GltfError(f"mesh {name!r}: there is no asset folder")
            return self._assets / f"{name.removeprefix('asset:')}.glb"
        if self._mesh_root is None:
            raise GltfError(f"mesh {name!r} is a path, expected one only in a scene file")
        return self._mesh_root / name

    def _load(self, name: str, path: Path | None) -> GpuMesh | GltfError:
        try:
            return self._upload(BUILT_IN[name]() if path is None else load(path))
        except GltfError as error:
            return error

    def release(self) -> None:
        for _, mesh in self._loaded.values():
            if isinstance(mesh, GpuMesh):
                mesh.release()
        self._loaded.clear()


def _modified(path: Path | None) -> float:
    try:
        return path.stat().st_mtime if path is not None else 0.0
    except OSError:
        return 0.0
