"""Multi-view depth, fused depth and regions on the synthetic room, against its exact truth."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from proxy_room import UNIT, Room, write_source

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png
from msgs_slam.pipelines.config import ProxyConfig
from msgs_slam.pipelines.depth.fused import FusedDepth, fuse_with_stereo, measure_scale, sharpen_steps
from msgs_slam.pipelines.depth.stereo import provider as stereo_provider
from msgs_slam.pipelines.depth.stereo.consistency import sweep_range
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.labels.named import ShapeLabels
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.proxy.maps import mean_iou
from msgs_slam.pipelines.proxy.selection import ProviderContext, open_depth
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Frame, Intrinsics

SIDE, PLANES = 256, 64


@pytest.fixture(scope="module")
def stereo(room: Room, tmp_path_factory: pytest.TempPathFactory) -> MultiviewDepth:
    folder = tmp_path_factory.mktemp("stereo")
    provider = MultiviewDepth(room.sequence(), SIDE, PLANES, lambda: folder, 2, SilentProgress())
    provider.fit(room.frames)
    return provider


def relative_errors(room: Room, estimate: DepthEstimate, frame: Frame, unit: float = UNIT) -> np.ndarray:
    truth = room.views[frame.id].depth * unit
    return np.abs(estimate.depth / truth - 1)


def test_multiview_is_exact_where_it_is_sure_and_its_confidence_sorts(room: Room, stereo: MultiviewDepth) -> None:
    errors, confidences = [], []
    for frame in room.frames[2:9]:
        estimate = stereo.estimate(frame)
        errors.append(relative_errors(room, estimate, frame).ravel())
        confidences.append(estimate.confidence.ravel())
    error, confidence = np.concatenate(errors), np.concatenate(confidences)
    reliable = confidence > 0.3
    assert reliable.mean() > 0.7
    assert 0 < np.median(error[reliable]) < 0.008
    low, high = np.quantile(confidence, [1 / 3, 2 / 3])
    assert error[confidence >= high].mean() < 0.5 * error[confidence <= low].mean()


def test_the_range_of_depths_holds_what_is_plain_and_nearer_than_all_points(room: Room) -> None:
    """Such as a sofa in the foreground: beyond the range nothing can match."""
    model = room.sequence().backbone
    assert model is not None
    for index in (0, 4):
        limits = sweep_range(model, index, np.array([index + 1, index + 2]))
        assert limits is not None
        points = model.points_in_world[model.points_of(index)]
        depths = points @ model.cam_from_world[index, 2, :3] + model.cam_from_world[index, 2, 3]
        assert limits[0] < 0.5 * np.percentile(depths, 1)
        assert limits[1] > depths.max()


def test_multiview_gives_the_same_bytes_with_other_threads(room: Room, stereo: MultiviewDepth, tmp_path: Path) -> None:
    single = MultiviewDepth(room.sequence(), SIDE, PLANES, lambda: tmp_path, 1, SilentProgress())
    single.fit(room.frames[4:6])
    few = MultiviewDepth(room.sequence(), SIDE, PLANES, lambda: tmp_path, 3, SilentProgress())
    few.fit(room.frames[6:8])
    for frame in room.frames[4:8]:
        ours, theirs = (p._path(frame.id).read_bytes() for p in (few, stereo))
        assert ours == theirs


def test_two_threads_may_ask_for_depths_at_once(room: Room, stereo: MultiviewDepth) -> None:
    """Each needs the depths of others, which the other thread may just be making."""
    alone = [stereo.estimate(frame) for frame in room.frames[:6]]
    fresh = MultiviewDepth(room.sequence(), SIDE, PLANES, stereo._folder, 2, SilentProgress())
    with ThreadPoolExecutor(2) as pool:
        for own, found in zip(alone, pool.map(fresh.estimate, room.frames[:6]), strict=True):
            np.testing.assert_array_equal(own.depth, found.depth)
            np.testing.assert_array_equal(own.confidence, found.confidence)


def test_both_rounds_of_completion_ask_the_same_views_where_one_is_missing(
    room: Room, stereo: MultiviewDepth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh = MultiviewDepth(room.sequence(), SIDE, PLANES, lambda: tmp_path, 2, SilentProgress())
    missing = room.frames[int(fresh._neighbours(4, 3)[1])]
    for file in stereo._folder().iterdir():
        if file.name != stereo._path(missing.id).name:
            shutil.copy(file, tmp_path)
    asked: list[list[np.ndarray]] = []
    monkeypatch.setattr(stereo_provider, "build_inputs", lambda *given: asked.append(given[3]) or True)
    monkeypatch.setattr(stereo_provider, "update_view_evidence", lambda case, others, warps: asked.append(warps))
    monkeypatch.setattr(fresh, "_completed", lambda index: index)
    fresh.inputs(4)
    assert len(asked) == 2
    assert len(asked[0]) == len(asked[1]) == min(6, len(room.frames) - 2)
    np.testing.assert_array_equal(asked[0], asked[1])


def test_multiview_without_parallax_says_so(room: Room) -> None:
    still = Sequence(room.frames, room.calibration, room.calibration.intrinsics, None, lambda f: room.views[f.id].rgb)
    with pytest.raises(InputError, match="parallax"):
        MultiviewDepth(still, SIDE, PLANES, lambda: Path("nowhere"), 1, SilentProgress())
    with pytest.raises(InputError, match="poses"):
        ShapeLabels(still, 16, SilentProgress())


class Learned:
    """A network's output: the truth in metres with a smooth error in each frame and a scale error of its own."""

    name, metric = "learned", True

    def __init__(self, room: Room) -> None:
        self._room = room

    def missing(self, frames: list[Frame]) -> list[Frame]:
        return []

    def fit(self, frames: list[Frame]) -> None:
        pass

    def estimate(self, frame: Frame) -> DepthEstimate:
        truth = self._room.views[frame.id].depth
        y, x = np.indices(truth.shape) / 60
        field = 0.05 * np.sin(x + frame.id) * np.cos(1.3 * y - frame.id) + 0.02 * np.sin(2.7 * frame.id)
        depth = (truth * np.exp(field)).astype(np.float32)
        return DepthEstimate(depth, np.full(depth.shape, 0.9, np.float32))

    def figures(self) -> dict[str, float]:
        return {}


