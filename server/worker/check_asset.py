"""Checks an uploaded model in a process of its own: `python -m server.worker.check_asset FILE`.

Exit status 0 and one JSON line on stdout, or 2 and one line on stderr. The server sets limits on memory and time.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from renderer.models.gltf import GltfError, load


def main() -> int:
    try:
        mesh = load(Path(sys.argv[1]))
        proxy_triangles = len(mesh.proxy[1])
    except GltfError as error:
        print(error, file=sys.stderr)
        return 2
    except MemoryError:
        print("model needs more memory than an upload may use", file=sys.stderr)
        return 2
    low, high = mesh.outline.min(axis=0), mesh.outline.max(axis=0)
    print(json.dumps({"triangles": mesh.triangle_count, "primitives": len(mesh.primitives), "proxy_triangles": proxy_triangles,
                      "bounds": {"min": low.round(5).tolist(), "max": high.round(5).tolist()},
                      "clips": [{"name": name, "seconds": round(mesh.clip_seconds(name), 5)} for name in mesh.clips]}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
