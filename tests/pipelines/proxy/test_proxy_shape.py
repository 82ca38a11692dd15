"""What the network of shapes is shown, and what it says of the known room."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from proxy_room import UNIT, Room

from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.geometry.voxels import Voxels
from msgs_slam.pipelines.labels.named import ShapeLabels
from msgs_slam.pipelines.labels.segments import Segments
from msgs_slam.pipelines.labels.shape import CHANNELS, SIDE, RoomShape, _columns
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Frame
from tests.world.room import CLASSES

TRUE_NAMES = tuple(name for name, _ in CLASSES)


def shown(room: Room, backbone: SparseModel, unit: float) -> NDArray[np.float32]:
    """(CHANNELS, h, w) of a keyframe in the middle."""
    sequence = replace(room.sequence(), backbone=backbone)

    def depth_of(frame: Frame) -> DepthEstimate:
        depth = (room.views[frame.id].depth * unit).astype(np.float32)
        return DepthEstimate(depth, (depth > 0).astype(np.float32) * np.float32(0.8))

    voxels, gravity, kind = Segments(sequence, SilentProgress()).structure(room.frames, depth_of)
    centres = np.array([np.linalg.inv(pose)[:3, 3] for pose in backbone.cam_from_world])
    shape = RoomShape.of(voxels, gravity, kind, centres)
    frame = room.frames[len(room.frames) // 2]
    return shape.channels(sequence, frame, depth_of(frame))


def test_neither_the_unit_nor_the_axes_of_the_world_show(room: Room) -> None:
    before = shown(room, room.backbone, UNIT)
    assert before.shape[0] == CHANNELS
    assert max(before.shape[1:]) == SIDE
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.sign(np.linalg.det(turn))
    poses = room.backbone.cam_from_world.copy()
    poses[:, :3, 3] *= 3
    after = shown(room, replace(room.backbone, cam_from_world=poses @ turn), 3 * UNIT)
    assert 0 < np.median(np.abs(after - before).max(0)) < 0.1  # voxels lie otherwise
    assert np.mean(np.abs(after - before)) < 0.03


def test_names_by_shape_are_right_of_floor_table_sofa_and_walls(room: Room) -> None:
    """A room by another hand than those that were learned from."""
    labels = ShapeLabels(room.sequence(), 16, SilentProgress())

    def depth_of(frame: Frame) -> DepthEstimate:
        depth = (room.views[frame.id].depth * UNIT).astype(np.float32)
        return DepthEstimate(depth, (depth > 0).astype(np.float32) * np.float32(0.8))

    labels.fit(room.frames, depth_of)
    names = labels.classes().names
    found = np.stack([labels.estimate(f, depth_of(f)).labels for f in room.frames])
    truth = np.stack([room.views[f.id].labels for f in room.frames])
    for name, others, least in (("floor", ["rug"], 0.85), ("table", [], 0.75), ("seating", ["sofa", "cushion"], 0.6)):
        ours, true = (
            found == names.index(name),
            np.isin(truth, [TRUE_NAMES.index(n) for n in (*others, name) if n in TRUE_NAMES]),
        )
        assert least < (ours & true).sum() / (ours | true).sum() < 1
    walls = np.isin(truth, [TRUE_NAMES.index("wall"), TRUE_NAMES.index("picture")])
    assert 0.6 < (found == names.index("wall"))[walls].mean() < 1
    assert set(names) <= {*labels.figures()["vocabulary"], *(f"object {i}" for i in range(1, 16))}


def test_a_scene_without_any_surface_has_a_shape_all_the_same(room: Room) -> None:
    labels = Segments(room.sequence(), SilentProgress())
    nothing = np.zeros(room.views[0].depth.shape, np.float32)
    nothing[0, :40] = 1  # too little of everything to be anywhere twice

    def depth_of(frame: Frame) -> DepthEstimate:
        return DepthEstimate(nothing, nothing * np.float32(0.31))

    voxels, gravity, kind = labels.structure(room.frames[:2], depth_of)
    shape = RoomShape.of(voxels, gravity, kind, np.zeros((2, 3)))
    assert np.isfinite(shape.channels(room.sequence(), room.frames[0], depth_of(room.frames[0]))).all()


def test_columns_reach_to_the_next_and_a_far_place_costs_nothing() -> None:
    position = np.array([[0.5, 0.5, 1.0], [2.5, 0.5, 3.0], [0.5, 4.5, 2.0], [2e6, -2e6, 9.0]])
    voxels = Voxels(1.0, np.arange(4), np.ones(4), position, np.tile([0.0, 0, 1], (4, 1)), np.zeros((4, 3)))
    low, high = _columns(voxels, np.array([0.0, 0, 1]), position[:, 2])
    assert low.tolist() == [1, 1, 2, 9]
    assert high.tolist() == [3, 3, 2, 9]
