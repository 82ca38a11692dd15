"""The stage from frames to maps: contents, resuming, the same bytes by workers, and what it says of itself."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from proxy_room import UNIT, Room
from tiny_tflite import write_tflite

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png
from msgs_slam.formats.textfile import read_json
from msgs_slam.pipelines.depth.files import FilesDepth
from msgs_slam.pipelines.labels.files import FilesLabels
from msgs_slam.pipelines.masks.moving import MovingView
from msgs_slam.pipelines.providers import DepthEstimate, LabelEstimate
from msgs_slam.pipelines.proxy.stage import run
from msgs_slam.pipelines.run.files import CALIBRATION, CLASSES, DESCRIPTORS, PROXY_MAPS
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.types import VOID, Frame
from tests.killed import KillAt, Killed
from tests.pipelines.travelling import Travelling

Make = Callable[..., StageContext]
FILES = ("proxy.depth=files", "proxy.semantics=files")
EMBEDDED = ("proxy.stereo_side=128",)


def tree(folder: Path) -> dict[str, bytes]:
    files = (p for p in folder.rglob("*") if p.is_file() and "snapshot" not in p.parts)
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def test_files_become_maps_with_reliability(room: Room, make_context: Make) -> None:
    context = make_context(*FILES)
    report = run(context)
    assert report == read_json(context.folder / "proxy.json")
    assert report["metric"] is True
    assert report["frames"] == len(room.frames)
    assert context.warnings == []
    classes = context.run.load(CLASSES)
    for frame in room.frames[::4]:
        maps, view = context.run.load(PROXY_MAPS, of=frame.id), room.views[frame.id]
        error = np.abs(maps.depth / view.depth - 1)
        assert 0 < error[maps.confidence > 0.36].max() < 2e-3
        assert error.max() < 6e-3
        assert 0 <= maps.confidence.min() < 0.3 < 0.9 < np.median(maps.confidence) <= 1
        assert (maps.labels[view.labels == 0] == VOID).all()
        assert classes.names[maps.labels[96, 128]] == f"kind {view.labels[96, 128]}"
    assert report["reliable_pixels"] > 0.9
    assert report["metres_per_unit"] == pytest.approx(1 / UNIT, rel=2e-3)


def test_frames_whose_depth_files_hold_nothing_have_no_depth_and_are_counted(room: Room, make_context: Make) -> None:
    context = make_context(*FILES)
    folder = context.source.parent / "depth"
    for frame in room.frames[2:4]:
        write_grey_png(folder / frame.name, np.zeros((192, 256), np.uint16))
    run(context)
    assert any(f"2 of {len(room.frames)} depth files hold no depth" in w for w in context.warnings)
    assert not context.run.load(PROXY_MAPS, of=room.frames[2].id).confidence.any()
    none = make_context(*FILES, name="none")
    for frame in room.frames:
        write_grey_png(none.source.parent / "depth" / frame.name, np.zeros((192, 256), np.uint16))
    with pytest.raises(InputError, match="of the keyframes the depth files hold no depth at all"):
        run(none)


def test_embedded_providers_go_end_to_end(room: Room, make_context: Make) -> None:
    context = make_context(*EMBEDDED)
    report = run(context)
    assert (report["depth"], report["semantics"], report["metric"]) == ("multiview", "segments", False)
    assert report["reliable_pixels"] > 0.5
    errors = []
    for frame in room.frames[2:9]:
        maps = context.run.load(PROXY_MAPS, of=frame.id)
        assert maps.depth.shape == (192, 256)
        error = np.abs(maps.depth / (room.views[frame.id].depth * UNIT) - 1)
        errors.append(np.median(error[maps.confidence > 0.35]))
    assert 0 < np.mean(errors) < 0.02


@pytest.mark.parametrize(("planes", "is_warned"), [(32, False), (4, True)])
def test_depth_that_is_mostly_filled_in_is_said_to_be(
    make_context: Make, planes: int, is_warned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.proxy.selection.STEREO_PLANES", planes)
    context = make_context("proxy.stereo_side=128")
    figures = run(context)
    share, error = figures["reliable_pixels"], figures["completed_error"]
    said = [w for w in context.warnings if f"only {share:.0%} of the pixels have a depth that is good to 4%" in w]
    assert bool(said) == is_warned
    assert 0 < error < 1
    assert all(f"off by {error:.0%} on average" in w for w in said)


def something_moved(_: Any, view: Callable[[int], MovingView], *more: Any) -> dict[int, np.ndarray]:
    """In the upper half of one keyframe."""
    moved = np.zeros(view(2).depth.shape, np.bool_)
    moved[: len(moved) // 2] = True
    return {2: moved}


def test_killed_in_each_pass_and_with_other_threads_it_ends_with_the_same_bytes(
    make_context: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.proxy.stage.find_moving", something_moved)
    whole = make_context(*EMBEDDED, name="whole")
    run(whole)
    broken = make_context(*EMBEDDED, "run.threads=1", name="broken")
    for label, after in (("stereo", 4), ("depth", 5), ("regions", 3), ("classes", 6)):
        object.__setattr__(broken, "progress", KillAt(after, label))
        with pytest.raises(Killed):
            run(broken)
    maps = sorted((broken.folder / "maps").iterdir())
    assert len(maps) == 7  # the bar counts what is done: six are told of, the seventh lies there already
    stamps = [p.stat().st_mtime_ns for p in maps]
    object.__setattr__(broken, "progress", whole.progress)
    run(broken)
    assert stamps == [p.stat().st_mtime_ns for p in maps]
    assert tree(broken.folder) == tree(whole.folder)


def test_without_a_backbone_files_serve_every_frame_and_the_rest_says_what_to_do(
    room: Room, make_context: Make
) -> None:
    context = make_context(*FILES, backbone=False)
    assert run(context)["frames"] == len(room.frames)
    with pytest.raises(InputError, match="parallax"):
        run(make_context(name="still", backbone=False))


def test_missing_files_are_warned_of_and_leave_unknown_depth(room: Room, make_context: Make) -> None:
    context = make_context(*FILES)
    (context.source.parent / "depth" / room.frames[3].name).unlink()
    run(context)
    assert "1 of 11 frames have no depth map" in context.warnings[0]
    maps = PROXY_MAPS.read(PROXY_MAPS.path(context.folder, 3))
    assert maps.depth.max() == maps.confidence.max() == 0


@pytest.mark.parametrize(
    ("setting", "said"),
    [("proxy.depth=radar", "radar"), ("proxy.semantics=onnx", "card"), ("proxy.depth=onnx:/no/card.toml", "card.toml")],
)
def test_unknown_providers_are_refused(make_context: Make, setting: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        run(make_context(*FILES, setting))


def test_what_a_network_says_of_normals_and_looks_reaches_the_run(
    room: Room, make_context: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    whole = FilesDepth.estimate

    def with_normals(self: FilesDepth, frame: Frame) -> DepthEstimate:
        found = whole(self, frame)
        return replace(found, normals=np.full((*found.depth.shape, 3), frame.id, np.int8))

    def with_descriptor(self: FilesLabels, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        assert depth.normals is not None
        seen.append(int(depth.normals[0, 0, 0]))
        labels = np.zeros(depth.depth.shape, np.uint8)
        return LabelEstimate(labels, labels.astype(np.float32), np.eye(4, dtype=np.float32)[frame.id % 4])

    monkeypatch.setattr(FilesDepth, "estimate", with_normals)
    monkeypatch.setattr(FilesLabels, "estimate", with_descriptor)
    context = make_context(*FILES)
    run(context)
    assert sorted(seen) == [f.id for f in room.frames]  # two are in work at once
    found = context.run.find(DESCRIPTORS)
    assert sorted(found) == [f.id for f in room.frames]
    np.testing.assert_array_equal(found[5], np.eye(4)[1])


@pytest.mark.parametrize(
    ("focal", "origin", "doubted"), [(1.3, "exif", True), (1.1, "exif", False), (1.3, "given", False)]
)
def test_a_network_that_sees_another_camera_is_told(
    room: Room, make_context: Make, monkeypatch: pytest.MonkeyPatch, focal: float, origin: str, doubted: bool
) -> None:
    intrinsics = room.calibration.intrinsics
    monkeypatch.setattr(FilesDepth, "figures", lambda self: {"network_focal_px": focal * intrinsics.fx})
    context = make_context(*FILES)
    CALIBRATION.save(context.run.stage("frames"), replace(room.calibration, origin=origin, focal_sd=3.0))
    run(context)
    assert any("focal length of" in w for w in context.warnings) == doubted


KINDS = {"precompute_depth", "make_depths", "find_moving_in", "precompute_labels", "make_maps"}


def card(folder: Path) -> str:
    """A network that calls bright, red and blue things by three names."""
    folder.mkdir()
    write_tflite(folder / "net.tflite", [[8.0, 8, 8], [8, -8, -8], [-8, -8, 8]], [0, 2, 2], "argmax", (24, 32))
    values = {
        "task": "segmentation", "model": "net.tflite", "input": "image", "output": "scores", "kind": "logits",
        "white": 1.0, "mean": [0.5] * 3, "std": [0.5] * 3, "classes": ["bright", "red", "blue"],
    }  # fmt: skip
    (folder / "card.toml").write_text("".join(f"{k} = {json.dumps(v)}\n" for k, v in values.items()))
    return f"onnx:{folder / 'card.toml'}"


@pytest.mark.parametrize("given", ["embedded", "fused"])
def test_workers_leave_the_same_bytes(
    room: Room, make_context: Callable[..., StageContext], tmp_path: Path, given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever depends on all frames (scales, what the scene holds) must reach who works on some of them."""
    settings: tuple[str, ...] = ("proxy.stereo_side=64",)
    monkeypatch.setattr("msgs_slam.pipelines.proxy.selection.CACHE_MB", 0)
    if given == "fused":
        monkeypatch.setattr("msgs_slam.pipelines.proxy.selection.LEARNED_SPREAD", 0.0)
        settings += ("proxy.depth=files", f"proxy.semantics={card(tmp_path / 'network')}")
    whole, divided = make_context(*settings), make_context(*settings, name="divided")
    workers = Travelling(2)
    object.__setattr__(divided, "source", whole.source)
    object.__setattr__(divided, "workers", workers)
    assert run(divided) == run(whole)
    assert tree(divided.folder) == tree(whole.folder)
    assert workers.done == dict.fromkeys(KINDS, 6)
