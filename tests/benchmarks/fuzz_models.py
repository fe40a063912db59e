"""Loads and poses models that are broken in random ways: `python -m tests.benchmarks.fuzz_models --seconds 600 --seed 1`.

Anything but a GltfError, a case of more than 10 s, and memory beyond the limit are failures. Each is saved as a model and a text
in `out/fuzz`; the same seed makes the same cases.
"""

from __future__ import annotations

import argparse
import collections
import io
import itertools
import json
import multiprocessing
import random
import resource
import secrets
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from renderer.models.gltf import GltfError, load
from renderer.models.mesh import Mesh
from tests.models import Model, bent_bar, glb, one_triangle

FOLDER = Path("out/fuzz")
MEMORY_BYTES = 4 << 30      # address space, as for an upload
CASE_SECONDS = 10.0
MOMENTS = (0.37, -12.3, 1e9)
NUMBERS = [-1, 0, 1, 2, 3, 4, 5, 7, 255, 65535, 1 << 31, 10**9, 1 << 63, 10**30, 0.5, -0.0, 1e-30, 1e9, 1e38, 1e300, -1e300]
VALUES = [*NUMBERS, None, True, "", "LINEAR", "CUBICSPLINE", "STEP", "MASK", "SCALAR", "VEC3", "VEC4", "MAT4", "\ud800", [], {},
          [[]], [0, 0, 0], [0, 0, 0, 0], [1e30] * 3, [0.0] * 16, 5120, 5121, 5123, 5125, 5126, 33071]
FLOATS = struct.pack("<16f", np.nan, np.inf, 1e38, 0, 0, 1e-40, 1e9, -1e9, 1e-9, 0.5, -0.5, 1, -1, 2, 30, 1000)


