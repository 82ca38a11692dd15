"""PSNR and SSIM against scikit-image, depth and mesh errors of known disturbances; LPIPS with stand-ins for the package
and the file, and by the real file where it lies beside the project."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.evaluation.metrics import DepthErrorSum, open_lpips, psnr, sees, ssim, surface_error, thinned
from msgs_slam.pipelines.evaluation.write import evaluation_table
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.types import Intrinsics
from tests.networks import save_network

OracleRun = Callable[..., RunFolder]


@pytest.mark.parametrize("noise", [2, 10, 40])
def test_same_as_scikit_image(noise: int) -> None:
    rng = np.random.default_rng(noise)
    truth = np.clip(np.cumsum(rng.normal(size=(61, 83, 3)), axis=1) * 10 + 120, 0, 255).astype(np.uint8)
    image = np.clip(truth + rng.normal(scale=noise, size=truth.shape), 0, 255).astype(np.uint8)
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth, image), abs=1e-9)
    theirs = structural_similarity(
        truth, image, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert ssim(image, truth) == pytest.approx(theirs, abs=1e-7)
    assert 0 < ssim(image, truth) < 1


def test_psnr_of_known_noise_and_of_a_mask() -> None:
    rng = np.random.default_rng(0)
    truth = np.full((200, 200, 3), 128.0)
    image = truth + rng.normal(scale=5, size=truth.shape)
    assert psnr(image, truth) == pytest.approx(20 * np.log10(255 / 5), abs=0.1)
    mask = np.zeros((200, 200), bool)
    mask[:100] = True
    image[100:] = 0
    assert psnr(image, truth, mask) == pytest.approx(20 * np.log10(255 / 5), abs=0.1)
    assert psnr(image, truth) < 12
    assert psnr(truth, truth) == float("inf")
    assert ssim(truth, truth) == pytest.approx(1)
    with pytest.raises(ValueError, match="no pixel"):
        psnr(image, truth, np.zeros((200, 200), bool))


def test_scale_noise_and_holes_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    errors = DepthErrorSum()
    for _ in range(3):
        truth = rng.uniform(1, 5, (120, 160)).astype(np.float32)
        truth[:12] = 0
        depth = (0.8 * (truth + rng.normal(scale=0.03, size=truth.shape))).astype(np.float32)
        depth[:, :40] = 0
        errors.add(depth, truth)
    result = errors.result()
    assert result.scale == pytest.approx(1.25, rel=2e-3)
    assert result.metric_l1 == pytest.approx(0.2 * 3, rel=0.02)
    # The mean of |normal| is sqrt(2 / pi) standard deviations.
    assert result.scaled_l1 == pytest.approx(0.03 * np.sqrt(2 / np.pi), rel=0.03)
    assert result.valid_fraction == pytest.approx(0.75)


def test_equal_depth_has_no_error_and_no_overlap_no_result() -> None:
    truth = np.linspace(1, 2, 64, dtype=np.float32).reshape(8, 8)
    for depth, expected in ((truth, (0, 0, 1)), (np.zeros_like(truth), None)):
        errors = DepthErrorSum()
        errors.add(depth, truth)
        found = errors.result()
        assert expected == (found and (found.metric_l1, found.scaled_l1, found.valid_fraction))


def sampled(mesh: trimesh.Trimesh, count: int) -> np.ndarray:
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])


def test_a_grown_sphere_is_off_by_its_growth() -> None:
    small, large = (trimesh.creation.icosphere(5, r) for r in (1.0, 1.03))
    a, b = (sampled(m, 40000) for m in (small, large))
    found = surface_error(b, a, threshold=0.05)
    assert found.accuracy == pytest.approx(0.03, rel=0.1)
    assert found.completeness == pytest.approx(0.03, rel=0.1)
    assert found.f_score == pytest.approx(1, abs=1e-3)
    assert surface_error(b, a, threshold=0.02).f_score == 0


def test_a_missing_half_costs_completeness_alone() -> None:
    truth = sampled(trimesh.creation.box((2.0, 2.0, 2.0)), 60000)
    half = truth[truth[:, 0] > 0]
    found = surface_error(half, truth)
    assert found.accuracy == 0
    assert found.precision == 1
    assert found.recall == pytest.approx(0.5, abs=0.05)
    # The far face is 1 m from the cut, the four sides half that on average: (4 x 2 x 0.5 + 4 x 1.2) / 24 roughly.
    assert 0.3 < found.completeness < 0.5
    with pytest.raises(ValueError, match="nothing to compare"):
        surface_error(half, truth[:0])


def test_what_is_seen_lies_in_the_image_and_not_behind_its_depth() -> None:
    camera = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
    pose, depth = np.eye(4), np.full((30, 40), 2.0, np.float32)
    pose[0, 3], depth[:, :10] = -1, 0
    view = PosedDepth(camera, pose, depth, np.ones_like(depth))
    xy, z, _ = view.grid(40)
    points = view.in_world(xy, z)
    assert len(points) == 30 * 30
    np.testing.assert_allclose(points[0], [1 + (10.5 - 20) / 50 * 2, (0.5 - 15) / 50 * 2, 2])
    probes = points[[465, 465, 465]] + np.array([[0, 0, -0.5], [0, 0, 0.05], [0, 0, 0.5]])
    outside = np.array([[9.0, 0, 2], [1.0, 0, -2]])
    assert sees(view, np.concatenate([probes, outside])).tolist() == [True, True, False, False, False]
    assert len(thinned(np.repeat(points, 3, axis=0), 1e-3)) == len(points)


class StandIn:
    """Mean distance of the tensors it is given, which it also keeps."""

    def __init__(self, net: str = "", verbose: bool = True) -> None:
        self.net, self.seen = net, []

    def eval(self) -> StandIn:
        return self

    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        self.seen.append((a, b))
        return (a - b).abs().mean().reshape(1, 1, 1, 1)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The package is there; returns where its weights would lie."""
    package, vision, models = ModuleType("lpips"), ModuleType("torchvision"), ModuleType("torchvision.models")
    package.LPIPS = StandIn  # type: ignore[attr-defined]
    weights = SimpleNamespace(IMAGENET1K_V1=SimpleNamespace(url="https://example.org/models/alexnet-123.pth"))
    models.AlexNet_Weights = weights  # type: ignore[attr-defined]
    for name, module in (("lpips", package), ("torchvision", vision), ("torchvision.models", models)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    return tmp_path / "checkpoints" / "alexnet-123.pth"


def test_why_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert "pip install 'lpips>=" in str(open_lpips())
    assert "models pull --from" in str(open_lpips())


def save_measure(path: Path, inputs: tuple[str, str] = ("image0", "image1")) -> None:
    """An ONNX file with the contract of `lpips-alex` that gives the mean distance."""
    nodes = f"difference = Sub ({', '.join(inputs)})", "size = Abs (difference)"
    ports = ", ".join(f"float[1, 3, h, w] {name}" for name in inputs)
    save_network(path, ports, "float distance", *nodes, "distance = ReduceMean <keepdims = 0> (size)")


def cached(monkeypatch: pytest.MonkeyPatch, folder: Path, **contract: tuple[str, str]) -> Path:
    """The file of another measure in a cache of its own, as the table's row of `lpips-alex`."""
    store = ModelStore.open(folder)
    save_measure(folder / "lpips-alex.onnx", **contract)
    path = folder / "lpips-alex.onnx"
    row = replace(store.get("lpips-alex"), bytes=path.stat().st_size, sha256=file_sha256(path))
    monkeypatch.setattr(ModelStore, "open", lambda: replace(store, models=(row,)))
    return path


def test_by_the_file_in_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = cached(monkeypatch, tmp_path)
    measure = open_lpips()
    black, white = np.zeros((32, 48, 3), np.uint8), np.full((32, 48, 3), 255, np.uint8)
    assert measure(black, white) == pytest.approx(2)
    assert measure(white, white) == 0
    with pytest.raises(ValueError, match="shape"):
        measure(black, white[:-1])
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert "is damaged" in str(open_lpips())


def test_a_file_of_another_contract_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cached(monkeypatch, tmp_path, inputs=("a", "b"))
    with pytest.raises(InputError, match="its inputs are a, b"):
        open_lpips()


def test_the_published_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, shared_data: Path) -> None:
    store = ModelStore.open(tmp_path)
    if not store.take(shared_data / "models", [store.get("lpips-alex")]):
        pytest.skip("lpips_alex.onnx is not in the shared models")
    monkeypatch.setattr(ModelStore, "open", lambda: store)
    measure = open_lpips()
    image = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    near = np.clip(image.astype(np.int64) + 2, 0, 255).astype(np.uint8)
    assert measure(image, image) == pytest.approx(0, abs=1e-6)
    assert 0 < measure(image, near) < 0.05 < measure(image, np.full_like(image, 128))


def test_a_cell_of_the_evaluation(
    oracle_run: OracleRun, truth: Dataset, installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    figures = evaluate_outcome(load_outcome(run), truth, max_views=2)
    assert "weights" in figures["images"]["keyframes"]["lpips"]["missing"]
    assert "| LPIPS | – | AlexNet's weights" in evaluation_table(figures)
    installed.write_bytes(b"")
    figures = evaluate_outcome(load_outcome(run), truth, max_views=2)
    assert 0 < figures["images"]["keyframes"]["lpips"] < 1
    assert f"keyframes {figures['images']['keyframes']['lpips']:.4f}" in evaluation_table(figures)
    assert all(v["lpips"] > 0 for v in figures["views"])
