"""Names brought together in the world, against the known room; what geometry and the scene say of them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from proxy_room import UNIT, Room

from msgs_slam.pipelines.evaluation.labels import count_labels, score
from msgs_slam.pipelines.geometry import voxels
from msgs_slam.pipelines.geometry.sequence import resample_linear
from msgs_slam.pipelines.geometry.voxels import FLOOR, OTHER, Gravity, Voxels, merge, voxel_keys
from msgs_slam.pipelines.labels.named import (
    NamedScene,
    NetworkClasses,
    ShapeLabels,
    disputed,
    name_likelihood,
    one_name_each,
    recognise,
)
from msgs_slam.pipelines.labels.segments import Segments
from msgs_slam.pipelines.labels.shape import NAMES as SHAPE_NAMES
from msgs_slam.pipelines.networks.outputs import best_classes
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Frame
from tests.world.room import CLASSES

NAMES = tuple(name for name, _ in CLASSES)
UP = Gravity(np.array([0.0, 0, 1]), True)


def coarse(labels: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """(12, 16, C): what a network with samples 16 pixels apart would say, with a mistake in every tenth."""
    small = cv2.blur((labels[..., None] == np.arange(len(NAMES))).astype(np.float32), (24, 24))[8::16, 8::16] + 0.01
    rows, columns = np.nonzero(rng.random(small.shape[:2]) < 0.1)
    small[rows, columns, rng.integers(1, len(NAMES), len(rows))] += 1.5
    return small / small.sum(-1, keepdims=True)


def miou(room: Room, shown: dict[int, NDArray]) -> float:
    classes = len(NAMES)
    total = sum(count_labels(found, room.views[i].labels, classes, classes) for i, found in shown.items())
    found = score(np.asarray(total))
    assert found is not None
    return found.mean_iou


def depth_of(room: Room, frame: Frame) -> DepthEstimate:
    depth = (room.views[frame.id].depth * UNIT).astype(np.float32)
    return DepthEstimate(depth, (depth > 0).astype(np.float32) * 0.8)


def gather(room: Room, said: dict[int, NDArray[np.float32]], vocabulary: NetworkClasses) -> NamedScene:
    segments = Segments(room.sequence(), SilentProgress())
    return NamedScene.gather(segments, room.frames, lambda f: depth_of(room, f), lambda f: said[f.id], vocabulary)


def test_frames_together_name_the_room_better_than_each_alone(room: Room) -> None:
    rng = np.random.default_rng(3)
    said = {f.id: coarse(room.views[f.id].labels, rng) for f in room.frames}
    scene = gather(room, said, NetworkClasses(NAMES, (0,), 16))
    index = np.array([*(NAMES.index(n) if n in NAMES else VOID for n in scene.names)] + [VOID] * 256, np.uint8)
    together, alone = {}, {}
    for frame in room.frames:
        together[frame.id] = index[scene.estimate(room.sequence(), frame, depth_of(room, frame), said[frame.id]).labels]
        shape = room.views[frame.id].labels.shape
        alone[frame.id] = best_classes(resample_linear(said[frame.id], *shape), (0,))[0].astype(np.uint8)
    assert miou(room, alone) + 0.1 < miou(room, together) < 0.99


def test_what_has_no_name_becomes_numbered_objects(room: Room) -> None:
    """The network knows the walls and the floor alone; the rest is "none" to it."""
    known = [i for i, n in enumerate(NAMES) if n in ("wall", "floor")]
    said = {}
    for frame in room.frames:
        labels = np.where(np.isin(room.views[frame.id].labels, known), room.views[frame.id].labels, 0).astype(np.uint8)
        said[frame.id] = coarse(labels, np.random.default_rng(0)) * np.isin(np.arange(len(NAMES)), [0, *known])
    scene = gather(room, said, NetworkClasses(NAMES, (0,), 6))
    assert set(scene.names[:2]) == {"wall", "floor"}
    assert scene.names[2:] == tuple(f"object {i + 1}" for i in range(4))
    assert (scene.kept[2:] == -1).all()
    assert (scene.kept[:2] == [NAMES.index(n) for n in scene.names[:2]]).all()
    found = scene.estimate(room.sequence(), room.frames[5], depth_of(room, room.frames[5]), said[5])
    assert len(np.unique(found.labels[found.labels != VOID])) >= 4


def test_a_frame_without_pose_keeps_what_it_said(room: Room) -> None:
    said = {f.id: coarse(room.views[f.id].labels, np.random.default_rng(1)) for f in room.frames}
    scene = gather(room, said, NetworkClasses(NAMES, (0,), 16))
    elsewhere = replace(room.sequence(), read_image=lambda frame: room.views[0].rgb)
    known = room.views[0].labels
    found = scene.estimate(elsewhere, Frame(99, "lost.png", 9.9, 99, 1.0), depth_of(room, room.frames[0]), said[0])
    names = np.array([*scene.names, "void"])[np.minimum(found.labels, len(scene.names))]
    assert 0.7 < (names == np.array(NAMES)[known]).mean() < 0.99
    assert 0.1 < found.confidence.min() < found.confidence.max() < 0.95


def test_a_room_of_which_nothing_is_sure_has_the_names_of_each_frame_alone(room: Room) -> None:
    """One sure pixel a frame, and none of them a voxel's worth."""

    def scattered(frame: Frame) -> DepthEstimate:
        depth = depth_of(room, frame)
        confidence = np.zeros_like(depth.confidence)
        confidence[::41, ::37] = 0.9
        return replace(depth, depth=np.where(confidence > 0, depth.depth, 0).astype(np.float32), confidence=confidence)

    said = {f.id: coarse(room.views[f.id].labels, np.random.default_rng(1)) for f in room.frames}
    segments = Segments(room.sequence(), SilentProgress())
    scene = NamedScene.gather(segments, room.frames, scattered, lambda f: said[f.id], NetworkClasses(NAMES, (0,), 16))
    assert len(scene.keys) == 0
    assert "wall" in scene.names
    found = scene.estimate(room.sequence(), room.frames[0], scattered(room.frames[0]), said[0])
    names = np.array([*scene.names, "void"])[np.minimum(found.labels, len(scene.names))]
    assert (names == np.array(NAMES)[room.views[0].labels]).mean() > 0.5
    labels = ShapeLabels(room.sequence(), 16, SilentProgress())
    labels.fit(room.frames, scattered)
    alone = labels.estimate(room.frames[0], scattered(room.frames[0]))
    assert (alone.labels == VOID).all()
    assert not alone.confidence.any()
    assert len(segments.heights(room.frames, scattered)) == 0


