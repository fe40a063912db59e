"""The rows of `mr360 bench`: each stage has all of its own, with figures that can be true, and to do nothing is worse."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.scene import PRESETS, STAGES, Lighting
from server.bench import report
from server.bench.effort import FULL, QUICK, Effort
from server.bench.light_reference import analytic_maps
from server.bench.light_tables import irradiance_errors
from server.bench.machine import machine_record
from server.bench.needs import Need, needs, needs_table
from server.bench.pipelines import Pipelines
from server.bench.plot import front, write_plot
from server.bench.presets import compared, preset_table, world_of
from server.bench.report import Report, table
from server.bench.rows import Row, pooled
from server.bench.stages import frame_path, frame_path_table
from server.bench.whole_rows import variants
from server.bench.worlds import worlds
from server.worker.images import write_still

TINY = Effort("tiny", (512, 256), (256, 128), 6, 3, ("sun",), ("sun",), (0.5,), 120, 40, 24, 32, (512, 10), 8)
KEYS = {"stage", "method", "params", "scene", "mark", "ms_p50", "ms_p95", "timed", "err_rms", "err_p99", "err_max", "bias"}
STEPS = ("upload", "radiance_map", "lights", "irradiance", "objects_and_composite", "write")


@pytest.fixture(scope="module")
def pipelines() -> Iterator[Pipelines]:
    context = Context()
    kept = Pipelines(context)
    yield kept
    kept.release()
    context.release()


@pytest.fixture(scope="module")
def measured(pipelines: Pipelines) -> Report:
    """All rows, in miniature."""
    found = Report(machine_record(pipelines.context), TINY)
    for _, _, rows in report.STAGES:
        found.rows += list(rows(pipelines, TINY))
    return found


def rows_of(measured: Report, stage: str) -> list[Row]:
    return pooled(row for row in measured.rows if row.stage == stage)


@pytest.mark.parametrize("stage", [stage for stage, _, _ in report.STAGES])
def test_every_stage_has_complete_rows(measured: Report, stage: str) -> None:
    rows = rows_of(measured, stage)
    assert {row.mark for row in rows} >= {"default", "paper"}
    for row in rows:
        figures = row.as_json()
        assert figures.keys() >= KEYS
        assert 0 <= figures["err_rms"] <= figures["err_max"], row.name
        assert figures["err_p99"] <= figures["err_max"]
        if figures["timed"]:
            assert 0 < figures["ms_p50"] <= figures["ms_p95"]
    lines = "\n".join(table(stage, "what is measured", rows))
    assert all(row.name in lines for row in rows)


@pytest.mark.parametrize("stage", [stage for stage, _, _ in report.STAGES if stage != "ablation"])
def test_to_do_nothing_is_worse(measured: Report, stage: str) -> None:
    """Than each of a preset's methods, under the same conditions."""
    rows = rows_of(measured, stage)
    nothing = {row.condition: row.err_rms for row in rows if row.mark == "null"}
    assert nothing.keys() == {row.condition for row in rows}
    assert all(row.err_rms < nothing[row.condition] for row in rows if row.mark == "default")


def test_the_lights_of_a_known_sun_are_found(measured: Report) -> None:
    ours = next(row for row in rows_of(measured, "lights") if row.mark == "default")
    assert ours.extra["direction_deg"] is not None
    assert ours.extra["direction_deg"] < 0.25
    assert ours.extra["missed"] == ours.extra["false"] == 0
    assert ours.err_rms < 0.01


def test_the_shares_of_the_stages_add_up_to_the_whole(measured: Report) -> None:
    """Errors of different stages are hardly correlated: their squares add up to that of the picture in which all of them are."""
    for preset in PRESETS:
        rows = {row.method: row for row in rows_of(measured, "ablation") if row.params == preset}
        stages = [row for row in rows.values() if row.extra["share"] is not None]
        assert len(stages) == len(STAGES)
        assert sum(row.extra["share"] for row in stages) == pytest.approx(1.0)
        root = np.sqrt(sum(row.err_rms**2 for row in stages))
        assert root == pytest.approx(rows["all"].err_rms, rel=0.35)
    whole = {row.name: row for row in rows_of(measured, "whole")}
    assert whole["default radiance"].err_rms < whole["paper radiance"].err_rms