def test_fused_depth_is_metric_and_better_than_either(room: Room, stereo: MultiviewDepth) -> None:
    learned = Learned(room)
    fused = FusedDepth(learned, stereo, room.sequence())
    fused.fit(room.frames)
    assert fused.metric
    scale = measure_scale(room.sequence(), room.frames, fused.estimate).value * UNIT
    assert scale == pytest.approx(1, abs=0.03)
    table = []
    for frame in room.frames[2:9:2]:
        together = relative_errors(room, fused.estimate(frame), frame, scale)
        network = relative_errors(room, learned.estimate(frame), frame, 1.0)
        geometry = relative_errors(room, stereo.estimate(frame), frame)
        table.append([[e.mean(), np.median(e)] for e in (together, network, geometry)])
    together, network, geometry = np.mean(table, axis=0)
    assert (together > 0).all()
    assert (together < 0.17 * network).all()
    assert (together < np.add(geometry, [0, 1e-5])).all()


class Poor(Learned):
    """A network that takes bright for near, alike in all frames."""

    def estimate(self, frame: Frame) -> DepthEstimate:
        view = self._room.views[frame.id]
        depth = (3 * np.exp(-view.rgb.mean(-1) / 128)).astype(np.float32)
        return DepthEstimate(depth, np.full(depth.shape, 0.5, np.float32))


def test_a_poor_network_changes_little(room: Room, stereo: MultiviewDepth) -> None:
    fused = FusedDepth(Poor(room), stereo, room.sequence())
    fused.fit(room.frames)
    scale = measure_scale(room.sequence(), room.frames, fused.estimate).value * UNIT
    together = [relative_errors(room, fused.estimate(f), f, scale).mean() for f in room.frames[2:9:2]]
    geometry = [relative_errors(room, stereo.estimate(f), f).mean() for f in room.frames[2:9:2]]
    assert 0 < np.mean(together) < 1.04 * np.mean(geometry)


def test_blurred_steps_of_depth_are_steps_again_and_slopes_stay() -> None:
    y, x = np.indices((120, 160))
    slope = 2 + 0.004 * x + 0.002 * y
    truth = np.where(x < 80, slope, 1.6 * slope)
    blurred = (1 / cv2.GaussianBlur(1 / truth, (0, 0), 0.8)).astype(np.float32)
    blurred[:10, :10] = 0
    sharp = sharpen_steps(blurred)
    before, after = (np.abs(d / truth - 1)[10:, 70:90].mean() for d in (blurred, sharp))
    assert 0 < after < 0.25 * before
    np.testing.assert_allclose(sharp[:, :70], blurred[:, :70], rtol=1e-6)
    assert (sharp[blurred == 0] == 0).all()


@pytest.mark.parametrize(
    ("error", "may_fuse", "expected"),
    [(0.0, True, False), (0.05, True, True), (0.05, False, False)],
)
def test_files_no_better_than_a_network_are_fused_as_one(
    error: float, may_fuse: bool, expected: bool, room: Room, tmp_path: Path
) -> None:
    source = write_source(room, tmp_path)
    for frame in room.frames:
        y, x = np.indices(room.views[frame.id].depth.shape) / 40
        off = room.views[frame.id].depth * (1 + 1.4 * error * np.sin(x + frame.id) * np.cos(1.3 * y))
        write_grey_png(tmp_path / "depth" / frame.name, np.round(off * 1000).astype(np.uint16))
    config = ProxyConfig(depth=f"files:{tmp_path / 'depth'}")
    around = ProviderContext(
        source, room.sequence(), config, lambda name: tmp_path / name, 1, "cpu", SilentProgress(), may_fuse=may_fuse
    )
    assert isinstance(open_depth(around), FusedDepth) == expected


