"""Learned features, by networks of the real ones' names and shapes: patches of the picture, and their best partners.

What is tested with them is all that is around the networks: padding, pixels, masks, packing, matching, and what is said
where they are missing. One test runs the published weights, where their files lie beside the repository.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import msgs_slam.pipelines.frames.learned as learned
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import noting_files
from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.frames.inputs import check_frames
from msgs_slam.pipelines.frames.learned import (
    EXTRACTOR,
    MATCHER,
    LearnedFeatures,
    open_learned,
)
from msgs_slam.pipelines.geometry.camera import project, unproject
from msgs_slam.pipelines.masks.people import people_cards
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.matching import match_descriptors
from msgs_slam.pipelines.types import Features
from tests.networks import save_network
from tests.world import ClipOptions, make_world, render_frame

STEP, SIDE = 16, 128
"""The stand-in has a feature in each cell; the picture it is made for has this side after padding."""


def write_extractor(path: Path) -> None:
    """Keypoints at the cells' centres; descriptors are the cell's 16 x 16 pixels of the first channel, averaged in
    pairs, without their mean, of length one."""
    cells = SIDE // STEP
    centre = (np.arange(cells) * STEP + (STEP - 1) / 2) / (SIDE - 1) * 2 - 1
    points = np.stack(np.meshgrid(centre, centre), -1).reshape(1, -1, 2).astype(np.float32)
    save_network(
        path,
        "float[1, 3, h, w] image, int64 max_keypoints, float min_score",
        "float[] keypoints, float[] descriptors, float[] scores",
        "red = Slice (image, zero, one, axis)",
        "small = AveragePool <kernel_shape = [1, 2], strides = [1, 2]> (red)",
        "split = Reshape (small, rows)",
        "cells = Transpose <perm = [0, 2, 1, 3]> (split)",
        "patches = Reshape (cells, flat)",
        "mean = ReduceMean <axes = [2]> (patches)",
        "centred = Sub (patches, mean)",
        "descriptors = LpNormalization <axis = 2, p = 2> (centred)",
        "keypoints = Identity (points)",
        "best = ReduceMax <axes = [2], keepdims = 0> (descriptors)",
        "limit = Cast <to = 1> (max_keypoints)",
        "scores = Sum (best, limit, min_score)",
        zero=[0], one=[1], axis=[1], rows=[cells, STEP, cells, STEP // 2], flat=[1, cells**2, 128], points=points,
    )  # fmt: skip


def write_matcher(path: Path) -> None:
    """Each feature's partner is the one of the largest product, which is the score."""
    save_network(
        path,
        "float[1, m, 2] kpts0, float[1, n, 2] kpts1, float[1, m, 128] desc0, float[1, n, 128] desc1, "
        "float[1, 2] image_size0, float[1, 2] image_size1",
        "int64[] matches0, float[] mscores0",
        "turned = Transpose <perm = [0, 2, 1]> (desc1)",
        "alike = MatMul (desc0, turned)",
        "partner = ArgMax <axis = 2, keepdims = 0> (alike)",
        "score = ReduceMax <axes = [2], keepdims = 0> (alike)",
        "matches0 = Squeeze (partner, first)",
        "plain = Squeeze (score, first)",
        *(f"sum_{n} = ReduceSum <keepdims = 0> ({n})" for n in NOT_LOOKED_AT),
        f"all = Sum ({', '.join(f'sum_{n}' for n in NOT_LOOKED_AT)})",
        "none = Mul (all, nothing)",
        "mscores0 = Add (plain, none)",
        first=[0], nothing=0.0,
    )  # fmt: skip


NOT_LOOKED_AT = ("kpts0", "kpts1", "image_size0", "image_size1")


def picture(seed: int) -> np.ndarray:
    grey = cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 256, (100, 120)).astype(np.uint8), (0, 0), 1.0)
    return np.repeat(grey[..., None], 3, axis=2)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelStore:
    """A cache with the stand-ins under the real ones' names, and a table that knows their hashes."""
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path))
    plain = ModelStore.open()
    rows = []
    for name, write in ((EXTRACTOR, write_extractor), (MATCHER, write_matcher)):
        path = plain.path(plain.get(name))
        write(path)
        data = path.read_bytes()
        rows.append(replace(plain.get(name), bytes=len(data), sha256=hashlib.sha256(data).hexdigest()))
    found = replace(plain, models=tuple(rows))
    monkeypatch.setattr(learned.ModelStore, "open", staticmethod(lambda: found))
    return found


