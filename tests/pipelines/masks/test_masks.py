"""What is no part of the scene: the user's masks, people by two networks, what moved; and who keeps clear of them."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb, write_grey_png, write_rgb
from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.depth.stereo.sweep import sweep_cost
from msgs_slam.pipelines.depth.stereo.volume import Bands
from msgs_slam.pipelines.frames.keyframes import choose_keyframes
from msgs_slam.pipelines.frames.masks import FrameMasks, check_masks, open_masks
from msgs_slam.pipelines.geometry.voxels import to_lab
from msgs_slam.pipelines.mapping.losses import Objective
from msgs_slam.pipelines.mapping.views import View, make_view
from msgs_slam.pipelines.masks.moving import MovingView, find_moving, find_moving_once
from msgs_slam.pipelines.masks.people import PeopleFinder, join_people, people_cards
from msgs_slam.pipelines.masks.static import divide_regions, judge_static, regions_of, things_of
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.providers import DepthEstimate, LabelEstimate
from msgs_slam.pipelines.render.api import Rendering
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.features import sift_features
from msgs_slam.pipelines.sfm.flow import find_corners
from msgs_slam.pipelines.source.recording import open_recording
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Frame, Intrinsics
from tests.dense_volumes import to_dense
from tests.pipelines.proxy.tiny_tflite import blue_people

HEIGHT, WIDTH = 96, 128


def noise(seed: int = 0) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)


def left_half() -> NDArray[np.bool_]:
    return np.arange(WIDTH)[None].repeat(HEIGHT, 0) < WIDTH // 2


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    for i in range(3):
        write_rgb(tmp_path / "pictures" / f"view{i}.jpg", noise(i))
    return tmp_path / "pictures"


def write_mask(path: Path, left_out: NDArray[np.bool_]) -> None:
    path.parent.mkdir(exist_ok=True)
    write_grey_png(path, np.where(left_out, 0, 255).astype(np.uint8))


def test_masks_are_found_by_both_names_and_reduced(pictures: Path, tmp_path: Path) -> None:
    write_mask(tmp_path / "masks" / "view0.jpg.png", left_half())
    write_mask(tmp_path / "masks" / "view2.png", ~left_half())
    masks = open_masks(tmp_path / "masks", open_recording(pictures))
    first, second, third = (masks.left_out(i, WIDTH // 2, HEIGHT // 2) for i in range(3))
    assert first is not None
    assert third is not None
    assert second is None
    np.testing.assert_array_equal(first, left_half()[::2, ::2])
    np.testing.assert_array_equal(third, ~first)


@pytest.mark.parametrize(
    ("name", "size", "said"),
    [
        ("view7.jpg.png", (HEIGHT, WIDTH), "1 of 1 files belong to no image, the first is view7.jpg.png"),
        ("view1.png", (HEIGHT, WIDTH - 1), "is 127x96, the images are 128x96"),
        ("view1.jpg", (HEIGHT, WIDTH), "holds no PNG files"),
    ],
)
def test_masks_of_another_name_or_size_are_refused_before_anything_slow(
    pictures: Path, tmp_path: Path, name: str, size: tuple[int, int], said: str
) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    cv2.imwrite(str(folder / name), np.zeros(size, np.uint8))
    config = load_config(overrides=[f'frames.masks="{folder}"'])
    with pytest.raises(InputError, match=said):
        check_masks(pictures, config)
    with pytest.raises(InputError, match="no such folder"):
        check_masks(pictures, load_config(overrides=[f'frames.masks="{tmp_path / "none"}"']))


# who keeps clear ------------------------------------------------------------------------------------------------


def test_features_corners_and_keyframes_keep_clear() -> None:
    grey = np.asarray(cv2.cvtColor(noise(), cv2.COLOR_RGB2GRAY), np.uint8)
    found, kept = (sift_features(grey, 500, mask) for mask in (None, left_half()))
    assert 5 < len(kept) < len(found)
    assert (kept.xy[:, 0] >= WIDTH // 2 - 1).all()
    assert (find_corners(grey, np.zeros((0, 2)), 50, left_out=left_half())[:, 0] > WIDTH // 2 - 4).all()
    # Only what is masked moves: by it alone every frame would be a keyframe.
    shown = [np.where(left_half(), np.roll(grey, 9 * i, 1), grey) for i in range(4)]
    still = choose_keyframes([(g, left_half()) for g in shown], 0.05)
    assert still.largest_displacement < 0.01
    assert choose_keyframes([(g, ~left_half()) for g in shown], 0.05).largest_displacement > 0.05


def test_proxies_of_what_is_left_out_are_unknown() -> None:
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    normals = np.full((HEIGHT, WIDTH, 3), 70, np.int8)
    masked = DepthEstimate(depth, depth, 0, normals).without(left_half())
    for values in (masked.depth, masked.confidence, masked.normals):
        assert values is not None
        np.testing.assert_array_equal(np.flatnonzero(values.reshape(HEIGHT, WIDTH, -1)[0].any(-1)), range(64, WIDTH))
    labels = LabelEstimate(np.zeros((HEIGHT, WIDTH), np.uint8), depth).without(left_half())
    assert (labels.labels[:, :64] == VOID).all()
    assert (labels.labels[:, 64:] == 0).all()
    assert (labels.confidence[:, :64] == 0).all()


def test_stereo_compares_no_window_that_touches_what_another_view_leaves_out() -> None:
    grey = cv2.cvtColor(noise(), cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    blanked = np.where(left_half(), np.float32(np.nan), np.roll(grey, -8, 1))
    shift = np.array([[[1.0, 0, 0, -8], [0, 1, 0, 0], [0, 0, 1, 0]]])  # 8 pixels at the inverse depth 1
    planes, bands = np.array([0.25, 1.0]), Bands(1)
    cost = to_dense(sweep_cost(grey, blanked[None], shift, planes, 1, bands))
    assert (cost[:, : 64 - 8, 0] == 1).all()  # no view sees it: as good as any other depth
    assert np.median(cost[10:-10, 84:110, 1]) < 0.05 < 0.4 < np.median(cost[10:-10, 84:110, 0])
    assert np.isfinite(cost).all()
    whole = to_dense(sweep_cost(grey, np.stack([blanked, np.roll(grey, -8, 1)]), shift.repeat(2, 0), planes, 1, bands))
    assert np.median(whole[10:-10, 30:110, 1]) < 0.05  # another view does


# people -----------------------------------------------------------------------------------------------------------


def test_people_are_what_both_networks_are_sure_of() -> None:
    box = np.zeros((100, 100), np.float32)
    box[20:80, 30:60] = 0.9
    assert join_people(box, box)[50, 45]
    assert not join_people(box, np.roll(box, 50, 1)).any()
    assert not join_people(box, 0.6 * box).any()
    wider = np.zeros_like(box)
    wider[20:81, 28:61] = 0.9
    found = join_people(wider, box)
    assert found[80, 45]  # the feet that only the person network sees
    assert not found[90, 45]
    assert found.mean() < 1.4 * (box > 0).mean()


@pytest.fixture
def stand_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelStore:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    return blue_people(tmp_path)


def test_stand_ins_of_the_networks_find_the_blue_person(stand_ins: ModelStore, pictures: Path) -> None:
    cards = people_cards(stand_ins)
    assert cards is not None
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    image[20:80, 40:70] = (0, 0, 255)
    found = PeopleFinder(cards, 1).left_out(image)
    assert found[25:75, 45:65].all()
    assert found.mean() < 1.4 * 60 * 30 / found.size
    model = stand_ins.get("my-person")
    stand_ins.path(model).write_bytes(bytes(model.bytes))
    with pytest.raises(InputError, match="Download it again"):
        check_masks(pictures, load_config())


def test_frames_between_are_searched_where_a_keyframe_shows_people(
    stand_ins: ModelStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blue person walks through frames 5 to 7; keyframes are 0, 3, 6 and 9."""
    frames = [Frame(i, f"{i:06d}.png", i / 10, i, 1.0) for i in range(13)]
    for frame in frames:
        image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        if 5 <= frame.id <= 7:
            image[20:80, 40:70] = (0, 0, 255)
        write_rgb(tmp_path / "picked" / frame.name, image)
    masks = FrameMasks(load_config(), open_recording(tmp_path / "picked"), tmp_path / "people", tmp_path / "picked", 1)
    masks.find_people(frames, [0, 3, 6, 9], SilentProgress())
    masks.leave_out(frames, [0, 3, 6, 9], None, 0, SilentProgress())
    searched = sorted(int(p.name[:6]) for p in (tmp_path / "people" / "masks").iterdir())
    assert searched == [0, *range(3, 10)]
    assert [f.id for f in frames if masks.left_out(f, WIDTH, HEIGHT) is not None] == [5, 6, 7]

    def never(self: PeopleFinder, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        raise AssertionError("what is on disk stays")

    monkeypatch.setattr(PeopleFinder, "left_out", never)
    masks.find_people(frames, [0, 3, 6, 9], SilentProgress())

    shutil.copytree(tmp_path / "people" / "masks", tmp_path / "stands" / "masks")
    masks = FrameMasks(load_config(), open_recording(tmp_path / "picked"), tmp_path / "stands", tmp_path / "picked", 1)
    judged = [(r, np.ones(r.max() + 1, np.int8)) for r in masks.regions(frames, [0, 3, 6, 9])]
    masks.leave_out(frames, [0, 3, 6, 9], judged, 0, SilentProgress())
    assert [f.id for f in frames if masks.left_out(f, WIDTH, HEIGHT) is not None] == []


def boxes(*columns: int | None) -> list[NDArray[np.int32]]:
    """Regions of keyframes: a box at each of these columns, or none."""
    shown = [np.zeros((120, 160), np.bool_) for _ in columns]
    for image, column in zip(shown, columns, strict=True):
        if column is not None:
            image[20:100, column : column + 30] = True
    return [regions_of(image) for image in shown]


def test_pieces_that_nearly_touch_are_one_region() -> None:
    named = np.zeros((480, 640), np.bool_)
    named[100:300, 100:200] = named[310:330, 120:180] = named[100:300, 400:500] = True
    found = regions_of(named)
    assert found.max() == 2
    assert found[40, 35] == found[80, 35] != found[40, 110]
    assert not regions_of(np.zeros((480, 640), np.bool_)).any()


def test_a_statue_and_who_walks_past_it_are_two_parts_of_one_outline() -> None:
    region = boxes(60)[0]
    column = np.broadcast_to(np.arange(160), region.shape)

    def divided(stands: NDArray[np.bool_], every: int) -> NDArray[np.int32]:
        seen = (region > 0) & (np.arange(region.size).reshape(region.shape) % every == 0)
        return divide_regions(region, np.stack([seen & stands, seen]).reshape(2, -1).astype(np.float64), 0.5)

    left, right = (region > 0) & (column < 72), (region > 0) & (column > 78)
    parts = divided(column < 75, 7)
    assert len({*parts[left]}) == len({*parts[right]}) == 1
    assert parts[50, 62] != parts[50, 88]
    assert ((parts > 0) == (region > 0)).all()
    np.testing.assert_array_equal(divided(column < 62, 7), region)  # a rim is no side
    np.testing.assert_array_equal(divided(column < 75, 331), region)  # too few matches


def test_who_walks_away_is_left_out_where_she_stood_before() -> None:
    """In keyframes 0 to 3 she stands, then walks; what she is in 9 nobody knows, for nothing connects it."""
    regions = boxes(50, 50, 51, 50, None, 57, 64, 71, None, 10)
    things = things_of(regions)
    assert len({int(t[1]) for t, r in zip(things, regions, strict=True) if r.any()}) == 2

    def judged(shares: list[float | None], expected: float = 0.8) -> list[int]:
        count = [0 if s is None else 100 for s in shares]
        votes = [np.array([[0, (s or 0) * n], [0, n]]) if r.any() else np.zeros((2, 1))
                 for s, n, r in zip(shares, count, regions, strict=True)]  # fmt: skip
        return [int(s[1]) for s, r in zip(judge_static(votes, things, expected), regions, strict=True) if r.any()]

    stands = [0.7, 0.75, 0.8, 0.7, None, 0.7, 0.72, 0.7, None, None]
    assert judged(stands) == [1] * 7 + [0]
    assert judged([0.7, 0.75, 0.8, 0.7, None, 0.7, 0.2, 0.1, None, 0.7]) == [-1] * 7 + [1]
    assert judged(stands, 0.2) == [-1] * 7 + [0], "a structure that the rest contradicts says nothing of people"
    unsure = [None if i == 2 else s for i, s in enumerate(stands)]
    assert judged(unsure) == [1] * 7 + [0], "few matches: as the rest of the thing"


def test_networks_of_other_kinds_in_the_cache_are_passed_by(stand_ins: ModelStore) -> None:
    for model in stand_ins.models:
        if model.family in ("lpips", "aliked", "lightglue"):  # their contracts are no cards
            stand_ins.path(model).parent.mkdir(parents=True, exist_ok=True)
            with stand_ins.path(model).open("wb") as file:
                file.truncate(model.bytes)
    assert stand_ins.is_here(stand_ins.get("lpips-alex"))
    assert people_cards(stand_ins) is not None


def test_the_real_networks_find_the_woman_and_leave_rooms_alone(shared_data: Path, tmp_path: Path) -> None:
    store = ModelStore.open(tmp_path / "cache")
    store.take(shared_data / "models", store.with_needed([]))
    cards = people_cards(store)
    assert cards is not None
    finder = PeopleFinder(cards, 1)
    woman = finder.left_out(read_rgb(shared_data / "people" / "0030.jpg"))
    assert 0.08 < woman.mean() < 0.2
    assert woman[:, 350:700].sum() == woman.sum()
    for room in ("whiteroom/rgb/000150.jpg", "kitchen/frame-000150.color.jpg", "replica_office0/rgb/000000.jpg"):
        if (shared_data / room).exists():
            assert not finder.left_out(read_rgb(shared_data / room)).any(), room


# the map ----------------------------------------------------------------------------------------------------------


def test_the_loss_of_a_view_does_not_see_what_is_left_out(a_view: tuple[View, Callable]) -> None:
    view, loss_of = a_view
    masked = replace(view, scene=torch.arange(view.image.shape[1])[None].repeat(view.image.shape[0], 1) >= 40)
    painted = masked.image.clone()
    painted[:, :40] = 255 - painted[:, :40]
    losses, gradients = zip(*(loss_of(v) for v in (masked, replace(masked, image=painted))), strict=True)
    assert losses[0] == losses[1]
    assert torch.equal(gradients[0], gradients[1])
    assert losses[0] != loss_of(view)[0]


@pytest.fixture
def a_view() -> tuple[View, Callable]:
    """A view of random colours, and the loss with its gradient of a picture of it that is a bit off."""
    camera = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    view = make_view(0, camera, np.eye(4), image, None, ())

    def loss_of(seen: View) -> tuple[float, torch.Tensor]:
        shown = (view.colors * 0.9 + 0.03).requires_grad_()
        rendering = Rendering(shown, torch.ones(60, 80), torch.full((60, 80), 0.9))
        objective = Objective(MappingConfig(), 1.0)
        loss = objective.of(seen, torch.zeros(2, 3), rendering, torch.zeros(4))
        loss.backward()
        assert shown.grad is not None
        if seen.scene is not None:
            assert (shown.grad[:, :40] == 0).all()
        return float(loss.detach()), shown.grad

    return view, loss_of


CAMERA = Intrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
WALL, KEYFRAMES = 4.0, 14


def textured(seed: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(30, 225, (40, 90, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (900, 400), interpolation=cv2.INTER_CUBIC), np.uint8)


def clip(stands_at: float | None) -> tuple[list[MovingView], list[NDArray[np.bool_]]]:
    """A camera that moves along a wall, and a red thing before it: still at `stands_at` metres, or walking along."""
    wall, views, things = textured(0), [], []
    for k in range(KEYFRAMES):
        left, brighter = 0.12 * k, 1 + 0.01 * k
        pose = np.eye(4)
        pose[0, 3] = -left
        x = np.arange(160) + 0.5
        column = 100 + ((x - 80) / 140 * WALL + left) * 120
        image = wall[(150 + np.arange(120))[:, None], np.round(column).astype(int)[None]]
        middle = 20 + 9 * k if stands_at is None else 80 + 140 * (0.8 - left) / stands_at
        thing = (np.abs(x[None] - middle) < 14) & (np.arange(120)[:, None] > 30)
        image = np.where(thing[..., None], np.uint8([180, 40, 40]), image)
        # Stereo finds the depth of a thing that stands, and is unsure of one that moves.
        depth = np.where(thing, 2.0 if stands_at is None else stands_at, WALL).astype(np.float32)
        confidence = np.where(thing & (stands_at is None), 0.05, 0.8).astype(np.float32)
        shown = np.clip(image * brighter, 0, 255).astype(np.uint8)
        views.append(MovingView(depth, confidence, to_lab(shown), pose))
        things.append(thing)
    return views, things


def find(views: list[MovingView]) -> dict[int, NDArray[np.bool_]]:
    poses = np.array([v.cam_from_world for v in views])
    shown = poses, lambda k: views[k], CAMERA, SilentProgress()
    return find_moving(*shown, find_moving_once(range(len(views)), *shown))


def test_a_thing_that_walks_along_a_wall_is_found() -> None:
    views, things = clip(None)
    found = find(views)
    assert len(found) >= KEYFRAMES - 2
    hit = [(found[k] & things[k]).sum() / things[k].sum() for k in found]
    beside = [(found[k] & ~things[k]).mean() for k in found]
    assert np.mean(hit) > 0.9
    assert 0 < np.mean(beside) < 0.04  # the rim


@pytest.mark.parametrize("stands_at", [0.5, 2.0, 3.5])
def test_a_thing_that_stands_is_part_of_the_scene(stands_at: float) -> None:
    """Also one that is so close that most of the others look past it, at the wall behind."""
    assert find(clip(stands_at)[0]) == {}


def test_wrong_guesses_over_a_plain_surface_accuse_nobody() -> None:
    views, things = clip(WALL)
    guessed = [
        replace(v, depth=np.where(t, v.depth * 0.7, v.depth), confidence=np.where(t, np.float32(0.276), v.confidence))
        for v, t in zip(views, things, strict=True)
    ]
    assert find(guessed) == {}


def test_nothing_is_said_of_one_view_or_of_views_without_depth() -> None:
    views, _ = clip(None)
    assert find(views[:1]) == {}
    blind = [MovingView(v.depth * 0, v.confidence * 0, v.lab, v.cam_from_world) for v in views]
    assert find(blind) == {}
