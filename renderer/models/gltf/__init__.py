"""Loads glTF 2.0 models; everything that reaches the renderer is checked here, because models are uploaded by strangers."""

from renderer.models.gltf.document import GltfError
from renderer.models.gltf.model import load
from renderer.models.hierarchy import transform

__all__ = ["GltfError", "load", "transform"]
