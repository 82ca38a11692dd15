"""The exported files of a run, read by other programs' libraries."""

import inspect
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pycolmap
import pytest
import trimesh
from click.testing import CliRunner
from evo.tools import file_interface
from finished import note_finished
from scipy.spatial import cKDTree

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export import texture as textured
from msgs_slam.pipelines.export.inventory import THINGS
from msgs_slam.pipelines.export.kinds import EXPORTS, NOTES, Export, export_of, kinds_help
from msgs_slam.pipelines.export.scene import ExportScene, find_world
from msgs_slam.pipelines.export.stage import export_folder, export_run, licences
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.files import FRAMES, LEFT_OUT, METRES, PROXY_MAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.run.target import LIST, Target
from msgs_slam.pipelines.scene.world import WORLD
from msgs_slam.pipelines.types import Metres
from tests.splat_readers import read_gaussian_glb, read_spz

OracleRun = Callable[..., RunFolder]
Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
SETTINGS = ExportConfig(voxel=0.03)


@pytest.fixture(scope="module")
def run(oracle_run: OracleRun) -> RunFolder:
    return oracle_run(video=True)


@pytest.fixture(scope="module")
def folder(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textured, "TEXTURE_SIDE", 512)
        paths = export_run(run, folder, settings=SETTINGS)
    paths += [path for kind in ("spz", "glb") for path in export_run(run, folder, kind, settings=SETTINGS)]
    assert all(p.exists() for p in paths)
    return folder


@pytest.fixture(scope="module")
def exported(run: RunFolder, folder: Path) -> Outcome:
    """What the run ended with, in the world of the files."""
    world = WORLD.read(folder / "world.json")
    assert world.axes == "up"
    return load_outcome(run).moved(world.exported_from_run)


def test_poses_are_the_same_everywhere(run: RunFolder, folder: Path, exported: Outcome) -> None:
    t = exported.trajectory
    turned = t.moved(Similarity(1.0, Y_DOWN, np.zeros(3)).apply_to_poses)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    names = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    assert len(names) == len(t.frame_ids)
    for frame, pose in zip(run.load(FRAMES), turned.cam_from_world, strict=True):
        np.testing.assert_allclose(names[frame.name], pose[:3], atol=1e-9)
        given, kept = folder / "images" / frame.name, run.stage("frames") / frame.name
        assert given.read_bytes() == kept.read_bytes()
        assert not given.samefile(kept)  # who edits the one leaves the other as it was
    tum = file_interface.read_tum_trajectory_file(str(folder / "trajectory.txt"))
    np.testing.assert_allclose(tum.timestamps, t.timestamps, atol=1e-6)
    np.testing.assert_allclose(tum.positions_xyz, t.centers, atol=1e-6)
    nerfstudio = open_sequence(folder / "transforms.json")
    np.testing.assert_allclose(nerfstudio.world_from_cam, turned.world_from_cam, atol=1e-6)


def test_all_files_have_the_same_rights(folder: Path) -> None:
    files = [p for p in folder.rglob("*") if p.is_file()]
    assert len({p.stat().st_mode for p in files}) == 1
    assert {".ply", ".glb", ".json", ".txt"} <= {p.suffix for p in files}


def test_map_is_the_same_everywhere(folder: Path, exported: Outcome) -> None:
    m = exported.require_map()
    vertex = plyfile.PlyData.read(str(folder / "point_cloud.ply"))["vertex"]
    np.testing.assert_allclose(vertex["scale_0"], m.log_radii, atol=1e-6)
    np.testing.assert_allclose(vertex["opacity"], m.opacity_logits, atol=1e-6)
    np.testing.assert_allclose(vertex["y"], -m.means[:, 2], atol=1e-6)
    small = read_spz(folder / "point_cloud.spz")
    # The reader gives x right, y down, z forward.
    np.testing.assert_allclose(small.means[:, [0, 2]], m.means[:, :2], atol=1e-3)
    np.testing.assert_allclose(small.means[:, 1], -m.means[:, 2], atol=1e-3)
    np.testing.assert_allclose(read_gaussian_glb(folder / "point_cloud.glb").means, small.means, atol=1e-3)
    assert 0 < np.abs(small.log_scales[:, 0] - m.log_radii.numpy()).max() <= 1 / 32 + 1e-6
    assert (folder / "point_cloud.spz").stat().st_size < 0.2 * (folder / "point_cloud.ply").stat().st_size


