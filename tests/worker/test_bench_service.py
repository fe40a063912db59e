"""The whole-service benchmark on a small picture: real processes, complete figures, nothing left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from renderer.models.gltf import load
from server.bench import service, service_soak, service_transcode
from server.bench.service_processes import OtherWork, ProcessGoneError, ThreadClock, child_of, memory_of
from server.bench.service_run import Period, measure_transcode
from server.bench.service_scaling import Scaling, lamp_frames
from server.bench.service_scene import KNOT, five_objects, knot_glb, objects_around, triangles_of
from server.bench.service_tables import scaling_lines, service_lines
from server.demo.clip import demo_clip
from server.demo.watch import StopError
from server.worker import __main__ as worker_main
from server.worker import heartbeat, render_loop

WIDTH, FPS = 256, 10
SPIN = "import threading, time\nthreading.Thread(target=lambda: [0 for _ in iter(int, 1)], daemon=True).start()\ntime.sleep(60)"


@pytest.fixture(scope="module")
def small_clips() -> Path:
    demo_clip(WIDTH, FPS)
    return demo_clip(WIDTH, FPS, still=True)


@pytest.mark.parametrize("wanted", [500, 6_000, 70_000])
def test_the_knot_has_the_triangles_it_says(wanted: int, tmp_path: Path) -> None:
    model, count = knot_glb(wanted)
    assert count == pytest.approx(wanted, rel=0.04)
    (tmp_path / "knot.glb").write_bytes(model)
    mesh = load(tmp_path / "knot.glb")
    assert mesh.triangle_count == count
    positions, normals, triangles = mesh.primitives[0].positions, mesh.primitives[0].normals, mesh.primitives[0].triangles
    assert np.ptp(positions[:, 1]) == pytest.approx(1.0, abs=1e-3)
    a, b, c = (positions[triangles[:, corner]] for corner in range(3))
    facing = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", facing, normals[triangles[:, 0]]) > 0).all(), "a triangle shows its back"


def test_a_mesh_out_of_range_is_named() -> None:
    with pytest.raises(ValueError, match="triangles is 3, expected 500 to 500000"):
        knot_glb(3)


def test_scenes_have_as_many_objects_as_they_say() -> None:
    assert [len(objects_around(count)["objects"]) for count in (1, 5, 50)] == [1, 5, 50]
    meshes = [placed["mesh"] for placed in five_objects()["objects"]]
    assert sorted(meshes) == sorted(["teapot", f"asset:{KNOT}", "box", "cylinder", "sphere"])
    assert triangles_of(objects_around(2), {"teapot": 100}) == 112     # and a box


def test_lamps_are_clipped_and_as_many_as_wanted() -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    for count in (1, 4, 8):
        frame = lamp_frames((512, 256), count)[0]
        assert ndimage.label(frame.y == 235)[1] == count


def test_the_transcode_has_the_timing_of_a_worker() -> None:
    assert (service_transcode.SWITCH_INTERVAL_S, service_transcode.BURST_S, service_transcode.HEARTBEAT_S) == (
        worker_main.SWITCH_INTERVAL_S, render_loop.BURST_S, heartbeat.HEARTBEAT_S)


def test_processes_are_seen_from_outside() -> None:
    child = subprocess.Popen([sys.executable, "-c", SPIN])
    try:
        assert child_of(os.getpid(), SPIN) == child.pid
        time.sleep(0.5)
        memory = memory_of(child.pid)
        assert 1.0 < memory.now_mb <= memory.peak_mb
        threads, with_child, without = ThreadClock(child.pid), OtherWork([]), OtherWork([child.pid])
        started, used = time.monotonic(), threads.cores()
        while sum(used.values()) * (time.monotonic() - started) < 0.5:
            assert time.monotonic() < started + 60
            time.sleep(0.2)
            used = threads.cores()
        assert used["main"] < 0.5 * sum(used.values()), "the work of another thread is taken for the main thread's"
        others = without.cores()
        assert with_child.cores() > others, "the child's work is counted among others' although it is not"
    finally:
        child.kill()
        child.wait()
    with pytest.raises(ProcessGoneError):
        memory_of(child.pid)
    with pytest.raises(ProcessGoneError):
        child_of(os.getpid(), SPIN)


def test_a_signal_ends_a_measurement(small_clips: Path, tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(StopError):
        measure_transcode(tmp_path, stop, small_clips, Period(1.0, 3.0))
    with pytest.raises(ProcessGoneError):
        child_of(os.getpid(), "server.bench.service_transcode")


@pytest.mark.usefixtures("leaves_nothing")
def test_the_service_beside_a_transcode(small_clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "report.json"
    assert service.main(["--sizes", f"{WIDTH}x{WIDTH // 2}", "--clips", "still", "--fps", str(FPS), "--seconds", "3",
                         "--warm-up", "1", "--only", "service", "--mesh-triangles", "2000", "--json", str(file)]) == 0
    run: dict[str, Any] = json.loads(file.read_text())["service"][0]
    shown = run["service"]
    assert shown["triangles"] == {KNOT: run["knot_triangles"]}
    assert 0 < shown["frames_out"] <= shown["frames_in"] + FPS      # both are up to half a second old
    assert 0 < shown["touched_fraction"] < 0.5, "the objects are not in the picture"
    assert {"main", "ingest", "full/h264 enc"} <= set(shown["threads_ms_per_frame"])
    assert all(value > 0 for value in shown["peak_mb"].values())
    assert set(shown["cpu_ms_per_frame"]) == {"worker", "server", "publisher", "viewer"}
    for transcode in run["transcodes"]:
        assert transcode["frames_out"] > 0
        assert transcode["frames_out"] + transcode["frames_dropped"] == pytest.approx(transcode["frames_in"], abs=4)
        assert transcode["fps"] == pytest.approx(transcode["frames_out"] / transcode["seconds"], rel=0.02)
        assert {"main", "ingest", "full/h264 enc"} <= set(transcode["threads_ms_per_frame"])
        assert transcode["mbps"] > 0
    floors = [transcode["cost_ms"] for transcode in run["transcodes"]]
    assert run["ratio"]["worker"] == pytest.approx(shown["cost_ms"] / (sum(floors) / 2), rel=0.01)
    assert shown["cost_ms"] <= shown["cpu_ms_per_frame"]["worker"]
    assert run["ratio"]["worker_and_server"] > run["ratio"]["worker"] > 1.0
    printed = capsys.readouterr().out
    assert all(line in printed for line in service_lines(run))


@pytest.mark.usefixtures("leaves_nothing")
def test_viewers_that_only_receive(small_clips: Path, tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    assert service.main(["--sizes", f"{WIDTH}x{WIDTH // 2}", "--clips", "still", "--fps", str(FPS), "--seconds", "2",
                         "--warm-up", "1", "--only", "viewers", "--viewers", "2", "--mesh-triangles", "2000",
                         "--json", str(file)]) == 0
    run = json.loads(file.read_text())["viewers"][0]
    assert run["service"]["viewers"] == 2
    assert run["slowest_fps"] > 0
    assert run["service"]["received"]["bytes"] > run["service"]["received"]["slowest"] > 0
    assert run["mbps_each"] > 0


def test_scaling_has_every_condition(small_clips: Path, tmp_path: Path) -> None:
    scaling = Scaling(WIDTH, FPS, tmp_path, 4, 2, teapot_triangles=9120, stop=threading.Event())
    try:
        rows = {"objects": list(scaling.objects((1, 3))), "triangles": list(scaling.triangles((500,))),
                "lamps": list(scaling.lamps((2,)))}
    finally:
        scaling.release()
    assert [row["count"] for row in rows["objects"]] == [1, 3]
    assert rows["triangles"][0]["count"] == knot_glb(500)[1]
    assert rows["lamps"][0]["conditions"]["still"]["lights"] == 2
    for row in (row for table in rows.values() for row in table):
        for cell in row["conditions"].values():
            assert 0 < cell["render_ms"]["p50"] <= cell["render_ms"]["p95"]
            assert cell["light_ms"]["p50"] > 0
            assert cell["cpu_ms_per_frame"] > 0
    assert len(list(scaling_lines("title", "objects", rows["objects"]))) == 5


@pytest.mark.parametrize(("arguments", "expected"), [
    (["--sizes", "100x50"], "'100x50' given, expected WIDTHxHEIGHT"), (["--only", "x"], "'x' given, expected some of service"),
    (["--viewers", "0"], "'0' given, expected whole numbers"), (["--seconds", "x"], "'x' given, expected a number of seconds"),
    (["--json", "/no/folder/x"], "'/no/folder/x' given"), (["--clips", ""], "'' given, expected some of still,sun"),
])
def test_bad_arguments_are_status_2_and_one_line(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        service.main(arguments)
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert expected in error


def test_values_that_nothing_can_be_made_of_are_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert service.main(["--fps", "0"]) == 2
    assert service.main(["--quick", "--fps", "1", "--sizes", "256x128", "--mesh-triangles", "3"]) == 2
    assert capsys.readouterr().err.splitlines() == ["bench-service: fps is 0, expected 1 to 120",
                                                    "bench-service: triangles is 3, expected 500 to 500000"]


def test_flat_memory_is_told_from_growing() -> None:
    seconds = [60.0 + 10 * index for index in range(60)]
    wave = [500 + 20 * (index % 6) for index in range(60)]
    assert service_soak.trend(seconds, [float(value) for value in wave]).is_flat
    leak = service_soak.trend(seconds, [value + 2.5 * second / 60 for value, second in zip(wave, seconds, strict=True)])
    assert leak.mb_a_minute == pytest.approx(2.5, abs=0.01)
    assert not leak.is_flat
    step = service_soak.trend(seconds, [500.0 if second < 120 else 540.0 for second in seconds])
    assert not step.is_flat, "it never comes back to what it was"
    falling = service_soak.trend(seconds, [600 - second / 60 for second in seconds])
    assert falling.is_flat


def children() -> set[tuple[int, str]]:
    """Processes of the service that this one has started: of this test, or of another in the same session."""
    found = set()
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == os.getpid():
                found.add((int(folder.name), (folder / "cmdline").read_text()))
        except OSError:
            continue
    return {(pid, command) for pid, command in found if "server." in command}


@pytest.fixture
def leaves_nothing() -> Iterator[None]:
    before = children()
    yield
    assert children() <= before
