"""The map of the synthetic room: as good as it must be, the same bytes after an interruption, poses put right."""

import gc
import math
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project_gaussians
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.mapping import growth, optimise
from msgs_slam.pipelines.mapping.growth import SEED_LOGIT
from msgs_slam.pipelines.mapping.measure import ViewFigures, measure_view
from msgs_slam.pipelines.mapping.optimise import MapOptimiser, OptimisedMap, Step, optimise_map, voted_logits
from msgs_slam.pipelines.mapping.state import OptimiserState
from msgs_slam.pipelines.mapping.views import MappingInput, View
from msgs_slam.pipelines.system.threads import get_threads, set_threads
from msgs_slam.pipelines.types import VOID
from tests.killed import KillAt, Killed

SETTINGS = MappingConfig(passes=6.0, min_iterations=0)


@pytest.fixture(scope="module", autouse=True)
def dense_and_often_kept() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growth, "SEED_STRIDE", 1)
        patch.setattr(optimise, "SNAPSHOT_EVERY", 20)
        yield


def figures(result: OptimisedMap, views: list[View]) -> list[ViewFigures]:
    zero = np.zeros(3, np.float32)
    return [measure_view(result.gaussian_map, v, v.cam_from_world.numpy(), zero, zero) for v in views]


def mean(result: OptimisedMap, views: list[View], name: str) -> float:
    return float(np.mean([getattr(f, name) for f in figures(result, views)]))


@pytest.fixture(scope="module")
def mapped(room: MappingInput) -> OptimisedMap:
    return optimise_map(room.views, len(room.class_ids), SETTINGS, seed=0)


def test_a_view_that_is_all_masked_is_not_judged(room: MappingInput, mapped: OptimisedMap) -> None:
    view = room.views[0]
    nothing = torch.zeros(view.image.shape[:2], dtype=torch.bool)
    half = nothing.clone()
    half[:, 1::2] = True
    (none, some) = figures(mapped, [replace(view, scene=nothing), replace(view, scene=half)])
    assert np.isnan(none.psnr)
    assert np.isnan(none.ssim)
    assert 10 < some.psnr < 60


def test_colours_are_solved_once_all_else_is_done(room: MappingInput, mapped: OptimisedMap) -> None:
    """Without a visit only they change: towards the photographs from wherever they were."""
    noise = 0.1 * torch.randn(mapped.gaussian_map.colors.shape, generator=torch.Generator().manual_seed(0))
    wrong = replace(mapped.gaussian_map, colors=mapped.gaussian_map.colors + noise)
    exposure = mapped.log_gains, mapped.offsets
    solved = optimise_map(room.views, len(room.class_ids), SETTINGS, 0, wrong, passes=0, exposure=exposure)
    assert torch.equal(solved.gaussian_map.means, wrong.means)
    before, after = (mean(replace(mapped, gaussian_map=m), room.views, "psnr") for m in (wrong, solved.gaussian_map))
    assert before + 1 < after < before + 20


def test_the_map_shows_what_the_frames_show(room: MappingInput, mapped: OptimisedMap) -> None:
    assert 27 < mean(mapped, room.views, "psnr") < 45
    assert 24 < mean(mapped, room.held_out, "psnr") < mean(mapped, room.views, "psnr")
    assert 0.88 < mean(mapped, room.views, "ssim") < 1
    assert 0 < mean(mapped, room.views, "depth_l1") < 0.1
    assert 0.92 < mean(mapped, room.views, "label_agreement") <= 1
    m = mapped.gaussian_map
    assert all(torch.isfinite(getattr(m, n)).all() for n in ("means", "log_radii", "opacity_logits", "colors"))
    assert m.opacities.min() >= growth.PRUNE_OPACITY
    assert set(m.anchor_frame_ids.tolist()) <= {v.frame_id for v in room.views}
    assert mapped.iterations == (3 + 6) * len(room.views)


def test_splitting_sharpens_a_coarse_map(room: MappingInput, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "FINE_SHARE", 0.0)
    monkeypatch.setattr(growth, "SEED_STRIDE", 4)
    # The room has no exposures to find, and so coarse a map mistakes its own blur for some.
    monkeypatch.setattr(MapOptimiser, "_expose", lambda *_: None)
    coarse = replace(SETTINGS, passes=8.0)
    split = optimise_map(room.views, len(room.class_ids), coarse, seed=0)
    monkeypatch.setattr(growth, "SPLIT_ERROR", np.inf)
    unsplit = optimise_map(room.views, len(room.class_ids), coarse, seed=0)
    assert len(split.gaussian_map) > 1.3 * len(unsplit.gaussian_map)
    for views in (room.views, room.held_out):
        assert mean(split, views, "psnr") > mean(unsplit, views, "psnr") + 1


