"""What the shading programs look up: a row for each surface of a view, and the objects that it may reflect as solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderer.light.specular import MIN_ROUGHNESS
from renderer.models.mesh import Surface
from renderer.models.shapes import KINDS
from renderer.objects.lobe_atlas import NOWHERE, LobeAtlas
from renderer.objects.near_field import FUNCTIONS, Fit
from renderer.shadows.light_visibility import Receiver

TABLE_WIDTH = 17       # texels a surface: three, the near field's as in near_field.glsl, the coat's two as in coat.glsl
MAX_SOLIDS = 12        # as in solids.glsl


def coat_roughness(surface: Surface) -> float:
    """Of a surface's clear coat, which shows no single things: no smoother than the sharpest prefiltered map."""
    return max(surface.clearcoat_roughness, MIN_ROUGHNESS)


def surface_rows(surfaces: list[tuple[Surface, int]], near: tuple[Fit, ...], lobes: LobeAtlas) -> NDArray[np.float32]:
    """(surfaces + 1, TABLE_WIDTH, 4) rows from row 1, for surfaces each with the index of its object."""
    rows = np.zeros((len(surfaces) + 1, TABLE_WIDTH, 4), dtype="f4")
    for row, (surface, index) in zip(rows[1:], surfaces, strict=True):
        row[0], row[1] = (*surface.base_color[:3], surface.metallic), (*surface.emissive, surface.roughness)
        row[2] = (*(lobes.cell(surface.roughness) or NOWHERE), index)
        row[4, 0] = row[7, 0] = row[10, 0] = 1.0        # what is near makes no difference
        if index < len(near):
            row[3] = (*near[index].centre, 1 / near[index].size)
            row[4:13].reshape(3, FUNCTIONS)[:] = near[index].coefficients.T
            row[13:15] = near[index].spheres
        coat = coat_roughness(surface)
        row[15, :2], row[16, :3] = (surface.clearcoat, coat), lobes.cell(coat) or NOWHERE
    return rows


def reflected_solids(receivers: tuple[Receiver, ...], members: tuple[int, ...], lobes: LobeAtlas) -> dict[str, object]:
    """Uniforms: the objects nearest to a view's members, which they may reflect."""
    if len(receivers) < 2:
        return {"solid_count": 0}
    centre = np.mean([receivers[index].body.solid.centre for index in members], axis=0)
    distance = [float(np.linalg.norm(item.body.solid.centre - centre)) for item in receivers]
    nearest = sorted(range(len(receivers)), key=distance.__getitem__)[:MAX_SOLIDS]
    matrices, colors, spheres = np.zeros((MAX_SOLIDS, 4, 4)), np.zeros((MAX_SOLIDS, 4)), np.zeros((MAX_SOLIDS, 4))
    kinds, cells = np.zeros((MAX_SOLIDS, 3)), np.zeros((MAX_SOLIDS, 3))
    for slot, index in enumerate(nearest):
        item = receivers[index]
        surface = item.placed.surfaces[0]
        matrices[slot] = item.body.solid.unit_from_world.T
        spheres[slot] = (*item.body.solid.centre, item.body.solid.radius)
        colors[slot] = (*item.body.color, index)
        cell = lobes.cell(surface.roughness)
        kinds[slot] = (KINDS.index(item.body.solid.kind), surface.metallic, cell is None)
        cells[slot] = cell or lobes.sharpest
    return {"solid_count": len(nearest), "unit_from_world": matrices, "solid_color": colors, "solid_kind": kinds,
            "solid_lobe": cells, "solid_sphere": spheres}