def voxels_of(positions: list[tuple[float, float, float]], normals: list[tuple[float, float, float]]) -> Voxels:
    points = np.array(positions, float)
    keys = voxel_keys(points, 1.0)
    order = np.argsort(keys)
    normal = np.array(normals, float)
    return Voxels(1.0, keys[order], np.ones(len(keys)), points[order], normal[order], np.zeros((len(keys), 3)))


def test_floors_lie_and_walls_stand() -> None:
    names = ("floor", "wall", "ceiling", "chair")
    voxels = voxels_of([(0, 0, 0), (1, 0, 5), (2, 0, 9)], [(0, 0, 1), (1, 0, 0), (0, 0, -1)])
    likely = name_likelihood(names, voxels, UP, np.array([FLOOR, OTHER, OTHER]), 5.0)
    assert (likely[:, 0] == [1, likely[1, 0], likely[2, 0]]).all()
    assert likely[1, 0] < 0.2
    assert likely[0, 1] < 0.2
    assert likely[1, 1] == 1
    assert likely[0, 2] < 0.2
    assert likely[2, 2] == 1
    assert (likely[1:, 3] == 1).all()
    assert (name_likelihood(names, voxels, Gravity(UP.up, False), np.zeros(3, np.int64), 5.0) == 1).all()


