"""A map made in parts is as good as one made whole, and the same however often its making is broken off."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from finished import note_finished
from scipy import sparse

from msgs_slam.formats.tensors import load_tensors
from msgs_slam.pipelines.config import Config, MappingConfig, RunConfig
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.mapping import optimise, submaps
from msgs_slam.pipelines.mapping import stage as mapping_stage
from msgs_slam.pipelines.mapping.submaps import BORDER, SeenExposures, common_exposure, divide, nearest_seeing
from msgs_slam.pipelines.run.files import SUBMAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome, maps_around
from msgs_slam.pipelines.run.schema import RunFile
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.machine import MIN_SUBMAP, submap_size
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Intrinsics
from tests.killed import Killed

CONFIG = Config(
    run=RunConfig(device="cpu"),
    mapping=MappingConfig(passes=2.0, min_iterations=0, max_side=48, hold_out=8, submap=5),
)


def chain(count: int, reach: int) -> sparse.csr_matrix:
    """Overlaps of a walk on which keyframes up to `reach` apart see the same."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    return sparse.csr_matrix(np.clip(1 - apart / reach, 0, 1))


def test_a_walk_is_cut_where_it_shares_least() -> None:
    overlap = chain(200, 20).tolil()
    for i in range(90, 97):  # a door between 93 and 94
        for j in range(60, 130):
            if (i < 94) != (j < 94):
                overlap[i, j] = overlap[j, i] = 0.05
    first, second = divide(np.arange(200) + 1000, overlap.tocsr(), 100)
    assert first.own.tolist() == list(range(1000, 1094))
    assert second.own.tolist() == list(range(1094, 1200))
    assert first.neighbours == (1,)
    assert second.neighbours == (0,)
    assert len(first.border) == BORDER
    assert set(first.border) <= set(second.own)


def test_submaps_are_as_large_as_the_memory_that_is_given_allows() -> None:
    camera = Intrinsics(500.0, 500.0, 320.0, 240.0, 640, 480)

    def size(memory_mb: int, most: int = 250) -> int:
        return submap_size(Config(run=RunConfig(memory_mb=memory_mb), mapping=MappingConfig(submap=most)), camera)

    assert size(0) == 250  # the same on every machine
    assert MIN_SUBMAP < size(2000) < size(3000) < 250
    assert (size(100), size(100_000), size(100, most=0), size(100, most=20)) == (MIN_SUBMAP, 250, 0, 20)


def test_what_is_seen_again_stays_together() -> None:
    """Forth and back: the keyframe at time t stands where that at 199 - t stood."""
    place = np.minimum(np.arange(200), 199 - np.arange(200))
    overlap = sparse.csr_matrix(np.clip(1 - np.abs(place[:, None] - place) / 10, 0, 1))
    parts = divide(np.arange(200), overlap, 50)
    assert len(parts) == 4
    assert sorted(np.concatenate([p.own for p in parts])) == list(range(200))
    for part in parts:
        assert 30 <= len(part.own) <= 70
        assert np.ptp(place[part.own]) < 50
        assert set(199 - part.own) == set(part.own)


def test_few_keyframes_are_not_divided() -> None:
    for size in (0, 100, 30):
        (whole,) = divide(np.arange(40), chain(40, 5), size)
        assert len(whole.own) == 40
        assert len(whole.border) == 0
        assert whole.neighbours == ()


def test_the_nearest_view_that_sees_a_place_has_it() -> None:
    camera = Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0)

    def view(z: float, depth: float) -> PosedDepth:
        shown = np.full((30, 40), depth, np.float32)
        return PosedDepth(camera, se3.inverse(np.array(se3.exp(np.array([0, 0, z, 0, 0, 0.0])))), shown, shown)

    far, near, beside_wall = view(0, 4.0), view(2, 2.0), view(3, 0.3)
    on_wall, behind, outside, before = [0, 0, 4.0], [0, 0, 4.5], [9, 0, 4.0], [0, 0, 1.0]
    points = np.array([on_wall, behind, outside, before], float)
    assert nearest_seeing(points, [far, near, beside_wall]).tolist() == [1, -1, -1, 0]


