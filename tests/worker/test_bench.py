"""The benches: on a small clip every row is there, with figures that can be true; light on maps with a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.gl import Context
from server.bench.light_reference import analytic_maps
from server.bench.light_tables import Pipelines, irradiance_errors
from server.bench.stages import bench, table

STAGES = ("upload", "radiance_map", "lights", "irradiance", "objects_and_composite", "write")


def test_bench_reports_every_stage_of_a_frame() -> None:
    report = bench(8, width=512, fps=10)
    rows = report["scenes"]["demo"]
    for name in ("decode", "render", "read light", "prepare light", "encode", *(f"  {stage}" for stage in STAGES)):
        assert 0.0 < rows[name]["wall_ms"]["p50"] <= rows[name]["wall_ms"]["p95"] <= rows[name]["wall_ms"]["max"], name
    stages = sum(rows[f"  {stage}"]["wall_ms"]["p50"] for stage in STAGES)
    assert stages < 1.5 * sum(rows[row]["wall_ms"]["p95"] for row in ("render", "read light", "prepare light"))
    assert "  objects_and_composite" not in report["scenes"]["empty"]
    assert all(name.strip() in table(report) for name in rows)


@pytest.mark.parametrize(("name", "radiance"), list(analytic_maps()), ids=lambda value: value if isinstance(value, str) else "")
def test_irradiance_of_analytic_maps(name: str, radiance: np.ndarray) -> None:
    context = Context()
    pipelines = Pipelines(context)
    _, errors = irradiance_errors(pipelines, radiance)
    pipelines.release()
    context.release()
    assert np.sqrt((errors**2).mean()) < (1e-4 if name == "constant" else 0.006)
    assert np.abs(errors).max() < 0.012