def test_shape_names_what_a_network_takes_for_a_wall_and_nothing_else() -> None:
    names = ("wall", "floor", "ceiling", "door", "seating", "table", "storage", "picture")
    share = np.zeros((3, len(names)), np.float32)
    share[:, 0], share[:, 7] = [1, 0.5, 0], [0, 0.5, 1]
    said = np.zeros((3, len(SHAPE_NAMES)), np.float32)
    said[:, SHAPE_NAMES.index("storage")], said[:, SHAPE_NAMES.index("window")] = 0.8, 0.2
    recognise(share, names, said)
    assert np.allclose(share.sum(1), 1)
    assert share[:, names.index("storage")] == pytest.approx([0.8, 0.4, 0])
    assert share[:, names.index("picture")] == pytest.approx([0, 0.5, 1])
    finer = ("wall", "floor", "cabinet")
    before = np.full((3, 3), 1 / 3, np.float32)
    recognise(after := before.copy(), finer, said)
    assert (after == before).all()


def test_a_thing_has_one_name_and_its_neighbour_another() -> None:
    names = ("sofa", "armchair", "floor")
    places = [(x, 0, 0) for x in range(4)] + [(x, 0, 0) for x in range(8, 10)]
    voxels = voxels_of(places, [(0, 0, 1)] * 6)
    share = np.array(
        [[0.7, 0.3, 0], [0.6, 0.4, 0], [0.4, 0.6, 0], [0.1, 0.0, 0.9], [0.3, 0.7, 0], [0.2, 0.8, 0]], np.float32
    )
    one_name_each(share, names, voxels)
    assert share.argmax(1).tolist() == [0, 0, 0, 2, 1, 1]
    assert np.allclose(share.sum(1), 1)


def test_parts_that_do_not_agree_keep_their_own_names() -> None:
    """A chair beside what passes for a bed: as much of one as of the other."""
    names = ("bed", "seating", "floor")
    voxels = voxels_of([(x, 0, 0) for x in range(6)], [(0, 0, 1)] * 6)
    share = np.array([[0.9, 0.1, 0]] * 3 + [[0.3, 0.7, 0]] * 2 + [[0, 0, 1]], np.float32)
    before = share.copy()
    one_name_each(share, names, voxels)
    assert (share == before).all()
    assert disputed(share.argmax(1), names, voxels).tolist() == [True] * 5 + [False]
    share[3] = [0.6, 0.4, 0]
    assert not disputed(share.argmax(1), names, voxels).any()
    one_name_each(share, names, voxels)
    assert share.argmax(1).tolist() == [0] * 5 + [2]
    assert not disputed(np.full(6, VOID, np.uint8), names, voxels).any()


def test_voxels_of_many_frames_are_summed_as_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the same bytes as all at once."""
    rng = np.random.default_rng(0)
    frames = [(np.sort(rng.integers(0, 60, 40)), rng.random((40, 10))) for _ in range(30)]
    at_once = merge(0.05, frames)
    monkeypatch.setattr(voxels, "_WAITING", 100)
    as_they_come = merge(0.05, iter(frames))
    assert len(at_once) == 60
    for name in ("keys", "weight", "position", "normal", "color"):
        assert getattr(as_they_come, name).tobytes() == getattr(at_once, name).tobytes()
    assert len(merge(0.05, [])) == 0


def test_voxels_grow_where_a_scene_has_too_many() -> None:
    """As if all points had been gathered in the larger ones, but for points near their sides."""
    rng = np.random.default_rng(0)
    points = rng.random((20, 500, 3)) * [4.0, 4.0, 0.01]

    def gathered(size: float) -> list[tuple[np.ndarray, np.ndarray]]:
        rows = []
        for of_frame in points:
            keys, place = np.unique(voxel_keys(of_frame, size), return_inverse=True)
            values = np.concatenate([np.ones((500, 1)), of_frame, np.ones((500, 6))], axis=1)
            rows.append((keys, np.stack([np.bincount(place, v) for v in values.T], axis=1)))
        return rows

    grown = merge(0.05, gathered(0.05), limit=2000)
    plain = merge(0.1, gathered(0.1))
    assert grown.size == pytest.approx(0.1)
    assert len(grown) == pytest.approx(len(plain), rel=0.05)
    assert len(grown) <= 2000 < len(merge(0.05, gathered(0.05)))
    assert grown.weight.sum() == plain.weight.sum() == 10_000
    np.testing.assert_allclose(grown.weight @ grown.position, points.sum((0, 1)))
    assert (voxel_keys(grown.position, grown.size) == grown.keys).mean() > 0.9
