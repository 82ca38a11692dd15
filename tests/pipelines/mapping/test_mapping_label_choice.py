"""MSGS-SLAM eq. (12): who stands beside a new keyframe."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.mapping.load import MappingInput
from msgs_slam.pipelines.mapping.paper.label_choice import label_likeness
from msgs_slam.pipelines.mapping.schedule import Schedule
from msgs_slam.pipelines.types import VOID


def test_likeness_is_the_mean_iou_of_labels(room: MappingInput) -> None:
    channels = torch.zeros((60, 80), dtype=torch.uint8)
    half, void = channels.clone(), torch.full_like(channels, VOID)
    half[:, 40:] = 1
    views = [replace(room.views[0], channels=c) for c in (channels, channels, half, void)]
    expected = np.eye(4)
    expected[0, 1] = expected[1, 0] = 1
    expected[:2, 2] = expected[2, :2] = 0.25  # class 0: half of the picture, class 1: none of it
    assert label_likeness(views) == pytest.approx(expected)


def test_beside_a_new_keyframe_stand_those_that_show_other_things(room: MappingInput) -> None:
    settings, alike = MappingConfig(passes=0.0, min_iterations=0), label_likeness(room.views)
    limit = float(np.quantile(alike[alike < 1], 0.4))
    plain, chosen = (
        Schedule.plan(room.views, settings, seed=1, seeding=True, passes=None, keyframe_miou=t) for t in (0.0, limit)
    )
    drawn = {
        name: [(now, s.step(2 * now + 1).view) for now in range(1, len(room.views))]
        for name, s in (("plain", plain), ("chosen", chosen))
    }
    possible = [now for now in range(1, len(room.views)) if (chosen.overlap[[now], :now].toarray() > 0.08).any()]
    assert len(possible) > 3
    assert all(alike[now, view] < limit for now, view in drawn["chosen"] if now in possible)
    assert any(alike[now, view] >= limit for now, view in drawn["plain"])
