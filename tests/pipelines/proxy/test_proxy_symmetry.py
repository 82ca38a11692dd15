"""Mirror symmetry: found in a room that is its own mirror image, silent in one that is not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from proxy_room import Room, perfect_backbone

from msgs_slam.pipelines.correspondence.features import extract_features, to_grey
from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.geometry.camera import project, unproject, unproject_depth
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.proxy import symmetry
from msgs_slam.pipelines.proxy.mirror_features import mirror_descriptors, mirrored_matches
from msgs_slam.pipelines.proxy.providers import DepthEstimate
from msgs_slam.pipelines.proxy.sequence import Sequence
from msgs_slam.pipelines.proxy.stage import run
from msgs_slam.pipelines.proxy.symmetry import MirrorPlane, find_mirror_planes, mirror_pairs
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.proxy_files import save_mirror_pairs
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Features, Frame, Intrinsics, MirrorPairs
from tests.world import WorldFrame

CAMERA = Intrinsics(320, 240, 260, 260, 160, 120)
HALF = np.array([2.0, 1.5, 3.0])
"""The room spans -HALF..HALF; its mirror plane is x = 0."""


def noise(rng: np.random.Generator, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth values in 0..1 at points (..., 3): a few dozen waves of all directions."""
    waves = rng.normal(size=(40, 3)) * 9
    phase = rng.uniform(0, 6.28, 40)
    return 0.5 + 0.09 * np.sin(points @ waves.T + phase).sum(-1)