def test_two_guesses_that_miss_differently_are_better_together() -> None:
    shape = (60, 80)
    whole = np.full(shape, 2.0, np.float32)
    confidence = np.full(shape, 0.8, np.float32)
    guess = whole.copy()
    guess[:, 40:], confidence[:, 40:] = 2.2, 0.1  # the geometry guesses 10 % too far
    guess[20:40, 60:] = 6.0  # and there wildly
    strays = 1 + 0.08 * (-1.0) ** np.arange(60)[:, None]  # a poor network
    depth = (whole * np.where(np.arange(80) < 40, strays, 0.95)).astype(np.float32)
    learned = DepthEstimate(depth, np.ones_like(whole))
    fused = fuse_with_stereo(learned.depth, learned, DepthEstimate(guess, confidence))
    error = np.abs(fused.depth / whole - 1)
    assert error[:, :40].max() < 3e-3
    assert error[:15, 66:].max() < 0.05
    assert fused.depth[:15, 66:].min() > 0.95 * 2.0  # between the two
    assert np.abs(fused.depth[22:38, 66:] / whole[22:38, 66:] - 0.95).max() < 0.01


def test_a_portrait_image_is_fused_like_a_landscape_one_on_its_side() -> None:
    rng = np.random.default_rng(3)
    ratio, confidence = np.exp(rng.normal(0, 0.05, (48, 96))), np.where(rng.random((48, 96)) < 0.3, 0.9, 0.0)

    def fused(turns: int) -> np.ndarray:
        geometry = DepthEstimate(*(np.rot90(a, turns).astype(np.float32) for a in (2 * ratio, confidence)))
        learned = DepthEstimate(np.full_like(geometry.depth, 2.0), np.ones_like(geometry.depth))
        return np.rot90(fuse_with_stereo(learned.depth, learned, geometry).depth, -turns)

    np.testing.assert_allclose(fused(1), fused(0), rtol=1e-5)


def test_regions_mean_the_same_in_all_frames_and_know_the_floor(room: Room) -> None:
    truth = {
        f.id: DepthEstimate(room.views[f.id].depth * np.float32(UNIT), np.full(room.views[0].depth.shape, 0.9, "f4"))
        for f in room.frames
    }
    sequence = room.sequence()
    segments = ShapeLabels(sequence, 16, SilentProgress())
    segments.fit(room.frames, lambda frame: truth[frame.id])
    names = segments.classes().names
    assert {"floor", "wall"} <= set(names)
    assert 4 <= len(names) <= 16
    labels = {f.id: segments.estimate(f, truth[f.id]).labels for f in room.frames}
    agreements = [flicker_free(labels, truth, sequence, a, b) for a, b in pairwise(room.frames)]
    assert min(agreements) > 0.75
    found = np.stack([labels[f.id] == names.index("floor") for f in room.frames])
    height = np.stack([world_height(room, f, sequence.intrinsics) for f in room.frames])
    true_floor = np.abs(height - np.quantile(height, 0.002)) < 0.02
    assert (found & true_floor).sum() / (found | true_floor).sum() > 0.75
    assert np.mean([(v == VOID).mean() for v in labels.values()]) < 0.02


def flicker_free(labels: dict, truth: dict, sequence: Sequence, a: Frame, b: Frame) -> float:
    b_from_a = sequence.cam_from_world[b.id] @ np.linalg.inv(sequence.cam_from_world[a.id])
    warped = warp_labels(labels[b.id], b_from_a, truth[a.id].depth, sequence.intrinsics)
    return float(mean_iou(labels[a.id], warped[None])[0])


def warp_labels(labels: np.ndarray, other_from_cam: np.ndarray, depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """The other frame's labels as this frame sees them through its own depth; VOID where that leaves the image."""
    v, u = np.indices(depth.shape) + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    points = (rays * depth[..., None]) @ other_from_cam[:3, :3].T + other_from_cam[:3, 3]
    z = np.where((depth > 0) & (points[..., 2] > 0), points[..., 2], np.inf)
    column = np.floor(camera.fx * points[..., 0] / z + camera.cx).astype(int)
    row = np.floor(camera.fy * points[..., 1] / z + camera.cy).astype(int)
    height, width = depth.shape
    inside = np.isfinite(z) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, labels[np.where(inside, row, 0), np.where(inside, column, 0)], VOID).astype(np.uint8)


def world_height(room: Room, frame: Frame, camera: Intrinsics) -> np.ndarray:
    view = room.views[frame.id]
    v, u = np.indices(view.depth.shape) + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    points = (rays * view.depth[..., None]) @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3]
    up = -np.mean([w.world_from_cam[:3, 1] for w in room.views], axis=0)
    axis = int(np.abs(up).argmax())
    return points[..., axis] * np.sign(up[axis])
