"""The bench on a small clip: every row is there, with figures that can be true."""

from __future__ import annotations

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
