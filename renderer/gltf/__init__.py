"""Loads glTF 2.0 models; everything that reaches the renderer is checked here, because models are uploaded by strangers."""

from renderer.gltf.document import GltfError
from renderer.gltf.model import load
from renderer.hierarchy import transform

__all__ = ["GltfError", "load", "transform"]
