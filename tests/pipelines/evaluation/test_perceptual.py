"""LPIPS: its wiring with stand-ins for the package and the file, and the real file where it lies beside the project."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from msgs_slam.formats.datasets import Sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.evaluation.image_quality import Lpips, open_lpips
from msgs_slam.pipelines.evaluation.write import evaluation_table
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.outcome import load_outcome
from msgs_slam.pipelines.run.folder import RunFolder
from tests.networks import save_network

OracleRun = Callable[..., RunFolder]


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


def test_pictures_are_scaled_as_the_network_was_trained() -> None:
    seen = []

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        seen.append((a, b))
        return float(np.abs(a - b).mean())

    measure = Lpips(distance)
    black, white = np.zeros((32, 48, 3), np.uint8), np.full((32, 48, 3), 255, np.uint8)
    assert measure(black, white) == pytest.approx(2)
    a, b = seen[0]
    assert a.shape == (1, 3, 32, 48)
    assert a.dtype == np.float32
    assert (a.min(), b.max()) == (-1, 1)
    assert measure(white, white) == 0
    with pytest.raises(ValueError, match="shape"):
        measure(black, white[:-1])


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
    assert isinstance(measure, Lpips)
    black, white = np.zeros((32, 48, 3), np.uint8), np.full((32, 48, 3), 255, np.uint8)
    assert measure(black, white) == pytest.approx(2)
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
    assert isinstance(measure, Lpips)
    image = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    near = np.clip(image.astype(np.int64) + 2, 0, 255).astype(np.uint8)
    assert measure(image, image) == pytest.approx(0, abs=1e-6)
    assert 0 < measure(image, near) < 0.05 < measure(image, np.full_like(image, 128))


def test_a_model_without_an_address_is_brought(tmp_path: Path) -> None:
    store = ModelStore.open(tmp_path)
    with pytest.raises(InputError, match="--from FOLDER"):
        store.pull(store.get("lpips-alex"), lambda done, size: None)


def test_weights_are_not_downloaded(installed: Path) -> None:
    assert "AlexNet's weights are not in" in str(open_lpips())
    installed.write_bytes(b"")
    assert isinstance(open_lpips(), Lpips)


def test_a_cell_of_the_evaluation(
    oracle_run: OracleRun, truth: Sequence, installed: Path, monkeypatch: pytest.MonkeyPatch
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