def test_features_lie_where_the_network_sees_them_and_none_in_padding_or_mask(store: ModelStore) -> None:
    found = LearnedFeatures(store).extract(picture(0), 500, None)
    # Cells of 16 pixels in 128 x 128; centres beyond the picture's 120 x 100 are padding.
    assert len(found) == 7 * 6
    np.testing.assert_allclose(found.xy[0], [8, 8], atol=1e-3)
    np.testing.assert_allclose(found.xy[-1], [104, 88], atol=1e-3)
    assert found.descriptors.dtype == np.int8
    length = np.linalg.norm(found.descriptors.astype(float), axis=1) / Features.SIGNED_NORM
    assert np.abs(length - 1).max() < 0.05
    left = np.zeros((100, 120), bool)
    left[:, :60] = True
    masked = LearnedFeatures(store).extract(picture(0), 500, left)
    assert 0 < len(masked) < len(found)
    assert (masked.xy[:, 0] >= 60).all()


def test_both_matchers_find_the_same_picture_and_not_another(store: ModelStore) -> None:
    networks = LearnedFeatures(store)
    first, other = (networks.extract(picture(seed), 500, None) for seed in (0, 1))
    order = np.random.default_rng(2).permutation(len(first))
    shuffled = Features(first.keypoints[order], first.descriptors[order])
    wanted = np.stack([np.arange(len(first)), np.argsort(order)], 1)
    np.testing.assert_array_equal(networks.match(first, shuffled, (120, 100)), wanted)
    np.testing.assert_array_equal(match_descriptors(first.descriptors, shuffled.descriptors), wanted)
    assert len(match_descriptors(first.descriptors, other.descriptors)) == 0
    none = Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.int8))
    assert networks.match(first, none, (120, 100)).shape == (0, 2)


def test_published_weights_find_the_same_places_from_far_apart(tmp_path: Path) -> None:
    files = Path(__file__).resolve().parents[4] / "shared" / "data" / "models"
    store = ModelStore.open(tmp_path)
    models = store.with_needed([f"{EXTRACTOR}-export"])
    if not files.is_dir() or len(store.take(files, models)) < 2:
        pytest.skip("the files are not here")
    clip = ClipOptions(frames=60, width=320, height=240)
    world = make_world(texel=0.02)
    first, second = (render_frame(world, clip, i) for i in (0, 7))
    networks = LearnedFeatures(store)
    a, b = (networks.extract(frame.rgb, 1000, None) for frame in (first, second))
    matches = networks.match(a, b, (320, 240))
    column, row = a.xy[matches[:, 0]].astype(int).T
    points = unproject(a.xy[matches[:, 0]], first.depth[row, column].astype(float), clip.intrinsics)
    moved = np.linalg.inv(second.world_from_cam) @ first.world_from_cam
    there, _ = project(points @ moved[:3, :3].T + moved[:3, 3], clip.intrinsics)
    right = np.linalg.norm(there - b.xy[matches[:, 1]], axis=1) < 3
    assert right.sum() > 40
    assert right.mean() > 0.7


def test_networks_are_part_of_what_the_stage_is_made_from(store: ModelStore) -> None:
    asked = load_config(overrides=["frames.features=aliked"]).frames
    assert open_learned(FramesConfig()) is None
    with noting_files() as files:
        assert isinstance(open_learned(asked), LearnedFeatures)
    assert {*files} == {store.path(store.get(name)) for name in (EXTRACTOR, MATCHER)}
    assert people_cards(store) is None, "they are no networks for people, and have no card"
    path = store.path(store.get(MATCHER))
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(InputError, match=f"damaged; run: msgs-slam models pull {MATCHER}"):
        open_learned(asked)


def test_without_the_networks_the_stage_says_what_to_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "empty"))
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture(i))
    with pytest.raises(InputError, match=r"49 MB.*run: msgs-slam models pull aliked-n16rot"):
        check_frames(tmp_path, load_config(overrides=["frames.features=aliked"]))
    check_frames(tmp_path, load_config())