class KillAfter(SilentProgress):
    """Ends after so many steps of whatever is tracked."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def track(self, items, label, total=None):  # type: ignore[no-untyped-def]
        for item in items:
            yield item
            self.left -= 1
            if self.left == 0:
                raise Killed


class BackwardsAndTwice(StageContext):
    """Whoever does the tasks."""

    def each(self, work, tasks):  # type: ignore[no-untyped-def]
        for task in reversed(tasks):
            super().each(work, [task])
        return super().each(work, tasks)


def mapped(
    run: RunFolder,
    folder: Path,
    config: Config = CONFIG,
    progress: SilentProgress | None = None,
    kind: type[StageContext] = StageContext,
) -> dict:
    folder.mkdir(exist_ok=True)
    return mapping_stage.run(kind(run, run.root, config, folder, progress or SilentProgress()))


@pytest.fixture(scope="module")
def divided(small_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict]]:
    folder = tmp_path_factory.mktemp("divided") / "mapping"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(submaps, "BORDER", 4)
        yield folder, mapped(small_run, folder)


def test_parts_show_what_the_whole_shows(small_run: RunFolder, divided: tuple[Path, dict], tmp_path: Path) -> None:
    whole = mapped(small_run, tmp_path / "whole", replace(CONFIG, mapping=replace(CONFIG.mapping, submap=0)))
    figures = divided[1]
    assert figures["submaps"] == 3
    assert whole["submaps"] == 1
    assert figures["keyframes"] == whole["keyframes"] == 14
    assert figures["keyframe_psnr"] > whole["keyframe_psnr"] - 0.3
    assert figures["held_out_psnr"] > whole["held_out_psnr"] - 0.3
    assert 0.7 < figures["gaussians"] / whole["gaussians"] < 1.4  # copies of the same surface are not kept


def test_broken_off_anywhere_it_ends_with_the_same_bytes(
    small_run: RunFolder, divided: tuple[Path, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimise, "SNAPSHOT_EVERY", 20)
    steps = divided[1]["iterations"]  # of the refinement; the making takes as many
    for number, after in enumerate((int(0.4 * steps), int(1.8 * steps))):
        folder = tmp_path / str(number)
        with pytest.raises(Killed):
            mapped(small_run, folder, CONFIG, KillAfter(after))
        figures = mapped(small_run, folder, CONFIG, kind=BackwardsAndTwice)
        assert figures == divided[1]
        for name in ("map.safetensors", "trajectory.npz", "exposure.npz", "mapping.json"):
            assert (folder / name).read_bytes() == (divided[0] / name).read_bytes()


def test_what_several_submaps_show_is_the_mean_of_what_they_say(divided: tuple[Path, dict]) -> None:
    """Weighed by the pixels that each Gaussian fills in their views; none is lost, and colours do come to differ."""
    files = divided[0] / "snapshot" / "submaps_3"
    joined, agreed = (load_tensors(files / f"{kind}_0000.safetensors") for kind in ("joined", "agreed"))
    total, mean, told = torch.zeros(len(joined["means"])), torch.zeros_like(joined["colors"]), []
    for path in sorted(files.glob("refined_*.safetensors")):
        refined = load_tensors(path)
        mine = torch.isin(refined["anchor_frame_ids"], joined["anchor_frame_ids"])
        rows, weights = refined["rows"][mine], refined["weights"][mine]
        assert torch.equal(refined["anchor_frame_ids"][mine], joined["anchor_frame_ids"][rows])
        mean[rows] += weights[:, None] * refined["colors"][mine]
        total[rows] += weights
        told.append(torch.full((len(total), 3), torch.nan).index_put((rows,), refined["colors"][mine]))
    shown = total > 0
    assert float(shown.float().mean()) > 0.9
    assert torch.allclose(agreed["colors"][shown], mean[shown] / total[shown, None], atol=1e-5)
    assert torch.equal(agreed["colors"][~shown], joined["colors"][~shown])
    apart = (told[0] - told[1]).abs()
    assert int(apart.isfinite().sum()) > 1000
    assert float(apart[apart.isfinite()].mean()) > 0.005


@pytest.fixture(scope="module")
def finished(small_run: RunFolder, divided: tuple[Path, dict], tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run whose map was made in parts."""
    run = RunFolder(tmp_path_factory.mktemp("finished") / "run")
    shutil.copytree(small_run.root, run.root)
    shutil.copytree(divided[0], run.stage("mapping"), ignore=shutil.ignore_patterns("snapshot"))
    note_finished(run, ("frames", "proxy", "tracking", "mapping"), CONFIG)
    return run


