"""`make bench-truth MAPS=FOLDER`: the renderer against a path-traced truth, every scene in every map, ours and the papers' methods.

Truths are kept by the hash of everything they follow from. Pictures of every case go to one page; look at all of them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.benchmarks.truth import path_tracer, report
from tests.benchmarks.truth.cases import MAPS, load_map, scenes, traced_region
from tests.benchmarks.truth.measures import Comparison, compare
from tests.benchmarks.truth.path_tracer import Traced, trace
from tests.benchmarks.truth.solid import solid_of

MOMENT = 0.3        # of the animations, in seconds
PRESETS = {"default": {"preset": "default"}, "paper": {"preset": "paper"}}


@dataclass(frozen=True)
class Case:
    """One scene in one map: what was measured with each preset, and the pictures as radiance."""

    scene: str
    map_name: str
    panorama: NDArray[np.float32]
    truth: NDArray[np.float64]
    mask: NDArray[np.bool_]
    results: dict[str, tuple[Comparison, NDArray[np.float32]]]


class _Bench:
    def __init__(self, arguments: argparse.Namespace) -> None:
        self.width, self.samples, self.cache = arguments.width, arguments.samples, arguments.cache
        self.folder = arguments.maps
        fox = arguments.maps.parent / "mesh" / "fox_skinned_3anims.gltf"
        self.scenes = scenes(fox if fox.exists() else None)
        self.context = Context()
        self.pipeline = Pipeline(self.context, RadianceFrame, (self.width, self.width // 2), mesh_root=fox.parent)
        self.cache.mkdir(parents=True, exist_ok=True)

    def run(self, scene_name: str, map_name: str) -> Case:
        document = self.scenes[scene_name]
        panorama = load_map(self.folder, map_name, self.width)
        images = {preset: self._render(document, panorama, lighting) for preset, lighting in PRESETS.items()}
        assert self.pipeline.placement is not None
        solid, names, bounds = solid_of(self.pipeline.placement)
        mask = traced_region(document, bounds, self.width)
        halves = [self._truth(solid, panorama, document["camera_height"], mask, seed) for seed in (1, 2)]
        coverage = self._coverage(document)
        results = {preset: (compare(image.astype(np.float64), coverage, panorama.astype(np.float64), mask, names, *halves), image)
                   for preset, image in images.items()}
        truth = panorama.astype(np.float64)
        truth[mask] = sum(half.over(truth[mask]) for half in halves) / 2
        return Case(scene_name, map_name, panorama, truth, mask, results)

    def _render(self, document: dict[str, Any], panorama: NDArray[np.float32], lighting: dict[str, Any]) -> NDArray[np.float32]:
        scene = Scene.model_validate({**document, "lighting": lighting}, context={"allow_mesh_paths": True})
        self.pipeline.reset()
        rendered = self.pipeline.render(RadianceFrame(panorama), scene, moment=MOMENT)
        for name, error in rendered.errors.items():
            print(f"  {name}: {error}", file=sys.stderr)
        assert isinstance(rendered.frame, RadianceFrame)
        return rendered.frame.rgb

    def _coverage(self, document: dict[str, Any]) -> NDArray[np.float64]:
        """(height, width): of the objects, which glow in the dark for this."""
        glow = {"base_color": [0, 0, 0], "metallic": 0.0, "roughness": 1.0, "emissive": [1, 1, 1]}
        dark = {**document, "objects": [{**item, "material": glow} for item in document["objects"]]}
        return self._render(dark, np.zeros((self.width // 2, self.width, 3), dtype=np.float32), {})[..., 0].astype(np.float64)

    def _truth(self, solid: path_tracer.Solid, panorama: NDArray[np.float32], camera_height: float, mask: NDArray[np.bool_],
               seed: int) -> Traced:
        digest = hashlib.sha256(Path(path_tracer.__file__).read_bytes())
        for value in (*vars(solid).values(), panorama, camera_height, mask, seed, self.samples):
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        path = self.cache / f"{digest.hexdigest()[:24]}.npz"
        if path.exists():
            kept = np.load(path)
            return Traced(*(kept[name].astype(np.float64) for name in ("radiance", "coverage", "ratio", "share")))
        traced = trace(solid, panorama, camera_height, np.argwhere(mask), self.samples // 2, seed)
        np.savez(path, radiance=traced.object_radiance.astype("f4"), coverage=traced.coverage.astype("f4"),
                 ratio=traced.floor_ratio.astype("f4"), share=traced.floor_share.astype("f4"))
        return traced


def main() -> int:
    """Print the tables, write the page and the JSON. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="bench-truth", description=__doc__)
    parser.add_argument("--maps", type=Path, required=True, help="folder of radiance maps")
    parser.add_argument("--only-maps", nargs="*", help=f"names of files; by default {', '.join(MAPS.values())}")
    parser.add_argument("--only-scenes", nargs="*")
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=256, help="a pixel")
    parser.add_argument("--cache", type=Path, default=Path(".cache/truth"))
    parser.add_argument("--output", type=Path, default=Path("out/truth"), help="folder of the page")
    arguments = parser.parse_args()
    bench = _Bench(arguments)
    cases = []
    for scene in arguments.only_scenes or bench.scenes:
        for map_name in arguments.only_maps or MAPS.values():
            cases.append(bench.run(scene, map_name))
            print(report.row(cases[-1]), flush=True)
    print(report.summary(cases))
    report.write_page(cases, arguments.output)
    (arguments.output / "truth.json").write_text(json.dumps(report.as_json(cases), indent=1) + "\n")
    print(f"pictures: {arguments.output / 'index.html'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