def full_bar() -> Model:
    """Skin, morph targets, two clips, every texture slot, vertex colours and a sparse accessor."""
    model = bent_bar()
    attributes = model.json["meshes"][0]["primitives"][0]["attributes"]
    attributes.update(TEXCOORD_0=model.accessor(np.linspace(0, 1, 12, dtype="f4").reshape(6, 2)),
                      TEXCOORD_1=model.accessor(np.zeros((6, 2), "f4")), TANGENT=model.accessor(np.ones((6, 4), "f4")),
                      COLOR_0=model.accessor(np.ones((6, 4), "u1"), normalized=True))
    sparse = {"count": 2, "indices": {"bufferView": model.view(np.array([1, 3], "u2").tobytes()), "componentType": 5123},
              "values": {"bufferView": model.view(np.ones((2, 3), "f4").tobytes())}}
    targets = [{"POSITION": model.accessor(np.ones((6, 3), "f4"), sparse=sparse), "NORMAL": model.accessor(np.ones((6, 3), "f4"))},
               {"POSITION": model.add("accessors", componentType=5126, count=6, type="VEC3", sparse=sparse)}]
    info = model.texture(np.full((4, 4, 3), 99, "u1"), sampler=0)
    jpeg = io.BytesIO()
    Image.new("RGB", (16, 16), "teal").save(jpeg, "jpeg")
    photo = {"index": model.add("textures", source=model.add("images", bufferView=model.view(jpeg.getvalue())))}
    material = model.add(
        "materials", pbrMetallicRoughness={"baseColorTexture": info, "metallicRoughnessTexture": photo}, emissiveTexture=photo,
        normalTexture={**info, "texCoord": 1, "scale": 2}, occlusionTexture={**info, "strength": 0.5}, alphaMode="MASK",
        extensions={"KHR_materials_clearcoat": {"clearcoatFactor": 1}, "KHR_materials_unlit": {}})
    for view in model.json["bufferViews"][:2]:      # positions and normals
        view["byteStride"] = 12
    model.json["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    model.json["meshes"][0]["primitives"][0].update(targets=targets, material=material)
    model.json["meshes"][0]["weights"] = [0.1, 0.2]
    model.clip(0, "weights", [0, 1, 3], np.arange(18, dtype="f4"), "CUBICSPLINE")
    model.clip(1, "scale", [0, 2], [[1, 1, 1], [0, 2, 1]], "STEP", name="shrink")
    return model


def rigid_tree() -> Model:
    """Nodes that turn and nodes that do not, a fan, a strip and a primitive without normals."""
    model = one_triangle({"normalTexture": {"index": 0}}, TEXCOORD_0=np.eye(3, 2, dtype="f4"))
    model.texture(np.zeros((2, 2, 4), "u1"))
    shown = model.json["meshes"][0]["primitives"]
    shown += [{**shown[0], "mode": 5}, {**shown[0], "mode": 6, "material": model.add("materials", alphaMode="BLEND")}]
    model.json.update(nodes=[{"mesh": 0, "children": [1, 2]}, {"mesh": 0, "scale": [-1, 1, 2]},
                             {"mesh": 0, "matrix": np.eye(4).ravel().tolist()}])
    model.clip(1, "rotation", [0, 1, 2], [[0, 0, 0, 1], [0, 0, 1, 0], [1, 0, 0, 0]])
    model.clip(0, "translation", [0.5, 1], np.zeros((6, 3), "f4"), "CUBICSPLINE")
    return model


MODELS = (full_bar(), rigid_tree(), one_triangle({}, NORMAL=np.ones((3, 3), "f4")))


def case(seed: int, number: int) -> bytes:
    """One broken model."""
    dice = random.Random(f"{seed} {number}")
    original = dice.choice(MODELS)
    document, binary = json.loads(json.dumps(original.json)), original.binary
    document["buffers"] = [{"byteLength": len(binary)}]
    kind = dice.choice((0, 0, 0, 1, 1, 2, 3))
    if kind in (0, 2):
        for _ in range(dice.choice((1, 1, 2, 5))):
            change_json(document, dice)
    if kind in (1, 2):
        binary = changed_bytes(binary, dice, FLOATS)
    data = glb(document, binary)
    return changed_bytes(data, dice, b"\0\xff\x7f\x80{}[],:\"-9") if kind == 3 else data


def change_json(document: Any, dice: random.Random) -> None:
    holders = [holder for holder in containers(document) if holder]
    holder = dice.choice(holders)
    items = list(holder.items() if isinstance(holder, dict) else enumerate(holder))
    numbers = [item for item in items if isinstance(item[1], (int, float))]
    key, value = dice.choice(numbers if numbers and dice.random() < 0.8 else items)
    action = dice.randrange(8)
    if action == 0:
        del holder[key]
    elif action == 1 and isinstance(holder, list):
        holder.extend(json.loads(json.dumps(holder[:1] * dice.choice((1, 3, 300)))))
    elif action == 2:
        holder[key] = json.loads(json.dumps(dice.choice(holders)))
    elif action == 3 or not isinstance(value, (int, float)):
        holder[key] = json.loads(json.dumps(dice.choice(VALUES)))
    else:
        holder[key] = dice.choice(NUMBERS[:12] if dice.random() < 0.7 else NUMBERS)


def containers(value: Any, depth: int = 0) -> Iterator[Any]:
    if isinstance(value, (dict, list)) and depth < 50:
        yield value
        for inner in value.values() if isinstance(value, dict) else value:
            yield from containers(inner, depth + 1)


def changed_bytes(data: bytes, dice: random.Random, words: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(dice.choice((1, 1, 3, 20))):
        place = dice.randrange(len(changed)) if changed else 0
        if words is FLOATS:
            place, start = place & ~3, 4 * dice.randrange(len(words) // 4)
            changed[place:place + 4] = words[start:start + 4]
        else:
            changed[place:place + 1] = bytes([dice.choice(words) if dice.random() < 0.5 else dice.randrange(256)])
    if dice.random() < 0.1:
        del changed[dice.randrange(len(changed) + 1):]
    return bytes(changed)


def use(mesh: Mesh) -> None:
    """What the renderer does with a mesh."""
    arrays = [mesh.proxy[0], mesh.fine_proxy[0], mesh.outline]
    for clip in (None, *mesh.clips[:4]):
        for seconds in MOMENTS:
            pose = mesh.pose(clip, seconds, loop=seconds != 1e9)
            arrays += [array for part in pose.primitives for array in part if array is not None]
        arrays += [mesh.posed_proxy(pose), mesh.posed_proxy(pose, fine=True), mesh.posed_outline(pose)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise AssertionError("a mesh has values that are not finite")
    if not all(0 < len(proxy[1]) <= most for proxy, most in ((mesh.proxy, 128), (mesh.fine_proxy, 500))):
        raise AssertionError("a proxy has no triangles, or too many")
    if not all(part.triangles.max() < len(part.positions) for part in mesh.primitives):
        raise AssertionError("a mesh has triangles without vertices")


def work(pipe: Connection, path: Path, seed: int, first: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    warnings.simplefilter("error")
    for number in itertools.count(first):
        path.write_bytes(case(seed, number))
        pipe.send(("begin", number, ""))
        try:
            use(load(path))
            pipe.send(("loaded", number, ""))
        except GltfError:
            pipe.send(("refused", number, ""))
        except BaseException:
            pipe.send(("failed", number, traceback.format_exc()))


def fuzz(seconds: float, seed: int, path: Path) -> collections.Counter[str]:
    """Run cases for a while, each written to `path`. Returns how many had which outcome."""
    counts: collections.Counter[str] = collections.Counter()
    end, number = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        pipe, other = multiprocessing.Pipe(duplex=False)
        worker = multiprocessing.Process(target=work, args=(other, path, seed, number), daemon=True)
        worker.start()
        other.close()
        outcome, complaint = "begin", ""
        while time.monotonic() < end or outcome == "begin":
            try:
                outcome, number, complaint = pipe.recv() if pipe.poll(CASE_SECONDS) else ("hung", number, "more than 10 s\n")
            except EOFError:
                outcome, complaint = "died", "the process ended\n"
            counts[outcome] += 1
            if outcome in ("failed", "hung", "died"):
                save(seed, number, f"{outcome}: {complaint}")
            if outcome in ("hung", "died"):
                break
        worker.kill()
        worker.join()
        number += 1
    return counts


def save(seed: int, number: int, text: str) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{seed}-{number}.glb").write_bytes(case(seed, number))
    (FOLDER / f"{seed}-{number}.txt").write_text(text)
    print(f"seed {seed} case {number}: {text.strip().splitlines()[-1]}", file=sys.stderr, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(1 << 32))
    options = parser.parse_args()
    print(f"seed {options.seed}, {options.seconds:g} s", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        counts = fuzz(options.seconds, options.seed, Path(folder) / "case.glb")
    failures = counts["failed"] + counts["hung"] + counts["died"]
    print(f"{counts['loaded'] + counts['refused'] + failures} cases: {counts['loaded']} loaded, {counts['refused']} refused, "
          f"{counts['failed']} failed, {counts['hung']} hung, {counts['died']} died; failures are in {FOLDER}")
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