def test_splitting_stops_at_the_largest_map(room: MappingInput, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(growth, "SPLIT_ERROR", np.inf)
        patched.setattr(growth, "SEED_STRIDE", 4)
        few = optimise_map(room.views, len(room.class_ids), SETTINGS, seed=0)
    classes, most = len(room.class_ids), len(few.gaussian_map) + 31
    state = OptimiserState.fresh(room.views, classes, few.gaussian_map, None)
    optimiser = MapOptimiser(room.views, classes, replace(SETTINGS, max_gaussians=most), state)
    for i in range(len(room.views)):
        optimiser.step(Step(i, 1.0, 0.1, False, note=True))
    optimiser.growth.split()
    assert len(state.parameters) == len(few.gaussian_map) + 30


def test_what_stands_only_where_a_view_shows_no_scene_has_no_weight(room: MappingInput, mapped: OptimisedMap) -> None:
    view, m = room.views[0], mapped.gaussian_map
    middle = view.intrinsics.width // 2
    scene = (torch.arange(view.intrinsics.width) >= middle).expand(view.depth.shape)

    def weights(seen: View) -> torch.Tensor:
        state = OptimiserState.fresh([seen], len(room.class_ids), m, None)
        MapOptimiser([seen], len(room.class_ids), SETTINGS, state).step(Step(0, 1.0, 0.1, False, note=True))
        return state.parameters.noted[:, 0]

    in_cam = m.means @ view.cam_from_world[:3, :3].float().T + view.cam_from_world[:3, 3].float()
    u, _, sigma, z = project_gaussians(in_cam, m.radii, view.intrinsics, 0.1)
    left, right = ((z > 0.1) & (u + 5 * sigma < middle)), ((z > 0.1) & (u - 5 * sigma > middle))
    all_of_it, masked = weights(view), weights(replace(view, scene=scene))
    assert all_of_it[left].max() > 0.5
    assert masked[left].max() == 0
    assert all_of_it[right].max() > 0.5
    assert torch.equal(masked[right], all_of_it[right])


def test_a_gaussian_takes_the_classes_of_the_pixels_it_fills(room: MappingInput, mapped: OptimisedMap) -> None:
    """Of one class everywhere all that is seen has its logit; of pixels that nobody knows nothing changes."""
    view, m = room.views[0], mapped.gaussian_map
    same = replace(view, channels=torch.ones_like(view.channels), channel_confidence=view.channel_confidence * 0 + 255)
    logits = voted_logits(m, [(same, view.cam_from_world)])
    changed = (logits != m.class_logits).any(1)
    assert 0.1 < changed.float().mean() < 1
    assert torch.allclose(logits[changed][:, 1], torch.tensor(SEED_LOGIT))
    assert logits[changed][:, 0].abs().max() == 0
    unsure = replace(same, channel_confidence=view.channel_confidence * 0 + 51)  # a fifth
    shares = torch.expm1(voted_logits(m, [(unsure, view.cam_from_world)])[changed]) / math.expm1(SEED_LOGIT)
    assert torch.allclose(shares[:, 1], torch.tensor(0.2), atol=1e-4)
    unknown = replace(same, channels=torch.full_like(view.channels, VOID))
    assert torch.equal(voted_logits(m, [(unknown, view.cam_from_world)]), m.class_logits)


@pytest.mark.parametrize("threads", [2, 3])
def test_views_that_are_looked_at_side_by_side_say_the_same(
    room: MappingInput, mapped: OptimisedMap, threads: int
) -> None:
    """What prunes, splits and names Gaussians, byte by byte."""

    def looked() -> list[torch.Tensor]:
        state = OptimiserState.fresh(room.views, len(room.class_ids), mapped.gaussian_map, None)
        optimiser = MapOptimiser(room.views, len(room.class_ids), SETTINGS, state)
        for i in (0, 1):
            optimiser.step(Step(i, 1.0, 0.1, False, note=True))
        optimiser.count_labels()
        return [state.parameters.noted, state.parameters.class_logits]

    before = get_threads()
    try:
        set_threads(1)
        alone = looked()
        set_threads(threads)
        assert all(torch.equal(a, b) for a, b in zip(alone, looked(), strict=True))
    finally:
        set_threads(before)


@pytest.mark.parametrize("at", [9, 75])
def test_an_interrupted_map_ends_with_the_same_bytes(
    room: MappingInput,
    tmp_path: Path,
    at: int,
    quick: tuple[MappingConfig, OptimisedMap],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(growth, "SEED_STRIDE", 3)
    settings, unbroken = quick
    snapshot = tmp_path / "state.safetensors"
    arguments = (room.views, len(room.class_ids), settings, 0)
    with pytest.raises(Killed):
        optimise_map(*arguments, snapshot=snapshot, progress=KillAt(at))
    assert snapshot.exists() == (at >= optimise.SNAPSHOT_EVERY)
    result = optimise_map(*arguments, snapshot=snapshot)
    for name, value in vars(unbroken.gaussian_map).items():
        assert torch.equal(getattr(result.gaussian_map, name), value), name
    assert result.cam_from_world.tobytes() == unbroken.cam_from_world.tobytes()
    assert result.log_gains.tobytes() == unbroken.log_gains.tobytes()


@pytest.fixture(scope="module")
def quick(room: MappingInput) -> tuple[MappingConfig, OptimisedMap]:
    settings = replace(SETTINGS, passes=4.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growth, "SEED_STRIDE", 3)
        return settings, optimise_map(room.views, len(room.class_ids), settings, seed=0)


def test_wrong_poses_are_put_right(room: MappingInput, mapped: OptimisedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views moved off a good map come back to it; the first one is held."""
    rng = np.random.default_rng(0)
    off = [torch.from_numpy(np.r_[rng.normal(0, 0.012, 3), rng.normal(0, 0.005, 3)]) for _ in room.views]
    moved = [
        replace(v, cam_from_world=se3.exp(t) @ v.cam_from_world) if i else v
        for i, (v, t) in enumerate(zip(room.views, off, strict=True))
    ]
    monkeypatch.setattr(optimise, "POSE_RATE", 2e-3)
    monkeypatch.setitem(optimise.MAP_RATES, "means", 0.0)
    monkeypatch.setattr(optimise, "DENSIFY_UNTIL", 0.0)
    monkeypatch.setattr(optimise, "RATE_DECAY", 0.1)
    result = optimise_map(moved, len(room.class_ids), SETTINGS, seed=0, initial=mapped.gaussian_map, passes=10.0)
    truth = np.stack([v.cam_from_world.numpy() for v in room.views])
    before = np.abs(np.stack([v.cam_from_world.numpy() for v in moved]) - truth)[1:, :3, 3].mean()
    after = np.abs(result.cam_from_world - truth)[1:, :3, 3].mean()
    assert 0 < after < 0.7 * before
    assert np.array_equal(result.cam_from_world[0], truth[0])


def test_poses_are_refined_alike_in_every_unit(room: MappingInput, mapped: OptimisedMap) -> None:
    def twists(unit: float) -> np.ndarray:
        views = []
        for view in room.views[:3]:
            pose = se3.exp(torch.tensor([0.01, -0.01, 0.01, 0.003, 0.003, -0.003]).double()) @ view.cam_from_world
            pose[:3, 3] *= unit
            views.append(replace(view, cam_from_world=pose, depth=view.depth * unit))
        larger = mapped.gaussian_map.moved(Similarity(unit, np.eye(3), np.zeros(3)))
        state = OptimiserState.fresh(views, len(room.class_ids), larger, None)
        optimiser = MapOptimiser(views, len(room.class_ids), SETTINGS, state)
        for i in (0, 1, 2) * 3:
            optimiser.step(Step(i, 1.0, 1.0, False, refine_pose=True))
        return np.stack([t.values["twist"].detach().numpy() for t in state.view_tables]) / ([unit] * 3 + [1.0] * 3)

    one, twenty = twists(1.0), twists(20.0)
    steps = 3 * optimise.POSE_RATE * np.array([optimise.scene_depth(room.views[:3])] * 3 + [1.0] * 3)
    assert (np.abs(one).max(0) > 0.5 * steps).all()
    assert np.abs(twenty - one).max() < 0.02 * np.abs(one).max()


def test_exposure_is_found(room: MappingInput, mapped: OptimisedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """One view darkened by a third: its gain says so, those of the others stay near 0."""
    dark = [
        replace(v, image=(v.image.float() * 0.7).round().to(torch.uint8)) if i == 5 else v
        for i, v in enumerate(room.views)
    ]
    monkeypatch.setattr(optimise, "DENSIFY_UNTIL", 0.0)
    result = optimise_map(dark, len(room.class_ids), SETTINGS, seed=0, initial=mapped.gaussian_map, passes=3.0)
    brightness = np.exp(result.log_gains).mean(1) + result.offsets.mean(1) / 0.4
    assert 0.65 < brightness[5] < 0.8
    assert np.abs(np.delete(brightness, 5) - 1).max() < 0.1


def test_views_without_classes_can_be_mapped(room: MappingInput) -> None:
    settings = replace(SETTINGS, passes=1.0)
    result = optimise_map(room.views[:4], 0, settings, seed=0)
    assert result.gaussian_map.class_logits.shape == (len(result.gaussian_map), 0)
    assert mean(result, room.views[:4], "psnr") > 15


def test_nothing_keeps_the_views_of_a_finished_map(room: MappingInput) -> None:
    views = [replace(view) for view in room.views]  # others hold the room's own
    kept = weakref.ref(views[0])
    gc.collect()
    gc.disable()  # what only it would free stays for as long as the next stage needs memory
    try:
        optimise_map(views, len(room.class_ids), replace(SETTINGS, passes=1.0), seed=0)
        assert kept() is not None
        del views
        assert kept() is None
    finally:
        gc.enable()
