"""The map as 3D Tiles: every level shows the same scene, boxes hold what is in them, and it lies where GPS says."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from msgs_slam.formats import atomic
from msgs_slam.formats.errors import DiskFullError
from msgs_slam.formats.splats import GaussianCloud
from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.export import splats
from msgs_slam.pipelines.export.scene import ExportScene
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.run.target import Target
from msgs_slam.pipelines.scene.world import SAME, Georeference, World
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.splat_readers import read_gaussian_glb

OracleRun = Callable[..., RunFolder]


@pytest.fixture
def written(oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[RunFolder, Path, Any]:
    """A run, its tiles and what tileset.json says of them."""
    monkeypatch.setattr(splats, "MAX_GAUSSIANS", 3000)
    run = oracle_run()
    export_run(run, tmp_path, "tiles")
    return run, tmp_path / "tiles", json.loads((tmp_path / "tiles" / "tileset.json").read_text())


def tiles_of(tile: dict[str, Any], level: int = 0) -> Iterator[tuple[int, dict[str, Any]]]:
    yield level, tile
    for child in tile.get("children", ()):
        yield from tiles_of(child, level + 1)


def box_of(tile: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    box = np.array(tile["boundingVolume"]["box"])
    half = np.abs(box[3:].reshape(3, 3)).sum(axis=0)
    return box[:3] - half, box[:3] + half


def z_up(cloud: GaussianCloud) -> np.ndarray:
    """What a viewer of 3D Tiles makes of the content: y up of glTF is turned to z up."""
    return np.stack([cloud.means[:, 0], cloud.means[:, 2], -cloud.means[:, 1]], axis=1)


def test_the_tree_is_as_the_standard_asks(written: tuple[RunFolder, Path, Any]) -> None:
    run, folder, tileset = written
    assert tileset["asset"]["version"] == "1.1"
    leaves, errors = 0, [tileset["geometricError"]]
    for level, tile in tiles_of(tileset["root"]):
        cloud = read_gaussian_glb(folder / tile["content"]["uri"])
        assert 0 < len(cloud) <= 3000
        low, high = box_of(tile)
        assert ((z_up(cloud) > low) & (z_up(cloud) < high)).all()
        for child in tile.get("children", ()):
            assert child["geometricError"] < tile["geometricError"]
            assert (box_of(child)[0] >= low - 1e-9).all()
            assert (box_of(child)[1] <= high + 1e-9).all()
        if "children" not in tile:
            assert (level, tile["geometricError"]) >= (1, 0.0)
            leaves += len(cloud)
        errors.append(tile["geometricError"])
    m = load_outcome(run).require_map()
    assert leaves == len(m)
    assert max(errors) == errors[0]
    assert {p.name for p in folder.iterdir()} == {"tileset.json"} | {
        tile["content"]["uri"] for _, tile in tiles_of(tileset["root"])
    }


def test_every_level_looks_like_the_map(written: tuple[RunFolder, Path, Any]) -> None:
    run, folder, tileset = written
    outcome = load_outcome(run)
    world = json.loads((folder.parent / "world.json").read_text())["exported_from_run"]
    rotation, shift = np.array(world["rotation"]), np.array(world["translation"])
    cam_from_exported = outcome.trajectory.cam_from_world[3].copy()
    cam_from_exported[:3, :3] = cam_from_exported[:3, :3] @ rotation.T
    cam_from_exported[:3, 3] -= cam_from_exported[:3, :3] @ shift
    pictures = []
    found = list(tiles_of(tileset["root"]))
    for level in range(max(level for level, _ in found) + 1):
        shown = [t for k, t in found if k == level or (k < level and "children" not in t)]
        clouds = [read_gaussian_glb(folder / t["content"]["uri"]) for t in shown]
        means = torch.from_numpy(np.concatenate([z_up(c) for c in clouds]).astype(np.float32))
        radii, alpha = (np.concatenate([getattr(c, n) for c in clouds]) for n in ("log_scales", "opacity_logits"))
        colors = torch.from_numpy(np.concatenate([c.colors for c in clouds]))
        camera, pose = outcome.calibration.intrinsics, torch.from_numpy(cam_from_exported)
        scale, opacity = torch.from_numpy(np.exp(radii[:, 0])), torch.from_numpy(alpha).sigmoid()
        pictures.append(render(means, scale, opacity, colors, pose, camera))
    assert len(pictures) > 2
    for coarse in pictures[:-1]:
        assert 0 < float((coarse.features - pictures[-1].features).abs().mean()) < 0.08
        assert float(coarse.silhouette.mean()) > 0.9 * float(pictures[-1].silhouette.mean())


def test_it_lies_on_the_earth(oracle_run: OracleRun, tmp_path: Path) -> None:
    origin = (55.698, 13.195, 37.0)
    world = World("up", "floor", True, SAME, {}, Georeference(origin, 1.0, 9, 9, 0.01))
    outcome = load_outcome(oracle_run())
    splats.write_tiles(
        ExportScene(outcome, world, StageContext(outcome.run, tmp_path, Config(), tmp_path, SilentProgress())),
        Target(tmp_path),
    )
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    transform = np.array(root["transform"]).reshape(4, 4, order="F")
    earth = pycolmap.GPSTransform()
    for east_north_up in ([0.0, 0, 0], [30.0, -20, 5]):
        place = earth.enu_to_ellipsoid(np.array([east_north_up]), *origin)
        expected = earth.ellipsoid_to_ecef(place)[0]
        np.testing.assert_allclose((transform @ [*east_north_up, 1])[:3], expected, atol=2e-3)
    m = outcome.require_map().means.numpy()
    low, high = box_of(root)
    assert ((m > low) & (m < high)).all()  # z up as it is: nothing is turned twice


def test_a_full_disk_leaves_nothing_half_written(
    written: tuple[RunFolder, Path, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, folder, _ = written
    before = {p: p.read_bytes() for p in folder.parent.rglob("*") if p.is_file()}

    def fill(path: Path) -> None:
        if path.name == "tile01.glb":
            raise OSError(28, "No space left on device", str(path))

    with atomic.after_each_write(fill), pytest.raises(DiskFullError):
        export_run(run, folder.parent, "tiles", settings=ExportConfig(axes="first"), overwrite=True)
    after = {p: p.read_bytes() for p in folder.parent.rglob("*") if p.is_file()}
    assert after == before, "neither half of the files nor the loss of the earlier ones"


def test_a_disk_without_room_is_told_before_anything_is_made(
    oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    free = shutil.disk_usage(tmp_path)._replace(free=10_000)
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda _: free)
    for kind in ("tiles", "html"):
        with pytest.raises(DiskFullError, match="needs at least"):
            export_run(run, tmp_path / "out", kind)
    assert not (tmp_path / "out").exists()
