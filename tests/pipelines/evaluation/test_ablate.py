"""The ablations on the synthetic room: one set of proxies, a run a row and seed, resumable."""

import json
from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.datasets import Sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.read_config import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.benchmarks import ablate as ablation
from tests.benchmarks.ablate import ABLATIONS, ablate

SETTINGS = (
    "run.threads=2", "frames.rate=4", "proxy.depth=files", "proxy.semantics=files", "mapping.max_side=120",
    "mapping.passes=2", "mapping.min_iterations=25",
)  # fmt: skip
VARIANTS = ("complete", "without depth loss", "without loops")
SEEDS = (0, 1)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(overrides=SETTINGS)


@pytest.fixture(scope="module")
def folder(truth: Sequence, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of three rows; stopped once in the middle and called again."""
    folder = tmp_path_factory.mktemp("work") / "room.ablation"
    measured: list[str] = []
    measure = ablation.evaluate_outcome

    def stop_at_the_third(*arguments: object, **named: object) -> object:
        measured.append(str(arguments[0]))
        if len(measured) == 3:
            raise KeyboardInterrupt
        return measure(*arguments, **named)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "evaluate_outcome", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            run(truth, folder, config)
        assert len(json.loads((folder / "ablation.json").read_text())["rows"]) == 2
        first = (folder / "runs" / "complete_seed0.msgs" / "mapping" / "map.safetensors").stat().st_ino
        run(truth, folder, config)
    assert len(measured) == 7  # six runs, one of them begun twice
    assert (folder / "runs" / "complete_seed0.msgs" / "mapping" / "map.safetensors").stat().st_ino == first
    return folder


def run(truth: Sequence, folder: Path, config: Config, seeds: tuple[int, ...] = SEEDS) -> dict:
    return ablate(truth.root, truth, folder, config, seeds, SilentProgress(), VARIANTS, max_views=3)


def test_proxies_are_made_once_and_every_seed_is_another_run(folder: Path) -> None:
    runs = sorted((folder / "runs").glob("*.msgs"))
    assert len(runs) == 6
    maps = {p.stat().st_ino for r in runs for p in (r / "proxy" / "maps").glob("000000.npz")}
    assert len(maps) == 1
    assert not list((folder / "runs").glob("*.partial"))
    inode = {r.name: (r / "mapping" / "map.safetensors").stat().st_ino for r in runs}
    # What a row does not change is that of the complete run with the same seed.
    assert inode["without_loops_seed1.msgs"] == inode["complete_seed1.msgs"] != inode["complete_seed0.msgs"]
    assert inode["without_depth_loss_seed0.msgs"] != inode["complete_seed0.msgs"]


def test_table_has_means_and_spreads(folder: Path) -> None:
    result = json.loads((folder / "ablation.json").read_text())
    assert [row["name"] for row in result["rows"]] == list(VARIANTS)
    rows = {row["name"]: row for row in result["rows"]}
    complete, no_depth = rows["complete"], rows["without depth loss"]
    assert complete["seeds"] == [0, 1]
    values = complete["values"]["PSNR, dB"]
    assert complete["mean"]["PSNR, dB"] == pytest.approx(np.mean(values))
    assert complete["sd"]["PSNR, dB"] == pytest.approx(np.std(values, ddof=1))
    assert complete["sd"]["PSNR, dB"] > 0  # the seeds do differ
    assert 15 < complete["mean"]["PSNR, dB"] < 45
    assert 40 < complete["mean"]["mIoU, %"] < 100
    assert 0 < complete["mean"]["ATE SE(3), cm"] < 5
    assert no_depth["mean"]["depth L1, cm"] > complete["mean"]["depth L1, cm"]
    table = (folder / "ablation.md").read_text()
    assert "| without depth loss | 0, 1 |" in table
    assert " ± " in table
    assert "mapping.depth_weight=0.0" in table
    assert "clustering mIoU" not in table.split("\n\n")[1]


def test_what_is_done_is_not_done_again(
    folder: Path, truth: Sequence, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablation, "evaluate_outcome", None)
    assert run(truth, folder, config) == json.loads((folder / "ablation.json").read_text())


def test_another_ablation_in_the_folder_is_refused(folder: Path, truth: Sequence, config: Config) -> None:
    other = load_config(overrides=["mapping.passes=3"], base=config)
    with pytest.raises(InputError, match="another settings"):
        run(truth, folder, other)


def test_mistakes_are_explained(truth: Sequence, config: Config, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="is not an ablation's folder"):
        run(truth, tmp_path, config)
    for seeds in ((), (1, 1)):
        with pytest.raises(InputError, match="different numbers"):
            run(truth, tmp_path / "new", config, seeds)
    with pytest.raises(InputError, match=", ".join(ABLATIONS)):
        ablate(truth.root, truth, tmp_path / "new", config, (0,), SilentProgress(), ("without luck",))
    assert not (tmp_path / "new").exists()
