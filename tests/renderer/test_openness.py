"""How much of the light around a mesh keeps from its own surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from renderer.gl import Context
from renderer.models.gpu_mesh import GpuMesh
from renderer.models.mesh import BUILT_IN, Mesh, Surface
from renderer.models.openness import OpennessStage
from renderer.objects.surfaces import SurfaceStage


@pytest.fixture
def stages(context: Context) -> Iterator[tuple[SurfaceStage, OpennessStage]]:
    surfaces = SurfaceStage(context)
    openness = OpennessStage(context, surfaces)
    yield surfaces, openness
    openness.release()
    surfaces.release()


def bowl(*, double_sided: bool) -> Mesh:
    """The lower half of a sphere."""
    whole = BUILT_IN["sphere"]().primitives[0]
    lower = whole.triangles[(whole.positions[whole.triangles][..., 1] < 1e-6).all(axis=1)]
    used, triangles = np.unique(lower, return_inverse=True)
    return Mesh((replace(whole, positions=whole.positions[used], normals=whole.normals[used], uvs=whole.uvs[used],
                         triangles=triangles.reshape(-1, 3).astype(lower.dtype), surface=Surface(double_sided=double_sided)),))


def openness_of(context: Context, stages: tuple[SurfaceStage, OpennessStage], mesh: Mesh) -> np.ndarray:
    uploaded = GpuMesh(context, stages[0].programs, mesh)
    stages[1].bake(uploaded)
    values = uploaded.parts[0].openness.copy()
    uploaded.release()
    return values


def test_a_bowl_is_half_open_inside_and_open_outside(context: Context, stages: tuple[SurfaceStage, OpennessStage]) -> None:
    """From any place on a sphere's inside a part of it fills as much of the view, cosine-weighted, as of its area."""
    mesh = bowl(double_sided=True)
    deep = mesh.primitives[0].positions[:, 1] < -0.1        # the rim's own edge is neither inside nor outside
    front, back = openness_of(context, stages, mesh)[deep].T
    assert front == pytest.approx(np.ones_like(front), abs=0.02)
    assert back.mean() == pytest.approx(0.5, abs=0.03)
    assert np.abs(back - 0.5).max() < 0.12


def test_a_side_that_nobody_sees_is_not_measured(context: Context, stages: tuple[SurfaceStage, OpennessStage]) -> None:
    assert (openness_of(context, stages, bowl(double_sided=False))[:, 1] == 1.0).all()
