"""Who works with a map does so where it lies: on a device that is only pretended, but as strict as a GPU."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.config import STAGES, Config, ExportConfig, MappingConfig, ProxyConfig
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.evaluation.film import render_run
from msgs_slam.pipelines.evaluation.serve import page_of_run
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.mapping import growth
from msgs_slam.pipelines.mapping import stage as mapping_stage
from msgs_slam.pipelines.mapping.move_map import move_map
from msgs_slam.pipelines.mapping.state import MapParameters, empty_map
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.run.files import MAP, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.runner import run_stages
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.pipelines.mapping.small_run import make_run
from tests.pretend_device import DEVICE, PretendTensor, WrongDeviceError, pretended

CONFIG = Config(
    proxy=ProxyConfig(max_side=96, stereo_side=80),
    mapping=MappingConfig(passes=2.0, min_iterations=0, max_side=40, hold_out=4),
    export=ExportConfig(voxel=0.05),
)


@pytest.fixture(scope="module", autouse=True)
def device() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch, pretended(patch):
        yield


@pytest.fixture(scope="module")
def run(device: None, tmp_path_factory: pytest.TempPathFactory, world_sequence: Path) -> RunFolder:
    """All six stages, of the walk's beginning, where `auto` chooses the pretended device."""
    source, made = tmp_path_factory.mktemp("source"), RunFolder(tmp_path_factory.mktemp("device"))
    (source / "rgb").mkdir()
    for name in ("intrinsics.json", "timestamps.txt", *(f"rgb/{i:06d}.png" for i in range(14))):
        shutil.copyfile(world_sequence / name, source / name)
    records = run_stages(StageContext(made, source, CONFIG, made.root, SilentProgress(), stages=all_stages()), "made")
    assert list(records) == list(STAGES)
    assert records["tracking"].figures["posed"] == 14
    assert records["mapping"].figures["keyframe_psnr"] > 15
    assert records["mapping"].figures["held_out_psnr"] > 10
    return made


def test_a_map_can_be_moved_there(run: RunFolder) -> None:
    gaussian_map = run.load(MAP, "mapping").to(DEVICE)
    assert isinstance(gaussian_map.means, PretendTensor)
    trajectory = run.load(TRAJECTORY, "mapping")
    poses = trajectory.cam_from_world
    moved = move_map(gaussian_map, trajectory.frame_ids, poses, poses, np.full(len(poses), 2.0))
    assert isinstance(moved.means, PretendTensor)
    assert torch.allclose(moved.log_radii.cpu(), gaussian_map.log_radii.cpu() + np.log(2.0), atol=1e-6)


def test_what_was_made_there_can_be_exported_again(run: RunFolder, tmp_path: Path) -> None:
    export_run(run, tmp_path, "ply")
    export_run(run, tmp_path, "spz")
    assert (tmp_path / "point_cloud.ply").stat().st_size > 10_000


def test_it_is_measured_there(run: RunFolder, world_sequence: Path) -> None:
    result = evaluate_outcome(load_outcome(run), open_sequence(world_sequence), max_views=2)
    assert result["images"]["keyframes"]["psnr"] > 15
    assert "held out at refined poses" in result["images"]


def test_it_is_drawn_there(run: RunFolder, tmp_path: Path) -> None:
    render_run(run, tmp_path / "pictures", path="own", fps=0.1)
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2


def test_it_is_viewed_from_there(run: RunFolder) -> None:
    assert "<canvas" in page_of_run(run)


def test_gradients_there_are_those_of_the_cpu() -> None:
    values = torch.randn(500, generator=torch.Generator().manual_seed(0))
    found = []
    for leaf in (values.clone().requires_grad_(), values.to(DEVICE).requires_grad_()):
        loss = (leaf - 0.5).clamp(min=0).square().mean() + torch.where(leaf > 0, leaf.exp(), 0.0).sum()
        found.append(torch.autograd.grad(loss, leaf)[0].cpu())
    assert torch.equal(*found)


def test_a_map_that_is_not_finite_there_is_found() -> None:
    """The renderer looks for it on the CPU alone; the optimiser looks once a pass."""
    parameters = MapParameters.from_map(empty_map(2, DEVICE))
    colors, zeros = torch.zeros(4, 3), torch.zeros(4, device=DEVICE)
    for value in (0.5, float("nan")):
        parameters.require_finite_on_card()
        colors[1, 2] = value
        ids = torch.zeros(4, dtype=torch.int64, device=DEVICE)
        wide = torch.zeros(4, 2, device=DEVICE)
        seeds = GaussianMap(torch.zeros(4, 3, device=DEVICE), zeros, zeros, colors.to(DEVICE), wide, ids)
        parameters.append(seeds, zeros)
    with pytest.raises(ValueError, match=r"^colors: 1 of 24 values are NaN"):
        parameters.require_finite_on_card()


def test_a_misplaced_copy_to_the_cpu_is_found(
    world_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test of these tests."""
    right = growth._spacing
    monkeypatch.setattr(growth, "_spacing", lambda view, stride: right(view, stride).cpu())
    made = make_run(tmp_path / "run", world_sequence, every=8)
    made.partial("mapping").mkdir()
    with pytest.raises(WrongDeviceError, match="of the CPU meets"):
        mapping_stage.run(StageContext(made, made.root, CONFIG, made.partial("mapping"), SilentProgress()))