def picture(cam_from_world: NDArray[np.float64], symmetric: bool) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image and depth inside a box whose walls carry the texture of |x|, or of x."""
    world_from_cam = np.linalg.inv(cam_from_world)
    rays = unproject_depth(np.ones((CAMERA.height, CAMERA.width)), CAMERA) @ world_from_cam[:3, :3].T
    origin = world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.min((np.sign(rays) * HALF - origin) / rays, axis=-1)
    points = origin + depth[..., None] * rays
    points[..., 0] = np.abs(points[..., 0]) if symmetric else points[..., 0]
    channels = [noise(np.random.default_rng(seed), points) for seed in range(3)]
    image = np.clip(255 * np.stack(channels, -1), 0, 255).astype(np.uint8)
    return image, depth.astype(np.float32)


def walk(symmetric: bool, count: int = 8) -> tuple[Sequence, list[DepthEstimate]]:
    """A sideways walk, not along the mirror plane and turned against it."""
    poses = []
    for i in range(count):
        turn = cv2.Rodrigues(np.array([0.03, 0.12 - 0.03 * i, 0.02 * i]))[0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ [0.7 - 0.12 * i, 0.1, -1.5]
        poses.append(pose)
    shots = [picture(p, symmetric) for p in poses]
    frames = [Frame(i, f"{i}.png", i / 10, i, 1.0) for i in range(count)]
    none = np.zeros(0, np.int64)
    model = SparseModel(
        np.arange(count), np.array(poses), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none, np.zeros((0, 2))
    )
    calibration = Calibration(CAMERA, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(1)
    noisy = [(d * (1 + rng.normal(size=d.shape) * 0.003)).astype(np.float32) for _, d in shots]
    estimates = [DepthEstimate(d, np.ones_like(d)) for d in noisy]
    return Sequence(frames, calibration, CAMERA, model, lambda f: shots[f.id][0]), estimates


def features(sequence: Sequence, frame: Frame) -> Features:
    return extract_features(to_grey(sequence.image(frame)), 1500, threshold=0.005)


def search(sequence: Sequence, estimates: list[DepthEstimate]) -> list[MirrorPlane]:
    return find_mirror_planes(
        sequence, sequence.frames, lambda f: estimates[f.id], lambda f: features(sequence, f), SilentProgress()
    )


def test_mirrored_descriptors_are_those_of_the_mirrored_picture() -> None:
    image, _ = picture(np.eye(4), symmetric=False)
    sift = cv2.SIFT.create(nfeatures=200)
    keypoints, descriptors = sift.detectAndCompute(image, None)
    flipped, theirs = sift.detectAndCompute(np.ascontiguousarray(image[:, ::-1]), None)
    there = np.array([(CAMERA.width - 1 - k.pt[0], k.pt[1]) for k in flipped])
    mirrored = mirror_descriptors(theirs)
    distances = []
    for keypoint, own in zip(keypoints, descriptors, strict=True):
        same = np.linalg.norm(there - keypoint.pt, axis=1) < 0.5
        if same.any():
            distances.append(np.linalg.norm(mirrored[same] - own, axis=1).min() / np.linalg.norm(own))
    assert len(distances) > 40
    assert 0 < np.median(distances) < 0.1
    plain = np.linalg.norm(theirs[: len(descriptors)] - descriptors[: len(theirs)], axis=1).mean()
    assert plain > 200


def test_a_symmetric_room_has_its_plane_and_pairs() -> None:
    sequence, estimates = walk(symmetric=True)
    planes = search(sequence, estimates)
    assert len(planes) >= 1
    plane = planes[0]
    assert abs(plane.normal[0]) > np.cos(np.radians(1))
    assert 0 <= abs(plane.offset) < 0.02
    assert 0.6 < plane.confidence <= 1
    frame = sequence.frames[3]
    pose = sequence.cam_from_world[frame.id]
    depth = estimates[frame.id].depth.copy()
    u = np.full(depth.shape, 0.9, np.float32)
    # A corner without reliable depth is still the partner of the other side.
    depth[60:110, 30:80] *= 1.3
    u[60:110, 30:80] = 0.1
    pairs = mirror_pairs(sequence.image(frame), depth, u, CAMERA, [(plane.in_cam(pose), plane.confidence)])
    assert len(pairs) > 200
    assert 0.25 <= pairs.confidence.min() <= pairs.confidence.max() <= 1
    exact = picture(pose, symmetric=True)[1].astype(np.float64)
    first = exact[np.floor(pairs.pairs[:, 1]).astype(int), np.floor(pairs.pairs[:, 0]).astype(int)]
    world_from_cam = np.linalg.inv(pose)
    points = unproject(pairs.pairs[:, :2].astype(np.float64), first, CAMERA)
    points = points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    points[:, 0] *= -1
    xy, z = project(points @ pose[:3, :3].T + pose[:3, 3], CAMERA)
    error = np.linalg.norm(xy - pairs.pairs[:, 2:], axis=1)
    assert 0 < np.median(error) < 1.5
    assert np.percentile(error, 95) < 5
    assert pairs.gain * first + pairs.offset == pytest.approx(z, rel=0.02)
    partner = np.floor(pairs.pairs[:, 2:]).astype(int)
    assert (u[partner[:, 1], partner[:, 0]] < 0.35).sum() > 5
    # None starts from depth that is not trusted.
    start = np.floor(pairs.pairs[:, :2]).astype(int)
    assert (u[start[:, 1], start[:, 0]] > 0.35).all()


def test_a_room_without_symmetry_is_silent() -> None:
    sequence, estimates = walk(symmetric=False)
    assert len(mirrored_matches(features(sequence, sequence.frames[0])).xy) > 5
    assert search(sequence, estimates) == []
    image, first = sequence.image(sequence.frames[0]), estimates[0]
    assert len(mirror_pairs(image, first.depth, first.confidence, CAMERA, [])) == 0


def test_a_mirror_image_on_the_very_border_is_inside() -> None:
    """In single precision the last position before the border is the border."""
    image, depth = picture(np.eye(4), symmetric=True)
    u = np.ones(depth.shape, np.float32)
    for shift in (1e-6, 1e-7, 0.0):
        edge = np.array([1.0, 0.0, 0.0, shift])
        assert len(mirror_pairs(image, depth, u, CAMERA, [(edge, 1.0)])) > 100
    assert symmetry._pixels(np.array([[np.float32(319.99999), 240.0], [0.0, 0.0]]), CAMERA).tolist() == [
        [319, 239],
        [0, 0],
    ]


def test_too_little_to_see_is_silent() -> None:
    sequence, estimates = walk(symmetric=True, count=2)
    blank = Sequence(
        sequence.frames, sequence.calibration, CAMERA, sequence.backbone, lambda _: np.full((240, 320, 3), 90, np.uint8)
    )
    assert search(blank, estimates) == []
    lost = Sequence(sequence.frames, sequence.calibration, CAMERA, None, sequence.read_image)
    assert search(lost, estimates) == []


@pytest.mark.parametrize("symmetric", [True, False])
def test_the_stage_leaves_pairs_in_the_unit_of_its_maps(
    make_context: Callable[..., StageContext], symmetric: bool
) -> None:
    sequence, _ = walk(symmetric)
    views = []
    for pose in sequence.cam_from_world.values():
        image, depth = picture(pose, symmetric)
        views.append(WorldFrame(image, depth, np.ones(depth.shape, np.uint8), np.linalg.inv(pose), 0.0))
    room = Room(views, sequence.frames, sequence.calibration, perfect_backbone(views, CAMERA))
    context = make_context(
        "proxy.depth=files", "proxy.semantics=files", "proxy.max_side=240", "paper.symmetry_weight=0.05", room=room
    )
    report = run(context)
    found = context.run.load_symmetry()
    if not symmetric:
        assert (report["mirror_planes"], report["mirror_pairs"], found) == (0, 0, {})
        return
    assert report["mirror_planes"] >= 1
    assert report["mirror_pairs"] == sum(len(p) for p in found.values())
    pairs, depth = found[0], views[0].depth
    assert pairs.pairs[:, ::2].max() > 200  # pixels of the frame, not of the maps
    first, second = (
        depth[np.floor(pairs.pairs[:, k + 1]).astype(int), np.floor(pairs.pairs[:, k]).astype(int)] for k in (0, 2)
    )
    # Metres, although the backbone's unit is another.
    error = np.abs((pairs.gain * first + pairs.offset) / second - 1)
    assert 0 < np.median(error) < 0.01
    assert np.abs(pairs.offset).max() > 0.1


def test_pairs_are_kept_by_frame(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.stage("proxy").mkdir()
    rng = np.random.default_rng(0)
    two, none = (MirrorPairs(*(rng.random((k, 4) if a == 0 else k, np.float32) for a in range(4))) for k in (2, 0))
    save_mirror_pairs(folder.stage("proxy"), {1: none})
    assert folder.load_symmetry() == {}
    save_mirror_pairs(folder.stage("proxy"), {3: two, 4: none, 5: two})
    loaded = folder.load_symmetry()
    assert sorted(loaded) == [3, 5]
    np.testing.assert_array_equal(loaded[5].pairs, two.pairs)
    np.testing.assert_array_equal(loaded[3].offset, two.offset)
    with pytest.raises(ValueError, match="gain"):
        MirrorPairs(two.pairs, two.confidence, two.gain[:1], two.offset)
