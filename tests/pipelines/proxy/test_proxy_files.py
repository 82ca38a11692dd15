"""Depth and labels from folders: what is read, and what is refused before any slow work."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from proxy_room import Room, write_source

from msgs_slam.formats.datasets.sequence import Camera, find_class_table, read_class_table
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.pipelines.depth.files import LABELS, FilesDepth, FolderMaps, MapKind, depth_kind, frame_key
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.labels.files import FilesLabels
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.proxy.selection import (
    _before_frames,
    check_proxy,
    choose_depth,
    choose_semantics,
    open_given_depth,
    open_given_semantics,
)
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.lens import distortion_of, make_lens, to_pycolmap
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Calibration, Frame, Intrinsics


@pytest.fixture
def source(room: Room, tmp_path: Path) -> Path:
    return write_source(room, tmp_path / "source")


def maps(kind: MapKind, source: Path, sequence: Sequence, folder: str = "") -> FolderMaps:
    return FolderMaps(kind, kind.find_folder(folder, source), sequence, source.is_file())


def depth_files(source: Path, room: Room, folder: str = "", unit: float = 0.001) -> FilesDepth:
    return FilesDepth(maps(depth_kind(unit), source, room.sequence(), folder))


def label_files(source: Path, room: Room) -> FilesLabels:
    provider = FilesLabels(maps(LABELS, source, room.sequence()), SilentProgress())
    empty = DepthEstimate(np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32))
    provider.fit(room.frames, lambda frame: empty)
    return provider


def test_depth_files_give_the_depth_back(source: Path, room: Room) -> None:
    provider = depth_files(source, room)
    for frame in room.frames[:3]:
        estimate = provider.estimate(frame)
        np.testing.assert_allclose(estimate.depth, room.views[frame.id].depth, atol=5.1e-4)
        assert (estimate.confidence == (estimate.depth > 0)).all()
    assert (
        depth_files(source, room, unit=0.002).estimate(room.frames[0]).depth.max()
        > 1.9 * provider.estimate(room.frames[0]).depth.max()
    )


def test_maps_of_half_the_size_take_the_mean_of_one_surface_or_the_pixel_under_their_centres(
    source: Path, room: Room
) -> None:
    half = FilesDepth(maps(depth_kind(0.001), source, room.sequence(128))).estimate(room.frames[1]).depth
    four = np.stack([room.views[1].depth[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    is_one, has_edge = four.max(0) < 1.03 * four.min(0), four.max(0) > 1.1 * four.min(0)
    assert is_one.sum() > 0.9 * is_one.size
    assert has_edge.any()
    np.testing.assert_allclose(half[is_one], 1 / (1 / four).mean(0)[is_one], atol=1.1e-3)
    np.testing.assert_allclose(half[has_edge], four[3][has_edge], atol=5.1e-4)


def test_files_have_the_lens_distortion_of_the_images_that_they_belong_to(tmp_path: Path) -> None:
    lens = make_lens(to_pycolmap(Camera(320, 240, 258.0, 257.0, 159.0, 121.0, (-0.2, 0.03, 0.001, 0.0))))
    ramp = np.tile(np.arange(1000, 2600, 5, dtype=np.uint16), (240, 1))
    write_grey_png(tmp_path / "depth" / "a.png", ramp)
    calibration = Calibration(lens.pinhole, "given", 0.0, distortion_of(lens.camera))
    frame = Frame(0, "a.png", 0.0, 0, 1.0)
    sequence = Sequence([frame], calibration, lens.pinhole, None, lambda f: np.zeros((240, 320, 3), np.uint8))
    found = FilesDepth(maps(depth_kind(0.001), tmp_path / "rgb", sequence)).estimate(frame).depth
    off = np.abs(found - (1 + 0.005 * lens.maps[0]))
    assert 0 < off.max() < 0.0026  # half a pixel
    assert np.abs(found - ramp / 1000).max() > 0.015


def test_0_and_65535_are_unknown_and_float_files_are_metres(source: Path, room: Room) -> None:
    stored = np.full((192, 256), 1500, np.uint16)
    stored[0, :5] = 0
    stored[1, :5] = 65535
    write_grey_png(source.parent / "depth" / room.frames[0].name, stored)
    depth = depth_files(source, room).estimate(room.frames[0]).depth
    assert (depth[:2, :5] == 0).all()
    assert np.unique(depth).tolist() == pytest.approx([0, 1.5])
    floats = np.full((192, 256), 2.25, np.float32)
    floats[0, 0], floats[0, 1], floats[0, 2] = np.nan, np.inf, -1
    folder = source.parent / "floats"
    folder.mkdir()
    for frame in room.frames:
        np.save(folder / f"{frame.id:06d}.npy", floats)
    estimate = depth_files(source, room, str(folder)).estimate(room.frames[0])
    assert estimate.invalid == 3
    assert (estimate.depth[0, :3] == 0).all()
    assert (estimate.depth.ravel()[3:] == 2.25).all()


def test_confidence_files_are_used(source: Path, room: Room) -> None:
    for frame in room.frames:
        write_grey_png(source.parent / "confidence" / frame.name, np.full((192, 256), 51, np.uint8))
    estimate = depth_files(source, room).estimate(room.frames[0])
    np.testing.assert_allclose(estimate.confidence[estimate.depth > 0], 0.2)


def test_confidence_named_like_the_depth_comes_first(source: Path, room: Room) -> None:
    (source.parent / "depth").rename(source.parent / "net_depth")
    for folder, value in (("confidence", 51), ("net_conf", 102)):
        for frame in room.frames:
            write_grey_png(source.parent / folder / frame.name, np.full((192, 256), value, np.uint8))
    estimate = depth_files(source, room, str(source.parent / "net_depth")).estimate(room.frames[0])
    np.testing.assert_allclose(estimate.confidence[estimate.depth > 0], 0.4)


def broken_depth(kind: str, path: Path) -> None:
    if kind == "wrong size":
        write_grey_png(path, np.ones((100, 256), np.uint16))
    elif kind == "8 bits":
        write_grey_png(path, np.ones((192, 256), np.uint8))
    elif kind == "colour":
        write_rgb(path, np.zeros((192, 256, 3), np.uint8))
    elif kind == "cannot read":
        path.write_bytes(b"\x89PNG but no more")


@pytest.mark.parametrize(
    ("kind", "said"),
    [("wrong size", "not the shape"), ("8 bits", "8 bits"), ("colour", "colour image"), ("cannot read", "read")],
)
def test_hostile_depth_images_are_refused_at_once(source: Path, room: Room, kind: str, said: str) -> None:
    broken_depth(kind, source.parent / "depth" / room.frames[0].name)
    with pytest.raises(InputError, match=said):
        depth_files(source, room)


@pytest.mark.parametrize(
    "array", [np.ones((192, 256), np.int32), np.ones((192, 256, 2), np.float32), np.array([{"a": 1}], dtype=object)]
)
def test_hostile_npy_files_are_refused_at_once(source: Path, room: Room, array: np.ndarray) -> None:
    folder = source.parent / "npy"
    folder.mkdir()
    np.save(folder / "000000.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=r"000000\.npy"):
        depth_files(source, room, str(folder))


def test_missing_folders_and_foreign_names_are_refused(source: Path, room: Room, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="looked in"):
        depth_files(source, room, str(tmp_path / "nothing"))
    write_grey_png(tmp_path / "foreign" / "kitchen.png", np.ones((192, 256), np.uint16))
    with pytest.raises(InputError, match=r"none of its 1 files \(kitchen.png"):
        depth_files(source, room, str(tmp_path / "foreign"))


@pytest.mark.parametrize(
    ("picture", "other"),
    [("frame-000002.color.jpg", "frame-000002.depth.png"), ("rgb_7.png", "depth_7.npy"), ("a b.jpg", "a b.tif")],
)
def test_names_of_one_instant_have_one_key(picture: str, other: str) -> None:
    assert frame_key(picture) == frame_key(other)


@pytest.mark.parametrize(
    ("images", "files", "expected"),
    [
        (["kitchen_3.jpg", "hall_3.jpg"], ["kitchen_3.png"], {0: "kitchen_3.png"}),
        (["17.25.jpg", "18.25.jpg"], ["17.25.png", "19.25.png"], {0: "17.25.png"}),
        (["frame4.jpg", "frame5.jpg"], ["map4.png", "map4.npy"], {0: "map4.npy"}),
    ],
)
def test_a_number_that_several_have_says_nothing(
    images: list[str], files: list[str], expected: dict[int, str], tmp_path: Path
) -> None:
    for name in files:
        (tmp_path / name).write_bytes(b"")
    frames = [Frame(i, name, float(i), i, 1.0) for i, name in enumerate(images)]
    found = depth_kind(1).match(tmp_path, frames, is_video=False)
    assert {i: path.name for i, path in found.items()} == expected


def test_a_video_matches_files_by_the_number_of_its_frame(source: Path, room: Room, tmp_path: Path) -> None:
    video = tmp_path / "source" / "video.mp4"
    video.write_bytes(b"only its name is looked at")
    picked = [replace(f, name=f"{i:06d}.jpg", id=i, source_index=2 * i) for i, f in enumerate(room.frames[:5])]
    sequence = replace(room.sequence(), frames=picked)
    provider = FilesDepth(maps(depth_kind(0.001), video, sequence))
    np.testing.assert_allclose(provider.estimate(picked[3]).depth, room.views[6].depth, atol=5.1e-4)
    assert provider.missing([*picked, replace(picked[0], id=9, source_index=99)])[0].id == 9


def test_labels_keep_the_classes_that_occur_in_the_order_of_their_ids(source: Path, room: Room) -> None:
    provider = label_files(source, room)
    ids = np.unique([i for v in room.views for i in np.unique(v.labels)])
    assert provider.classes().names == tuple(f"kind {i}" for i in ids if i)
    estimate = provider.estimate(room.frames[2], None)  # type: ignore[arg-type]
    names = np.array([*provider.classes().names, *[""] * 256])
    given = np.array([f"kind {i}" if i else "" for i in range(256)])
    assert (names[np.where(estimate.labels == VOID, 255, estimate.labels)] == given[room.views[2].labels]).all()
    assert provider.warnings() == []


def test_label_ids_outside_the_table_are_void_and_counted(source: Path, room: Room) -> None:
    labels = room.views[0].labels.copy()
    labels[:10, :10] = 200
    write_grey_png(source.parent / "labels" / room.frames[0].name, labels)
    provider = label_files(source, room)
    assert (provider.estimate(room.frames[0], None).labels[:10, :10] == VOID).all()  # type: ignore[arg-type]
    assert "100 pixels" in provider.warnings()[0]
    assert provider.figures()["label_ids_outside_table"] == {"200": 100}


def test_only_void_or_too_many_classes_are_refused(source: Path, room: Room) -> None:
    for frame in room.frames:
        write_grey_png(source.parent / "labels" / frame.name, np.zeros((192, 256), np.uint8))
    with pytest.raises(InputError, match="no class at all"):
        label_files(source, room)
    (source.parent / "classes.json").unlink()
    for frame in room.frames:
        write_grey_png(source.parent / "labels" / frame.name, np.arange(192 * 256, dtype=np.uint16).reshape(192, 256))
    with pytest.raises(InputError, match="instance ids"):
        label_files(source, room)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("classes.json", '["wall", "floor"]', {0: "wall", 1: "floor"}),
        ("classes.json", '{"classes": [{"id": 7, "name": "bed"}]}', {7: "bed"}),
        ("classes.json", '{"3": "lamp"}', {3: "lamp"}),
        ("classes.txt", "# id name\n93 wall 0.3\n0 void 0.2\n", {93: "wall", 0: "void"}),
        ("classes.txt", "28 shower curtain 0.3 x\n7\ttraffic light\n", {28: "shower curtain", 7: "traffic light"}),
        ("labels.txt", "wall\n  # indented\nfloor # here\nbed\n", {0: "wall", 1: "floor", 2: "bed"}),
        ("labels.txt", "background\npotted plant\n\nprose follows\n", {0: "background", 1: "potted plant"}),
    ],
)
def test_class_tables_of_all_kinds(tmp_path: Path, name: str, text: str, expected: dict[int, str]) -> None:
    (tmp_path / name).write_text(text)
    found = find_class_table(tmp_path / "labels")
    assert found is not None
    table = read_class_table(found)
    assert table is not None
    assert {k: v.name for k, v in table.items()} == expected


@pytest.mark.parametrize("common", [(1, 1, 6, 3), (6, 6, 1, 8)])
def test_files_of_photos_that_are_turned_alike_lie_as_these(tmp_path: Path, common: tuple[int, ...]) -> None:
    """A phone is held otherwise between photos; a network saw each of them upright."""
    rng, turns = np.random.default_rng(0), {1: 0, 8: 1, 3: 2, 6: 3}
    sensor = [rng.integers(1, 200, (48, 64), dtype=np.uint8) for _ in common]
    for i, orientation in enumerate(common):
        exif = Image.Exif()
        exif[0x0112] = orientation
        (tmp_path / "photos").mkdir(exist_ok=True)
        Image.fromarray(np.dstack([sensor[i]] * 3)).save(tmp_path / "photos" / f"{i}.jpg", exif=exif)
        upright = np.rot90(sensor[i], turns[orientation])
        write_grey_png(tmp_path / "depth" / f"{i}.png", upright.astype(np.uint16) * 100)
        write_grey_png(tmp_path / "labels" / f"{i}.png", upright)
    depth, labels = f"proxy.depth=files:{tmp_path / 'depth'}", f"proxy.semantics=files:{tmp_path / 'labels'}"
    config = load_config(None, [depth, labels])
    check_proxy(tmp_path / "photos", config)
    around = replace(_before_frames(tmp_path / "photos", config), progress=SilentProgress())
    found = open_given_depth(around, choose_depth(config.proxy))
    kinds = open_given_semantics(around, choose_semantics(config.proxy))
    assert isinstance(kinds, FilesLabels)
    for i, frame in enumerate(around.sequence.frames):
        lying = np.rot90(sensor[i], turns[common[0]])
        np.testing.assert_allclose(found.estimate(frame).depth, lying / 10, rtol=1e-6)
        np.testing.assert_array_equal(kinds._maps.read(frame.id), lying)


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"classes": 3}', '{"-1": "a"}', "[]"])
def test_damaged_class_tables_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "classes.json").write_text(text)
    with pytest.raises(InputError, match=r"classes\.json"):
        read_class_table(tmp_path / "classes.json")


@pytest.mark.parametrize(
    ("folder", "camera", "classes"), [("replica_office0", Intrinsics(600, 340, 300, 300, 300, 170), 22)]
)
def test_a_real_data_set_is_understood(
    shared_data: Path, folder: str, camera: Intrinsics, classes: int, tmp_path: Path
) -> None:
    source = shared_data / folder / "rgb"
    frames = [Frame(i, p.name, 0.0, i, 1.0) for i, p in enumerate(sorted(source.iterdir()))]
    calibration = Calibration(camera, "given", 0, (0, 0, 0, 0))
    sequence = Sequence(frames, calibration, camera, None, lambda f: np.zeros((1, 1, 3), np.uint8))
    depth = FilesDepth(maps(depth_kind(0.001), source, sequence)).estimate(frames[5])
    stored = cv2.imread(str(shared_data / folder / "depth" / f"{Path(frames[5].name).stem}.png"), -1)
    np.testing.assert_allclose(depth.depth, stored / 1000, rtol=1e-6)
    labels = FilesLabels(maps(LABELS, source, sequence), SilentProgress())
    labels.fit(frames, lambda f: depth)
    assert len(labels.classes()) == classes
    assert {"wall", "sofa", "tv-screen"} <= set(labels.classes().names)
    assert labels.warnings() == []
