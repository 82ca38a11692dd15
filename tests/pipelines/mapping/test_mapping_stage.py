"""The stages mapping and export on a run folder, their files opened by other programs."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config, ExportConfig, MappingConfig, RunConfig
from msgs_slam.pipelines.export import stage as export_stage
from msgs_slam.pipelines.export.volume import Grid
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.mapping import growth
from msgs_slam.pipelines.mapping import stage as mapping_stage
from msgs_slam.pipelines.mapping.views import load_views
from msgs_slam.pipelines.run.files import CLASSES, EXPOSURE, MAP, SPARSE, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.scene.world import WORLD
from msgs_slam.pipelines.system.machine import room_on
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID
from tests.pipelines.mapping.small_run import make_run
from tests.pipelines.travelling import Travelling

CONFIG = Config(
    run=RunConfig(device="cpu"),
    mapping=MappingConfig(passes=3.0, min_iterations=0, hold_out=8),
    export=ExportConfig(voxel=0.02),
)


@pytest.fixture(scope="module", autouse=True)
def densely_seeded() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growth, "SEED_STRIDE", 1)
        yield


def context(run: RunFolder, stage: str, config: Config = CONFIG) -> StageContext:
    folder = run.stage(stage)
    folder.mkdir(exist_ok=True)
    return StageContext(run, run.root, config, folder, SilentProgress())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, world_sequence: Path) -> tuple[RunFolder, dict, dict]:
    run = make_run(tmp_path_factory.mktemp("finished") / "run", world_sequence)
    mapped = mapping_stage.run(context(run, "mapping"))
    note_finished(run, ("frames", "proxy", "tracking", "mapping"), CONFIG)
    exported = export_stage.run(context(run, "export"))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"), CONFIG)
    return run, mapped, exported


def test_mapping_says_how_good_it_is(finished: tuple[RunFolder, dict, dict]) -> None:
    run, figures, _ = finished
    assert 22 < figures["held_out_psnr"] < figures["keyframe_psnr"] < 60
    assert figures["gaussians"] == len(run.load(MAP, "mapping"))
    assert figures["keyframes"] == 14
    stored = json.loads((run.stage("mapping") / "mapping.json").read_text())
    assert len(stored["class_ids"]) == figures["classes"] == run.load(MAP, "mapping").class_logits.shape[1]
    before, after = run.load(TRAJECTORY, "tracking"), run.load(TRAJECTORY, "mapping")
    assert 0 < np.abs(before.cam_from_world - after.cam_from_world).max() < 0.02
    exposure = run.load(EXPOSURE)
    assert exposure["log_gains"].shape == (14, 3)


def test_workers_leave_the_same_export(
    finished: tuple[RunFolder, dict, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Grid.regions, "__defaults__", (100,))  # blocks of a region
    workers, made = Travelling(2), []
    for name, by in (("whole", None), ("divided", workers)):
        (tmp_path / name).mkdir()
        alike = replace(context(finished[0], "export"), folder=tmp_path / name, workers=by)
        figures = export_stage.run(alike)
        files = {p.name: p.read_bytes() for p in sorted(alike.folder.iterdir()) if p.is_file()}
        made.append((figures, files))
    assert made[0] == made[1]
    assert workers.done["fuse_views"] > 1, "several regions"
    assert workers.done == {"draw_keyframes": 6, "snap_views": 6, "fuse_views": workers.done["fuse_views"]}


def exported_from_run(run: RunFolder) -> Similarity:
    return WORLD.read(run.stage("export") / "world.json").exported_from_run


def test_the_mesh_is_the_room(finished: tuple[RunFolder, dict, dict]) -> None:
    run, _, figures = finished
    mesh = trimesh.load(run.stage("export") / "mesh.ply", process=False)
    assert len(mesh.vertices) == figures["vertices"] > 1000
    labels = mesh.metadata["_ply_raw"]["vertex"]["data"]["label"]
    assert set(np.unique(labels)) <= {*range(len(run.load(CLASSES))), VOID}
    assert (labels != VOID).mean() > 0.9
    glb = trimesh.load(run.stage("export") / "mesh.glb", force="mesh")
    assert 1000 < len(glb.faces) < len(mesh.faces)  # flat places need few under a texture
    assert np.sort(glb.extents) == pytest.approx(np.sort(mesh.extents), rel=0.05)
    # Every triangulated point is exact and lies on a surface that two keyframes see.
    points = exported_from_run(run).apply(run.load(SPARSE, "tracking").points_in_world[::9])
    distance = np.linalg.norm(points[:, None] - np.asarray(mesh.vertices)[None], axis=2).min(1)
    assert 0 < np.median(distance) < 0.06


def test_a_finished_mesh_is_not_made_again(finished: tuple[RunFolder, dict, dict]) -> None:
    run, _, figures = finished
    before = (run.stage("export") / "mesh.ply").stat().st_mtime_ns
    assert export_stage.run(context(run, "export")) == figures
    assert (run.stage("export") / "mesh.ply").stat().st_mtime_ns == before


def test_no_keyframe_left_is_refused(small_run: RunFolder, tmp_path: Path) -> None:
    config = Config(run=RunConfig(device="cpu"), mapping=MappingConfig(hold_out=1))
    given = StageContext(small_run, small_run.root, config, tmp_path, SilentProgress())
    with pytest.raises(InputError, match="hold_out"):
        mapping_stage.run(given)


def test_views_on_a_card_are_planned_by_its_own_memory(small_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with more memory than its card has would fill the card."""
    monkeypatch.setattr("torch.cuda.mem_get_info", lambda: (1000, 8_000_000_000))
    assert room_on("cuda", 64e9) == room_on(torch.device("cuda:0"), 64e9) == 1000
    assert room_on("cpu", 64e9) == 64e9
    monkeypatch.setattr("msgs_slam.pipelines.mapping.views.room_on", lambda device, host: room_on("cuda", host))
    views = load_views(small_run, small_run.load(TRAJECTORY, "tracking"), MappingConfig(), memory=64e9).views
    first = views[0]
    assert views[1] is not first
    assert views[0] is not first  # read again: a thousand bytes hold no two of them
    assert torch.equal(views[0].image, first.image)
