"""What nothing joins to the rest becomes a run inside the run: mapped, exported, shown, repaired with it."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner

import msgs_slam
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.evaluation.report import write_report
from msgs_slam.pipelines.evaluation.serve import PageServer
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from tests.pipelines.frames.conftest import WALK_FRAMES, render, sideways, turn, write_walk

APART, TURNS = 9, 4
FIRST_APART = WALK_FRAMES + TURNS
SETTINGS = (
    "run.threads=1", "run.device=cpu", "frames.max_features=500", "frames.overlap=5",
    "proxy.stereo_side=96", "proxy.depth=multiview",
    "proxy.semantics=segments", "mapping.passes=1", "mapping.min_iterations=10", "mapping.max_side=96",
    "mapping.max_gaussians=4000", "export.voxel=0.05", "export.scale=free",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def small_pieces() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("msgs_slam.pipelines.sfm.driver.LEAST_PIECE", 5)
        patch.setattr("msgs_slam.pipelines.tracking.stage.LEAST_PIECE", 5)
        yield


def invoke(*arguments: object) -> str:
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def digests(folder: Path) -> dict[str, str]:
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A walk that ends turning on the spot, cut to the walk through the mirrored room, of which no picture fits the
    others."""
    folder = tmp_path_factory.mktemp("pieces")
    walk = [*sideways(WALK_FRAMES)]
    center, rotation = walk[-1]
    away = [(center, turn(0.45 * i) @ rotation) for i in range(1, TURNS + 1)]
    write_walk(folder / "pictures", iter([*walk, *away]))
    for i, (center, rotation) in enumerate(sideways(APART)):
        mirrored = np.ascontiguousarray(render(center, rotation)[:, ::-1])
        write_rgb(folder / "pictures" / f"view_{FIRST_APART + i:03d}.png", mirrored)
    settings = [x for s in SETTINGS for x in ("--set", s)]
    invoke("reconstruct", folder / "pictures", "--out", folder / "both.msgs", *settings, "-q")
    return RunFolder(folder / "both.msgs")


def test_a_piece_has_all_that_a_run_has(whole: RunFolder) -> None:
    outcome = load_outcome(whole)
    (piece,) = outcome.pieces()
    assert [f.name for f in piece.frames] == [f"view_{FIRST_APART + i:03d}.png" for i in range(APART)]
    assert len(piece.require_map()) > 500
    assert (
        whole.load(TRAJECTORY, "tracking").lost_reasons[FIRST_APART + 3]
        == "in piece_2, which is not connected to the rest"
    )
    centres, truth = piece.trajectory.centers, np.array([c for c, _ in sideways(APART)]) * [-1, 1, 1]
    apart = align_points(centres, truth, with_scale=True).apply(centres) - truth
    assert 0 < np.linalg.norm(apart, axis=1).max() < 0.05
    exported = whole.stage("export") / "piece_2"
    assert pycolmap.Reconstruction(exported / "sparse" / "0").num_reg_images() == APART
    assert len(read_mesh_ply(exported / "mesh.ply").faces) > 100
    assert (exported / "point_cloud.ply").read_bytes() == piece.run.file("export", "point_cloud.ply").read_bytes()


def test_everything_names_one_number_of_posed_images(whole: RunFolder, tmp_path: Path) -> None:
    """Frames of the turn that see nothing of the walk are no poses, anywhere."""
    posed = int(load_outcome(whole).trajectory.is_posed.sum())
    assert WALK_FRAMES <= posed < FIRST_APART
    stages = {s["name"]: s["record"]["figures"] for s in json.loads(invoke("status", "--json", whole.root))["stages"]}
    exported = whole.stage("export")
    lines = [line for line in (exported / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    assert {
        stages["tracking"]["posed"], stages["export"]["images"], len(lines), len([*(exported / "images").iterdir()]),
        pycolmap.Reconstruction(exported / "sparse" / "0").num_reg_images(),
        len(json.loads((exported / "transforms.json").read_text())["frames"]),
        len(msgs_slam.open_run(whole.root).world_from_cam),
    } == {posed}  # fmt: skip
    report = write_report(whole, tmp_path / "report.html").read_text()
    assert f"{posed} / {FIRST_APART + APART}" in report


def test_report_view_and_status_show_it(whole: RunFolder, tmp_path: Path) -> None:
    html = write_report(whole, tmp_path / "report.html").read_text()
    assert "Apart from the rest: piece 2" in html
    assert f"frames {FIRST_APART}–{FIRST_APART + APART - 1}" in html
    with PageServer(whole) as server:
        assert list(server.parts()) == ["map", "piece_2"]
        pages = [server.page(part) for part in server.parts()]
    assert all("<canvas" in page for page in pages)
    assert len(set(pages)) == 2
    assert "piece_2" in invoke("status", whole.root)


def test_damage_inside_a_piece_is_named_and_mended_to_the_same_bytes(whole: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(Path(shutil.copytree(whole.root, tmp_path / "both.msgs")))
    before = digests(copy.root / "piece_2" / "mapping"), digests(copy.stage("export"))
    path = copy.root / "piece_2" / "mapping" / "map.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    shutil.copytree(copy.root / "piece_2", copy.root / "piece_3")  # of an earlier state of the run
    (copy.root / "piece_4").mkdir()
    (copy.root / "piece_4" / "notes.txt").write_text("mine")
    assert "piece_2/mapping/map.safetensors" in invoke("status", copy.root)
    refused = CliRunner().invoke(main, ["resume", str(copy.root / "piece_2")])
    assert refused.exit_code == 1
    assert "is a piece of" in refused.output
    invoke("resume", copy.root, "-q")
    assert (digests(copy.root / "piece_2" / "mapping"), digests(copy.stage("export"))) == before
    assert copy.damaged("export") == []
    assert not (copy.root / "piece_3").exists()
    assert (copy.root / "piece_4" / "notes.txt").read_text() == "mine"
