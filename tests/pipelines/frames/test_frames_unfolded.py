"""Things that repeat fold a path; what neighbours share unfolds it."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.candidates import KeyframeSet
from msgs_slam.pipelines.sfm.driver import StructureFromMotion
from msgs_slam.pipelines.sfm.flow import Picture
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.matching import VerifiedPair, verify_matches
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Features

SIDES, VIEWS, POINTS, REACH = 4, 48, 300, 8
CAMERA = unknown_camera(480, 360, 400.0, is_prior=True)


def round_room() -> tuple[NDArray[np.float64], list[Features], list[NDArray[np.int64]]]:
    """Centres (48, 3) of views from a walk round a room whose four sides look alike, their features, and the points
    that these are: POINTS of each side, counted on from side to side."""
    rng = np.random.default_rng(0)
    angle, far, height = (rng.uniform(*r, POINTS) for r in ((0, 2 * np.pi / SIDES), (2.5, 4.5), (-1.2, 1.2)))
    sides = [angle + 2 * np.pi / SIDES * side for side in range(SIDES)]
    world = np.concatenate([np.stack([far * np.sin(a), height, far * np.cos(a)], 1) for a in sides])
    turns = 2 * np.pi * np.arange(VIEWS) / VIEWS
    centers = 0.8 * np.stack([np.sin(turns), 0.1 * np.sin(3 * turns), np.cos(turns)], 1)
    features, seen = [], []
    for turn, center in zip(turns, centers, strict=True):
        x, y, z = (world - center).T
        right, ahead = np.cos(turn) * x - np.sin(turn) * z, np.sin(turn) * x + np.cos(turn) * z
        pixels = 400 * np.stack([right, y], 1) / np.where(ahead > 0.3, ahead, np.nan)[:, None] + [240, 180]
        mine = np.flatnonzero(((pixels > 0) & (pixels < [480, 360])).all(1) & (rng.random(len(pixels)) < 0.8))
        noisy = pixels[mine] + rng.normal(0, 0.3, (len(mine), 2))
        keypoints = np.column_stack([noisy, np.ones((len(mine), 2))]).astype(np.float32)
        features.append(Features(keypoints, np.zeros((len(mine), 128), np.uint8)))
        seen.append(mine)
    return centers, features, seen


def matched(features: list[Features], seen: list[NDArray[np.int64]]) -> list[VerifiedPair]:
    """Neighbours by what they share, the last ones and the first ones too; views a side apart by what looks alike."""
    pairs = []
    for i in range(VIEWS):
        for j in range(i + 1, VIEWS):
            are_near = j - i <= REACH or VIEWS - (j - i) <= 2
            if not are_near and (j - i) % (VIEWS // SIDES):
                continue
            ids = [s if are_near else s % POINTS for s in (seen[i], seen[j])]
            _, a, b = np.intersect1d(*ids, return_indices=True)
            xy = features[i].xy, features[j].xy
            if len(a) >= 15 and (pair := verify_matches((i, j), np.stack([a, b], 1).astype(np.uint32), xy, CAMERA, 0)):
                pairs.append(pair)
    return pairs


def no_picture(frame_id: int) -> Picture:
    raise AssertionError(f"nobody needs the picture of frame {frame_id}")


def _counting(mapping: Any, tracks: list[int]) -> Any:
    """The mapper, which notes how many tracks of a view it asks for."""

    def counted(database: Path, images: Path, out: Path, options: pycolmap.GlobalPipelineOptions) -> Any:
        tracks.append(options.mapper.track_required_tracks_per_view)
        return mapping(database, images, out, options)

    return counted


def test_sides_that_look_alike_do_not_fold_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    centers, features, seen = round_room()
    tracks: list[int] = []
    monkeypatch.setattr(pycolmap, "global_mapping", _counting(pycolmap.global_mapping, tracks))
    pairs = matched(features, seen)
    assert sum(p.second - p.first > VIEWS // SIDES - 1 for p in pairs) > 50
    structure = StructureFromMotion(
        config=FramesConfig(overlap=REACH), camera=CAMERA, is_fixed=False, extract=features.__getitem__,
        picture=no_picture, time=float, match=lambda *_: np.zeros((0, 2), np.uint32), snapshots=Snapshots(tmp_path),
        progress=SilentProgress(), threads=1, seed=0,
    )  # fmt: skip
    streamed = LruSequence(VIEWS, features.__getitem__, lambda f: f.nbytes, 1e9)
    given = KeyframeSet(streamed, [f.xy for f in features], np.arange(VIEWS, dtype=float), [])
    folded = structure._build_model("global", given, pairs, pairs)
    found = structure._map(given, pairs)
    assert folded is not None
    assert found is not None
    assert folded[2].contradicted
    assert tracks == [150, 300]  # of a view: a chain of neighbours drifts by 3 m on 150 in a corridor, not in this room
    model, mapper, report = found
    assert mapper == "neighbours"
    assert not report.contradicted
    assert model.num_reg_images() == VIEWS
    placed = np.array([model.images[i + 1].projection_center() for i in range(VIEWS)])
    similarity = align_points(placed, centers, with_scale=True)
    assert np.linalg.norm(similarity.apply(placed) - centers, axis=1).max() < 0.02
