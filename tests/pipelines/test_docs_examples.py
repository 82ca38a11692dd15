"""The examples of the page on extending, at work where that page says they go."""

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats import datasets
from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.export.scene import ExportScene
from msgs_slam.pipelines.proxy import selection
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.run.target import Target
from msgs_slam.pipelines.scene.world import FIRST
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Frame
from tests.pipelines.proxy.proxy_room import UNIT, Room, perfect_backbone
from tests.world import ClipOptions, make_world, render_frame

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
OracleRun = Callable[..., RunFolder]


@pytest.fixture(autouse=True)
def _examples_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])


def test_depth_provider(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from points_depth import open_points

    options = ClipOptions(frames=110, width=160, height=120, laps=1.0)
    world = make_world(texel=0.02)
    views = [render_frame(world, options, i) for i in range(20, 23)]
    frames = [Frame(i, f"{i:06d}.png", i / 10, i, 1.0) for i in range(3)]
    calibration = Calibration(options.intrinsics, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    room = Room(views, frames, calibration, perfect_backbone(views, options.intrinsics))
    config = load_config(None, ["proxy.depth=points"]).proxy
    around = selection.ProviderContext(
        tmp_path, room.sequence(80), config, lambda n: tmp_path, 1, "cpu", SilentProgress()
    )
    with pytest.raises(InputError, match="multiview"):
        selection.open_depth(around)
    monkeypatch.setitem(selection.OWN_DEPTH, "points", open_points)
    provider = selection.open_depth(around)
    assert provider.missing(frames) == []
    found = provider.estimate(frames[1])
    assert found.depth.shape == (60, 80)
    known = found.depth > 0
    assert known.mean() > 0.7
    true = UNIT * views[1].depth.reshape(60, 2, 80, 2)[:, 0, :, 0]
    error = np.abs(found.depth - true)[known] / true[known]
    assert 0 < np.median(error) < 0.02
    assert selection.choose_depth(load_config().proxy).kind == "multiview"


def test_data_set(monkeypatch: pytest.MonkeyPatch, truth: Dataset, tmp_path: Path) -> None:
    import pose_table

    assert truth.camera is not None
    assert truth.world_from_cam is not None
    c = truth.camera
    quats = Rotation.from_matrix(truth.world_from_cam[:3, :3, :3]).as_quat()
    lines = [f"# camera {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}", "file,seconds,x,y,z,qw,qx,qy,qz"]
    for i, (x, y, z, w) in enumerate(quats):
        write_rgb(tmp_path / f"{i}.png", truth.rgb(i))
        place = ",".join(str(v) for v in truth.world_from_cam[i, :3, 3])
        lines.append(f"{i}.png,{truth.timestamps[i]},{place},{w},{x},{y},{z}")
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    reader = datasets._Reader(pose_table.recognises, pose_table.open_pose_table)
    monkeypatch.setattr(datasets, "_READERS", {"pose-table": reader, **datasets._READERS})
    sequence = datasets.open_sequence(tmp_path)
    assert (sequence.format, len(sequence)) == ("pose-table", 3)
    assert sequence.world_from_cam is not None
    np.testing.assert_allclose(sequence.world_from_cam, truth.world_from_cam[:3], atol=1e-9)
    np.testing.assert_array_equal(sequence.rgb(2), truth.rgb(2))
    (tmp_path / "poses.csv").write_text("\n".join([lines[0], "file,seconds", "0.png,1"]))
    with pytest.raises(InputError, match="pose table"):
        datasets.open_sequence(tmp_path)


def test_export(oracle_run: OracleRun, tmp_path: Path) -> None:
    from class_boxes import write_class_boxes

    outcome = load_outcome(oracle_run(pixel_stride=8))
    context = StageContext(outcome.run, tmp_path, Config(), tmp_path, SilentProgress())
    write_class_boxes(ExportScene(outcome, FIRST, context), Target(tmp_path))
    with (tmp_path / "boxes.csv").open() as file:
        rows = {row["class"]: [float(row[k]) for k in ("z0", "z1", "gaussians")] for row in csv.DictReader(file)}
    assert set(rows) <= set(outcome.classes.names)
    assert sum(r[2] for r in rows.values()) == len(outcome.require_map())
    assert rows["floor"][0] == pytest.approx(0, abs=0.05)  # the oracle's world has z up and the floor at 0
    assert rows["wall"][1] > 1.0
