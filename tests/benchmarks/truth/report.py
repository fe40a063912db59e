"""The truth bench's tables and its page of pictures: ours, the truth, and four times the difference."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.benchmarks.truth.measures import Comparison, display

if TYPE_CHECKING:
    from tests.benchmarks.truth.__main__ import Case

ENLARGED = 2
BARS = {"diffuse": 0.04, "dielectric": 0.05, "glossy-metal": 0.07, "rough-metal": 0.07, "mirror": 0.07, "textured": 0.04}


def row(case: Case) -> str:
    """One case in lines of text, a preset a line."""
    lines = []
    for preset, (c, _) in case.results.items():
        objects = "  ".join(f"{name} {100 * error.value:.1f}±{100 * error.noise:.1f} ({100 * c.bias[name]:+.1f}) %"
                            for name, error in c.objects.items())
        lines.append(f"{case.scene:9} {case.map_name:17} {preset:8} shadow {c.shadow.value:.3f}±{c.shadow.noise:.3f} "
                     f"({c.shadow_bias:+.3f})  edge {c.coverage:.3f}  flip {c.flip:.3f} (noise {c.flip_of_noise:.3f})  {objects}")
    return "\n".join(lines)


def summary(cases: list[Case]) -> str:
    """Medians over the maps, for each preset, scene and object."""
    lines = ["", f"{'median over maps':44}{'error':>8}{'worst':>8}{'bar':>7}"]
    presets = list(cases[0].results)
    for preset in presets:
        for scene in dict.fromkeys(case.scene for case in cases):
            found = [case.results[preset][0] for case in cases if case.scene == scene]
            for name in found[0].objects:
                lines.append(_line(f"{preset} {scene}: {name}", [c.objects[name].value for c in found], BARS.get(name)))
            lines.append(_line(f"{preset} {scene}: shadow ratio", [c.shadow.value for c in found], 0.03))
            lines.append(_line(f"{preset} {scene}: silhouette", [c.coverage for c in found], 0.02))
            lines.append(_line(f"{preset} {scene}: ldr-flip", [c.flip for c in found], 0.05))
    for preset in presets[1:]:
        nearer = sum(case.results[presets[0]][0].flip < case.results[preset][0].flip for case in cases)
        lines.append(f"{presets[0]} nearer than {preset} by ldr-flip in {nearer} of {len(cases)}")
    return "\n".join(lines)


def _line(name: str, values: list[float], bar: float | None) -> str:
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return f"{name:44}{'-':>8}"
    return f"{name:44}{np.median(known):8.3f}{max(known):8.3f}" + (f"{bar:7.2f}" if bar else "")


def as_json(cases: list[Case]) -> list[dict[str, Any]]:
    """A row a case and preset."""
    return [{"scene": case.scene, "map": case.map_name, "preset": preset, **_numbers(comparison)}
            for case in cases for preset, (comparison, _) in case.results.items()]


def _numbers(c: Comparison) -> dict[str, Any]:
    objects = {name: {"rmse": error.value, "noise": error.noise, "bias": c.bias[name]} for name, error in c.objects.items()}
    return {"objects": objects,
            "shadow_rmse": c.shadow.value, "shadow_noise": c.shadow.noise, "shadow_bias": c.shadow_bias,
            "silhouette": c.coverage, "ldr_flip": c.flip, "ldr_flip_of_noise": c.flip_of_noise}


def write_page(cases: list[Case], folder: Path) -> None:
    """`index.html` with three pictures of every case and preset."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for case in cases:
        for preset, (_, image) in case.results.items():
            name = f"{case.scene}-{case.map_name}-{preset}.png"
            Image.fromarray(_strip(case, image)).save(folder / name)
            rows.append(f"<h2>{html.escape(f'{case.scene} in {case.map_name}, {preset}')}</h2><pre>{html.escape(row(case))}</pre>"
                        f"<img src='{name}'>")
    head = "<!doctype html><meta charset=utf-8><title>mr360 against a path tracer</title><style>img{max-width:100%}</style>"
    note = "<p>left ours, middle the truth, right four times the difference</p>"
    page = head + "<h1>mr360 against a path tracer</h1>" + note + "\n".join(rows) + f"<pre>{html.escape(summary(cases))}</pre>"
    (folder / "index.html").write_text(page)


def _strip(case: Case, image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Ours, truth and difference side by side, cut to what was traced and turned so that the seam is not in the way."""
    panorama = case.panorama.astype(np.float64)
    columns, rows = np.flatnonzero(case.mask.any(axis=0)), np.flatnonzero(case.mask.any(axis=1))
    gaps = np.diff(np.concatenate([columns, columns[:1] + case.mask.shape[1]]))
    start = int(columns[(int(np.argmax(gaps)) + 1) % len(columns)])
    width = case.mask.shape[1] - int(gaps.max()) + 1
    ours, truth = (display(np.roll(one, -start, axis=1)[rows[0]:rows[-1] + 1, :width], panorama)
                   for one in (image.astype(np.float64), case.truth))
    difference = np.clip(0.5 + 4 * (ours - truth), 0, 1)
    strip = np.concatenate([ours, truth, difference], axis=1)
    return np.asarray(np.round(strip * 255).astype(np.uint8).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1))
