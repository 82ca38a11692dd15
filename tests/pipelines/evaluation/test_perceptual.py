"""LPIPS: its wiring with a stand-in for the package, whose weights come from the network."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from msgs_slam.formats.datasets import Sequence
from msgs_slam.pipelines.evaluation.evaluate import evaluate_run
from msgs_slam.pipelines.evaluation.perceptual import Lpips, open_lpips
from msgs_slam.pipelines.evaluation.table import evaluation_table
from msgs_slam.pipelines.run.folder import RunFolder

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
    model = StandIn()
    black, white = np.zeros((32, 48, 3), np.uint8), np.full((32, 48, 3), 255, np.uint8)
    assert Lpips(model)(black, white) == pytest.approx(2)
    a, b = model.seen[0]
    assert a.shape == (1, 3, 32, 48)
    assert (a.min(), b.max()) == (-1, 1)
    assert Lpips(model)(white, white) == 0
    with pytest.raises(ValueError, match="shape"):
        Lpips(model)(black, white[:-1])


def test_why_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert "msgs-slam[lpips]" in str(open_lpips())


def test_weights_are_not_downloaded(installed: Path) -> None:
    assert "AlexNet's weights are not in" in str(open_lpips())
    installed.write_bytes(b"")
    assert isinstance(open_lpips(), Lpips)


def test_a_cell_of_the_evaluation(
    oracle_run: OracleRun, truth: Sequence, installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    figures = evaluate_run(run, truth, max_views=2)
    assert "weights" in figures["images"]["keyframes"]["lpips"]["missing"]
    assert "| LPIPS | – | AlexNet's weights" in evaluation_table(figures)
    installed.write_bytes(b"")
    figures = evaluate_run(run, truth, max_views=2)
    assert 0 < figures["images"]["keyframes"]["lpips"] < 1
    assert f"keyframes {figures['images']['keyframes']['lpips']:.4f}" in evaluation_table(figures)
    assert all(v["lpips"] > 0 for v in figures["views"])