def test_mesh_lies_on_the_map_and_stands_upright(folder: Path, exported: Outcome) -> None:
    mesh = trimesh.load(folder / "mesh.ply", force="mesh")
    means = exported.require_map().means.numpy()
    assert len(mesh.faces) > 1000
    extent = np.ptp(means, axis=0).max()
    low, high = means.min(axis=0) - 0.05 * extent, means.max(axis=0) + 0.05 * extent
    assert ((mesh.vertices > low) & (mesh.vertices < high)).all()
    # Of the surface within a hand's breadth of the lowest, most is the floor at 0; glTF's y is up.
    heights = mesh.vertices[:, 2]
    assert abs(np.median(heights[heights < np.quantile(heights, 0.02) + 0.1])) < 0.03
    glb = trimesh.load(folder / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(np.ptp(glb.vertices, axis=0), np.ptp(mesh.vertices, axis=0)[[0, 2, 1]], rtol=0.05)
    assert abs(glb.vertices[:, 1].max() - heights.max()) < 0.1


def test_texture_shows_the_photographs(run: RunFolder, folder: Path, exported: Outcome) -> None:
    mesh, whole = (trimesh.load(folder / n, force="mesh", process=False) for n in ("mesh.glb", "mesh.ply"))
    mesh.vertices = mesh.vertices[:, [0, 2, 1]] * (1, -1, 1)
    assert len(mesh.faces) <= 0.35 * len(whole.faces)  # a tenth, and what covers the many slits of small views
    colors = mesh.visual.to_color().vertex_colors[:, :3].astype(int)
    frame = exported.frames[0]
    pose, k = exported.trajectory.cam_from_world[0], exported.calibration.intrinsics
    xy, z = project(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], k)
    inside = (z > 0) & (xy > 0).all(1) & (xy < (k.width, k.height)).all(1)
    place = np.where(inside[:, None], xy, 0).astype(int)
    depth = cv2.resize(run.load(PROXY_MAPS, of=frame.id).depth, (k.width, k.height), interpolation=cv2.INTER_NEAREST)
    seen = inside & (np.abs(depth[place[:, 1], place[:, 0]] - z) < 0.02 * z)
    difference = np.abs(colors - run.image(frame)[place[:, 1], place[:, 0]])[seen].mean(axis=1)
    assert seen.sum() > 50
    assert 0 < np.median(difference) < 8