def test_a_view_is_drawn_from_its_submap_and_those_beside_it(finished: RunFolder) -> None:
    class NothingBeside(RunFolder):
        def load(self, file: RunFile[Any], *where: str, **more: Any) -> Any:
            return [{**submap, "beside": np.zeros(0, np.int64)} for submap in super().load(file, *where, **more)]

    outcome = load_outcome(finished, "cpu")
    near, own_alone = maps_around(outcome), maps_around(replace(outcome, run=NothingBeside(finished.root)))
    anchors, submaps = outcome.require_map().anchor_frame_ids.numpy(), finished.load(SUBMAPS)
    for submap in submaps:
        around = np.concatenate([submap["own"], *(submaps[n]["own"] for n in submap["beside"])])
        for frame_id in submap["own"].tolist():
            assert len(near(frame_id)) == np.isin(anchors, around).sum()
            assert set(own_alone(frame_id).anchor_frame_ids.tolist()) <= set(submap["own"].tolist())
    assert len(near(10_000)) == len(outcome.require_map())  # of no submap


def test_submaps_are_brought_to_one_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each was made with exposures relative to a gain and an offset of its own; all is told by what they share."""
    rng = np.random.default_rng(0)
    log_gains, offsets = rng.normal(0, 0.1, (2, 120, 3))
    own_gain, own_offset = rng.normal(0, 0.1, (3, 3)), rng.normal(0, 0.02, (3, 3))
    own_gain, own_offset = own_gain - own_gain.mean(0), own_offset - own_offset.mean(0)
    seen = []
    for gain, offset, ids in zip(own_gain, own_offset, (range(60), range(30, 90), range(60, 120)), strict=True):
        mine = np.array(ids)
        photo_offsets = offsets[mine] + offset * np.exp(log_gains[mine])
        seen.append(SeenExposures(mine, log_gains[mine] + gain, photo_offsets))
    found_gain, found_offset = common_exposure(seen)
    assert found_gain == pytest.approx(own_gain, abs=0.15 * np.abs(own_gain).max())
    assert found_offset == pytest.approx(own_offset, abs=0.3 * np.abs(own_offset).max())
    monkeypatch.setattr(submaps, "_REST", 1e-6)  # to what is shared alone
    found_gain, found_offset = common_exposure(seen)
    assert found_gain == pytest.approx(own_gain, abs=1e-4)
    assert found_offset == pytest.approx(own_offset, abs=1e-4)
    alone, _ = common_exposure([*seen, SeenExposures(np.array([999]), np.ones((1, 3)), np.ones((1, 3)))])
    assert alone[3] == pytest.approx(0)


def test_what_submaps_say_of_each_other_does_not_add_up_over_a_building() -> None:
    """Each seems a little brighter than the one before it, because what is newly seen shows less contrast."""
    bias, count, each = 0.06, 40, 60
    seen = []
    for n in range(count):
        ids = np.arange(n * each, (n + 1) * each + 32)
        log_gains = np.where(np.arange(len(ids)) < 32, bias, 0.0)[:, None] * np.ones(3)
        seen.append(SeenExposures(ids, log_gains, np.zeros_like(log_gains)))
    found, _ = common_exposure(seen)
    assert np.abs(found).max() < 0.5 < bias * count / 4