def test_preset_paper_is_the_papers_methods_and_nothing_else() -> None:
    chosen = {stage: Lighting(preset="paper").method(stage) for stage in STAGES}
    assert chosen == {"diffuse": "map32x16", "glossy": "rings36", "lights": "threshold", "shadows": "pcf", "composite": "additive"}
    for stage in STAGES:
        lighting, _ = variants()[f"default, {stage} {PRESETS['paper'][stage]}"]
        assert {other: lighting.method(other) for other in STAGES} == {**PRESETS["default"], stage: PRESETS["paper"][stage]}


def test_full_runs_time_at_least_200_frames() -> None:
    assert FULL.frames >= 200
    assert FULL.repeats >= 200
    assert FULL.per_world * len(FULL.worlds) >= 200
    assert QUICK.frames < FULL.frames
    assert FULL.frames // len(FULL.whole_worlds) * len(FULL.whole_worlds) >= 200


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_a_plot_is_written(measured: Report, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plot{suffix}"
    write_plot(path, measured.rows, "a title")
    head = path.read_bytes()[:200]
    assert head.startswith(b"\x89PNG") if suffix == ".png" else b"<svg" in path.read_bytes()[:2000]


def test_a_front_is_what_nothing_beats() -> None:
    assert front([(2, 5), (1, 9), (3, 7), (4, 1), (5, 1)]) == [(1, 9), (2, 5), (4, 1)]


def test_each_scene_leaves_out_what_it_does_not_need(pipelines: Pipelines) -> None:
    found: list[Need] = list(needs(pipelines, TINY))
    usual, still, overcast, diffuse, nothing = found
    assert usual.as_json()["skipped"] == []
    assert {"glossy", "shadows", "objects_and_composite", "write"} <= set(nothing.as_json()["skipped"])
    for one in (still, overcast, diffuse):
        assert one.stages_ms()["shadows"] < 0.7 * usual.stages_ms()["shadows"]      # type: ignore[operator]
    assert nothing.touched == 0 < diffuse.touched < usual.touched
    text = "\n".join(needs_table(found))
    assert all(need.name in text for need in found)


def test_the_frame_path_has_every_stage_of_a_frame(pipelines: Pipelines) -> None:
    found = frame_path(pipelines.context, 8, 512, 10)
    rows = found["scenes"]["demo"]
    for name in ("decode", "render", "read light", "prepare light", "encode", *(f"  {step}" for step in STEPS)):
        assert 0.0 < rows[name]["wall_ms"]["p50"] <= rows[name]["wall_ms"]["p95"] <= rows[name]["wall_ms"]["max"], name
    stages = sum(rows[f"  {step}"]["wall_ms"]["p50"] for step in STEPS)
    assert stages < 1.5 * sum(rows[row]["wall_ms"]["p95"] for row in ("render", "read light", "prepare light"))
    assert "  objects_and_composite" not in found["scenes"]["empty"]
    text = "\n".join(frame_path_table(found))
    assert all(name.strip() in text for name in rows)


def test_both_presets_on_a_folder_of_maps(pipelines: Pipelines, tmp_path: Path) -> None:
    world = worlds((256, 128), ("sun",))[0]
    write_still(tmp_path / "sun.exr", RadianceFrame(world.radiance))
    lines = list(preset_table(pipelines, tmp_path, 3, pixels=16, texels=32))
    assert lines[3].startswith("sun.exr")
    assert lines[-1].endswith("of 1 maps")
    outcomes = compared(pipelines, world_of("sun", world.radiance), 3, pixels=16, texels=32)
    assert outcomes["default"].irradiance < outcomes["paper"].irradiance
    assert outcomes["default"].picture < outcomes["paper"].picture < 0.5


@pytest.mark.parametrize(("name", "radiance"), list(analytic_maps()), ids=lambda value: value if isinstance(value, str) else "")
def test_irradiance_of_analytic_maps(pipelines: Pipelines, name: str, radiance: np.ndarray) -> None:
    _, errors = irradiance_errors(pipelines, radiance)
    assert np.sqrt((errors**2).mean()) < (1e-4 if name == "constant" else 0.006)
    assert np.abs(errors).max() < 0.012