def test_one_kind_of_mesh_and_colours_without_a_texture(run: RunFolder, tmp_path: Path) -> None:
    few = replace(SETTINGS, texture=False)
    names = [path.name for path in export_run(run, tmp_path, "mesh", settings=few)]
    assert sorted(names) == ["README.txt", "mesh.glb", "mesh.ply", "things.json", "world.json"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([LIST, *names])
    glb, ply = (trimesh.load(tmp_path / n, force="mesh", process=False) for n in ("mesh.glb", "mesh.ply"))
    assert 0.9 * len(ply.faces) < len(glb.faces) < 1.2 * len(ply.faces)
    places = glb.vertices[:, [0, 2, 1]] * (1, -1, 1)
    away = cKDTree(ply.vertices).query(places)[0]
    assert (away < 1e-5).mean() > 0.7  # all but the rims and the patches
    assert np.quantile(away, 0.98) < 0.1
    light = replace(few, triangles=500)
    export_run(run, tmp_path / "light", "mesh", settings=light)
    glb = trimesh.load_scene(tmp_path / "light" / "mesh.glb", process=False)
    assert 300 < sum(len(part.faces) for part in glb.geometry.values()) <= 500
    names = load_outcome(run).classes.names
    things = {thing.name for thing in THINGS.read(tmp_path / "light" / "things.json")}
    assert things
    seen = {name for name in glb.geometry if not name.endswith(", hidden")}
    assert {"wall", "floor"} & set(names) <= seen <= {*names, *things, "unknown"}
    assert {name.removesuffix(", hidden") for name in set(glb.geometry) - seen} <= {*names, *things, "unknown"}


def test_one_kind_alone(run: RunFolder, tmp_path: Path) -> None:
    expected = {
        "colmap": "transforms.json", "ply": "point_cloud.ply", "spz": "point_cloud.spz", "sog": "point_cloud.sog",
        "glb": "point_cloud.glb", "html": "map.html", "tiles": "tiles/tileset.json", "tum": "trajectory.txt",
            "depth": "depth",
    }  # fmt: skip
    for only in [row.kind for row in EXPORTS if row.needs == "map" and row.kind != "mesh"]:
        export_run(run, tmp_path / only, only, settings=ExportConfig(axes="first"))
        assert (tmp_path / only / expected[only]).exists()
        notes = (tmp_path / only / "README.txt").read_text()
        assert expected[only] in notes
        assert "mesh.ply" not in notes


def test_a_mask_of_an_earlier_export_does_not_stay(run: RunFolder, tmp_path: Path) -> None:
    """Trainers read masks/ beside images/: one that the run has no longer would leave out what is there."""
    frame = run.load(FRAMES)[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "left_out", lambda self, frame: np.ones((4, 4), bool))
        export_run(run, tmp_path, "colmap")
    assert LEFT_OUT.path(tmp_path, frame.name).exists()
    export_run(run, tmp_path, "colmap")
    assert not (tmp_path / "masks").exists()


def test_licences_of_the_networks_are_in_the_notes() -> None:
    metres = Metres(3.7, 0.25, True, ("1 door", "the network fast-depth"))
    figures = [{"depth": "onnx:metric3d-small+multiview", "semantics": "tflite:ade20k-small", "frames": 3}, {}]
    said = licences(figures, metres)
    assert "metric3d-small: code BSD-2-Clause" in said
    assert "commercial use (ask before commercial use)" in said
    assert "ade20k-small: Apache-2.0\n" in said
    assert "fast-depth: " in said
    assert "dinov2" not in said
    assert licences([{"depth": "multiview", "semantics": "segments"}], None) == ""


def test_a_track_that_says_too_little_is_warned_of(
    run: RunFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Between two fixes any number of places can be interpolated, and an export elsewhere has no record to warn in."""
    (tmp_path / "track.csv").write_text("time,lat,lon\n0,50,10\n1,50.001,10\n")
    export_run(run, tmp_path / "out", "tum", settings=ExportConfig(gps=str(tmp_path / "track.csv")))
    assert "not georeferenced: only 2 of its fixes are of the time of the recording" in caplog.text
    assert WORLD.read(tmp_path / "out" / "world.json").earth is None


def test_a_home_folder_in_a_setting_is_found(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "t.csv").write_text("time,lat,lon\n0,50,10\n1,50.001,10\n")
    words = ["export", str(run.root), "--only", "tum", "--to", str(tmp_path / "out"), "--set", "export.gps=~/t.csv"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert "only 2 of its fixes" in result.output


def test_free_scale_holds_in_every_file(oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A guess of the metres is in no file of an export that leaves the unit open."""
    run = oracle_run(metric=False, mesh=True)
    world, _ = find_world(load_outcome(run), ExportConfig())
    WORLD.save(run.stage("export"), world)
    METRES.save(run.stage("export"), Metres(3.7, 0.25, True, ("1 door",)))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    seen = []
    monkeypatch.setattr(Export, "writer", lambda row: lambda scene, target: seen.append(scene.outcome))
    for row in EXPORTS:
        export_run(run, tmp_path / row.kind, row.kind, settings=ExportConfig(scale="free"))
    assert [(outcome.metres, outcome.move is not None) for outcome in seen] == [(None, True)] * len(EXPORTS)


def test_each_kind_is_one_row(tmp_path: Path) -> None:
    """Its writer takes a scene and a target; help, the page of files and refusals name it."""
    page = (Path(__file__).parents[3] / "docs" / "files.md").read_text(encoding="utf-8")
    for row in EXPORTS:
        request = "" if row.when == "always" else f"by `msgs-slam export RUN --only {row.kind}`: "
        assert all(f"| `{f.name}` | {request}{f.about} | {f.opens} |\n" in page for f in row.files)
    assert all(f"| `{f.name}` | {f.about} | {f.opens} |\n" in page for f in NOTES)
    said = CliRunner().invoke(main, ["export", "--help"]).output
    names = [name for row in EXPORTS for name in (row.kind, *row.also)]
    assert len(set(names)) == len(names)
    for row, line in zip(EXPORTS, kinds_help().splitlines(), strict=True):
        annotations = inspect.signature(row.writer()).parameters.values()
        assert [p.annotation for p in annotations] in ([ExportScene, Target], ["ExportScene", "Target"])
        assert " ".join(line.split()) in " ".join(said.split())
        assert all(hasattr(ExportConfig(), key) for key in row.settings)
    with pytest.raises(ValueError, match="'obj' is no kind of export: html, colmap"):
        export_of("obj")


def test_what_is_asked_for_has_a_folder_that_no_stage_touches(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run(video=True)
    folder = export_folder(run, "poses")
    assert folder == run.root / "exports" / "tum"
    assert folder / "trajectory.txt" in export_run(run, only="tum")
    (folder / "notes.txt").write_text("mine")
    (folder / "trajectory.txt").write_text("edited")
    with pytest.raises(InputError, match=r"holds trajectory\.txt, .*--overwrite"):
        export_run(run, only="tum")
    export_run(run, only="tum", overwrite=True)
    assert (folder / "notes.txt").read_text() == "mine"
    for own in (run.root, run.stage("export"), run.stage("export") / "more", run.stage("frames")):
        with pytest.raises(InputError, match="belongs to the run"):
            export_run(run, own, "tum")
    with locked(run):
        export_run(RunFolder(run.root), only="tum", settings=ExportConfig(axes="first"))


def test_other_settings_hold_for_what_is_asked_for_alone(oracle_run: OracleRun) -> None:
    """`export --set` without --to: the files of the run itself stay byte for byte, and its settings too."""
    run = oracle_run(video=True)
    export_run(run, only="tum")

    def contents() -> dict[Path, bytes]:
        files = [p for p in run.root.rglob("*") if p.is_file() and p.name != ".lock"]
        return {p: p.read_bytes() for p in files if not p.is_relative_to(run.root / "exports")}

    before, upright = contents(), (run.root / "exports" / "tum" / "trajectory.txt").read_bytes()
    done = CliRunner().invoke(main, ["export", str(run.root), "--only", "tum", "--set", "export.axes=first"])
    assert done.exit_code == 0, done.output
    assert str(run.root / "exports" / "tum" / "trajectory.txt") in done.output.replace("\n", "")
    assert json.loads((run.root / "exports" / "tum" / "world.json").read_text())["axes"] == "first"
    assert (run.root / "exports" / "tum" / "trajectory.txt").read_bytes() != upright
    assert contents() == before


def test_a_run_without_a_map_is_refused(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run()
    (run.stage("mapping") / "map.safetensors").unlink()
    with pytest.raises(InputError, match="msgs-slam resume"):
        export_run(run, tmp_path / "out", "ply")
    assert not (tmp_path / "out").exists()
