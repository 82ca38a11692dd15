"""Relative depth: frames whose scale and shift differ come to one scale by the points they see."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from proxy_room import UNIT, Room

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.depth.fused import measure_scale
from msgs_slam.pipelines.depth.learned import AlignedDepth, fit_relative, to_depth
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.types import Frame


class Relative:
    """Stands for a network: the truth, with another scale and shift in every frame."""

    name = "onnx:relative"

    def __init__(self, room: Room, relative: str) -> None:
        self._room, self._relative = room, relative
        rng = np.random.default_rng(1)
        self.scales = rng.uniform(0.5, 4, len(room.frames))
        self.shifts = np.zeros(len(room.frames)) if relative == "scale" else rng.uniform(0.1, 0.6, len(room.frames))

    def fit(self, frames: list[Frame]) -> None:
        pass

    def figures(self) -> dict[str, Any]:
        return {}

    def estimate(self, frame: Frame) -> DepthEstimate:
        truth = self._room.views[frame.id].depth.astype(np.float64)
        known = truth > 0
        value = 1 / np.where(known, truth, 1) if self._relative == "inverse" else truth
        value = np.where(known, value * self.scales[frame.id] + self.shifts[frame.id], 0).astype(np.float32)
        return DepthEstimate(value, known.astype(np.float32))


@pytest.mark.parametrize("relative", ["scale", "depth", "inverse"])
def test_frames_of_any_scale_come_to_one(room: Room, relative: str) -> None:
    sequence = room.sequence()
    network: Any = Relative(room, relative)
    provider = AlignedDepth(network, sequence, relative)
    provider.fit(room.frames)
    assert (provider.metric, provider.missing(room.frames)) == (False, [])
    for frame in room.frames[::3]:
        truth = room.views[frame.id].depth * UNIT
        found = provider.estimate(frame)
        known = truth > 0
        error = np.abs(found.depth[known] / truth[known] - 1)
        assert 0 < np.median(error) < 0.005
        assert (found.depth[~known] == 0).all()
        assert (found.confidence[~known] == 0).all()
    scale = measure_scale(sequence, room.frames, provider.estimate)
    assert scale.value == pytest.approx(1, rel=2e-3)
    assert scale.spread < 2e-3
    assert sorted(scale.spread_in) == [f.id for f in room.frames]
    assert 0 < provider.figures()["alignment_error"] < 0.01
    raw = measure_scale(sequence, room.frames, network.estimate)
    assert raw.spread > 0.2


def test_wrong_points_do_not_bend_the_fit() -> None:
    rng = np.random.default_rng(0)
    z = rng.uniform(1, 5, 200)
    values = (1 / z - 0.1) / 2.5
    values[:40] = rng.uniform(0, 0.4, 40)
    fit = fit_relative(values, z, "inverse")
    assert fit == pytest.approx((2.5, 0.1), rel=0.02)
    assert to_depth(np.array([-1.0]), fit, "inverse")[0] == 0


def test_frames_with_few_points_lean_on_their_neighbours_and_no_pose_is_unknown(room: Room) -> None:
    sequence = room.sequence()
    model = room.backbone
    few = model.obs_frame != 5
    few[np.flatnonzero(model.obs_frame == 5)[:4]] = True
    thin = replace(model, obs_frame=model.obs_frame[few], obs_point=model.obs_point[few], obs_xy=model.obs_xy[few])
    network: Any = Relative(room, "scale")
    network.scales[:] = 2.0
    provider = AlignedDepth(network, replace(sequence, backbone=thin), "scale")
    provider.fit(room.frames)
    truth: NDArray[np.float32] = room.views[5].depth * np.float32(UNIT)
    error = np.abs(provider.estimate(room.frames[5]).depth / np.maximum(truth, 1e-6) - 1)[truth > 0]
    assert np.median(error) < 0.01
    stranger = Frame(99, "99.png", 9.9, 99, 1.0)
    assert provider.missing([stranger]) == [stranger]
    with pytest.raises(InputError, match="up to scale"):
        AlignedDepth(network, replace(sequence, backbone=None), "scale")
