"""Videos and folders of images as sources, the odd ones included, and what `frames` reports of their GPS."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import ExifTags, Image

from msgs_slam.formats import reading
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb, write_grey_png, write_rgb
from msgs_slam.formats.video_streams import write_video
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.frames.stage import places_figure, run
from msgs_slam.pipelines.reconstruct import one_source
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.source.recording import FolderRecording, VideoRecording, open_recording
from msgs_slam.pipelines.types import Frame


def _shade(value: int, width: int = 64, height: int = 48) -> np.ndarray:
    """(height, width, 3) of about that grey; a frame of exactly one colour is no picture."""
    image = np.full((height, width, 3), value, np.uint8)
    image[::2, : width // 2] += 6
    return image


def _noise(seed: int, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Twenty frames of 64x48 at 10 a second."""
    path = tmp_path / "short.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for i in range(20):
        writer.write(_shade(10 * i))
    writer.release()
    return path


def test_a_source_that_stays_the_same_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Films are gigabytes, and several steps ask whether it is still the same."""
    monkeypatch.setattr(reading, "_JUST_WRITTEN", -1.0)
    read, right = [], reading.file_sha256
    monkeypatch.setattr(reading, "file_sha256", lambda path: read.append(path.name) or right(path))
    for name in ("0.png", "1.png"):
        write_rgb(tmp_path / name, np.zeros((24, 32, 3), np.uint8))
    before = open_recording(tmp_path, "auto").digest
    assert open_recording(tmp_path, "auto").digest == before
    assert read == ["0.png", "1.png"]
    write_rgb(tmp_path / "1.png", np.ones((24, 32, 3), np.uint8))
    assert open_recording(tmp_path, "auto").digest != before
    assert read == ["0.png", "1.png", "1.png"]


def test_a_video_is_read_in_order_with_times(video: Path) -> None:
    source = open_recording(video)
    assert isinstance(source, VideoRecording)
    assert (source.width, source.height, source.is_timed()) == (64, 48, True)
    frames = list(source.read())
    assert [f.source_index for f in frames] == list(range(20))
    np.testing.assert_allclose([f.timestamp for f in frames], np.arange(20) / 10, atol=1e-6)
    assert [f.source_index for f in source.read({3, 7})] == [3, 7]
    assert [round(f.rgb.mean() / 10) for f in source.read({3, 7})] == [3, 7]
    assert source.name(12, 55) == "000012.jpg"


def test_a_folder_keeps_names_and_natural_order(tmp_path: Path) -> None:
    for i in (10, 9, 2):
        write_rgb(tmp_path / f"img{i}.jpg", _noise(i))
    source = open_recording(tmp_path)
    assert isinstance(source, FolderRecording)
    assert [source.name(k, k) for k in range(3)] == ["img2.jpg", "img9.jpg", "img10.jpg"]
    assert not source.is_timed()
    assert source.original(0) == tmp_path / "img2.jpg"


def test_depth_maps_beside_the_images_are_left_out(tmp_path: Path) -> None:
    for i in range(3):
        write_rgb(tmp_path / f"{i}.color.jpg", _noise(i))
        write_grey_png(tmp_path / f"{i}.depth.png", np.full((48, 64), 1000 + i, np.uint16))
    source = open_recording(tmp_path)
    assert [source.name(i, i) for i in range(source.expected_frames)] == ["0.color.jpg", "1.color.jpg", "2.color.jpg"]


def test_times_beside_the_images_are_used(tmp_path: Path) -> None:
    for i in range(3):
        write_rgb(tmp_path / f"{i}.png", _noise(i))
    (tmp_path / "timestamps.txt").write_text("5.0\n5.5\n7.25\n")
    source = open_recording(tmp_path)
    assert source.is_timed()
    assert [f.timestamp for f in source.read()] == [5.0, 5.5, 7.25]


def test_images_that_others_would_see_differently_are_not_copied(tmp_path: Path) -> None:
    plain = Image.fromarray(_noise(0))
    turned = Image.Exif()
    turned[0x0112] = 3
    plain.save(tmp_path / "a_turned.jpg", exif=turned)
    plain.save(tmp_path / "b.bmp")
    Image.fromarray(np.dstack([_noise(1), np.full((48, 64), 90, np.uint8)])).save(tmp_path / "c_clear.png")
    plain.save(tmp_path / "d.png")
    source = open_recording(tmp_path)
    assert [source.original(i) is not None for i in range(4)] == [False, False, False, True]
    assert source.name(1, 1) == "b.bmp.png"


def test_a_folder_of_damaged_images_is_refused(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i}.jpg").write_bytes(b"\xff\xd8\xff damaged")
    with pytest.raises(InputError, match=r"none of the 3 images .* can be read: .*0\.jpg is damaged or no image"):
        open_recording(tmp_path)
    for i in range(3):
        (tmp_path / f"{i}.jpg").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n")
    with pytest.raises(InputError, match=r"none of the 3 images .* git-LFS pointer.*git lfs pull"):
        open_recording(tmp_path)


def test_one_image_is_refused(tmp_path: Path, make_context: Callable[..., StageContext]) -> None:
    write_rgb(tmp_path / "one" / "a.jpg", _noise(0))
    with pytest.raises(InputError, match="one image only"):
        run(make_context(tmp_path / "one"))


def test_an_empty_folder_is_refused(tmp_path: Path, make_context: Callable[..., StageContext]) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="no images"):
        run(make_context(tmp_path / "none"))


def test_picked_frames_are_reduced_and_not_picked_twice_unless_they_are_gone(
    tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    for i in range(4):
        write_rgb(tmp_path / "large" / f"{i}.png", np.repeat(np.repeat(_noise(0), 4, axis=0), 4, axis=1))
    context = make_context(tmp_path / "large", "frames.max_side=128")
    with pytest.raises(InputError, match="stands still"):
        run(context)
    picked, table = context.snapshot / "picked" / "2.png", context.snapshot / "picked.json"
    assert read_rgb(picked).shape == (96, 128, 3)
    before = picked.stat().st_mtime_ns, table.stat().st_mtime_ns
    with pytest.raises(InputError, match="stands still"):
        run(context)  # it goes on from the table, and does not pick again
    assert (picked.stat().st_mtime_ns, table.stat().st_mtime_ns) == before
    picked.unlink()
    with pytest.raises(InputError, match="stands still"):
        run(context)  # a picture that is gone is no dead end
    assert read_rgb(picked).shape == (96, 128, 3)


ODD = [
    ("d_empty.mp4", "empty"),
    ("d_text.mp4", "text file"),
    ("d_one_frame.mp4", "one frame only"),
    ("tc_audio_only.mp3", "no image can be decoded"),
    ("not_there.mp4", "no such file"),
]


@pytest.mark.parametrize(("name", "what"), ODD)
def test_odd_videos_are_refused(
    name: str, what: str, shared_data: Path, make_context: Callable[..., StageContext]
) -> None:
    with pytest.raises(InputError, match=what):
        run(make_context(shared_data / "odd_videos" / name))


def test_a_truncated_video_is_read_to_its_end_with_a_warning(shared_data: Path) -> None:
    said: list[str] = []
    source = open_recording(shared_data / "odd_videos" / "d_odd_423x181_mjpeg.avi")
    frames = list(source.read(warn=said.append))
    assert len(frames) == 150
    assert (source.width, source.height) == (423, 181)
    assert len(said) == 1
    assert "180 frames, 150 decode" in said[0]


def test_videos_of_one_place_are_one_source(tmp_path: Path) -> None:
    shades = {"a": (10, 40, 70), "b": (130, 160)}
    paths = [
        write_video(tmp_path / f"{name}.avi", [_shade(v) for v in values], 10.0) for name, values in shades.items()
    ]
    run = RunFolder(tmp_path / "both.msgs")
    assert one_source(paths[:1], run) == paths[0]
    source = open_recording(one_source(paths, run))
    frames = list(source.read())
    assert [f.source_index for f in frames] == [0, 1, 2, 3, 4]
    assert [round(float(f.rgb.mean()), -1) for f in frames] == [10, 40, 70, 130, 160]
    gaps = np.diff([f.timestamp for f in frames])
    np.testing.assert_allclose(gaps[[0, 1, 3]], 0.1, atol=1e-6)
    assert gaps[2] > 5
    assert [f.source_index for f in source.read({1, 4})] == [1, 4]
    assert {p.name for p in tmp_path.iterdir()} == {"a.avi", "b.avi", "both.msgs"}
    digest = open_recording(run.root / "source.videos", "auto").digest
    write_manifest(run.manifest_file, Manifest(Source(str(run.root / "source.videos"), digest), {}))
    moved = RunFolder(run.root.rename(tmp_path / "moved.msgs"))
    assert moved.source.path == str(moved.root / "source.videos")
    (tmp_path / "both.videos").write_text("b.avi\na.avi\n")
    assert open_recording(tmp_path / "both.videos", "auto").digest != digest
    write_video(tmp_path / "b.avi", [_shade(9, 80)] * 2, 10.0)
    with pytest.raises(InputError, match=r"videos of .*both.videos differ in size: .*b\.avi is 80x48, .*a\.avi"):
        open_recording(tmp_path / "both.videos")
    (tmp_path / "both.videos").write_text("both.videos\n")
    with pytest.raises(InputError, match="names no videos"):
        open_recording(tmp_path / "both.videos")


def test_a_list_of_videos_never_enters_what_is_not_their_run(tmp_path: Path) -> None:
    pictures = [_shade(9)] * 2
    paths = [write_video(tmp_path / f"{name}.avi", pictures, 10.0) for name in "ab"]
    run = RunFolder(tmp_path / "both.msgs")
    with pytest.raises(InputError):
        one_source([paths[0], tmp_path], run)
    (tmp_path / "link.avi").symlink_to(paths[0])
    with pytest.raises(InputError, match="is given 2 times: give each video once"):
        one_source([*paths, tmp_path / "link.avi"], run)
    assert not run.root.exists()
    run.root.mkdir()
    (run.root / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match="not a run folder"):
        one_source(paths, run)
    assert [p.name for p in run.root.iterdir()] == ["letter.txt"]
    (run.root / "letter.txt").unlink()
    for name in (".source.tmp.videos", ".source.tmp-0123abcd-77.videos"):
        (run.root / name).write_text("a half")  # left by a process that was killed
    source = one_source(paths, run)
    assert source.read_text() == "".join(f"{path.resolve()}\n" for path in paths)


def test_archives_and_folders_of_folders_are_told_what_to_give(tmp_path: Path) -> None:
    for i in range(3):
        write_rgb(tmp_path / "scan" / "photos" / f"{i}.jpg", _noise(i))
    for kind in ("zip", "tar", "gztar", "xztar"):
        archive = shutil.make_archive(str(tmp_path / "scan"), kind, tmp_path / "scan")
        with pytest.raises(InputError, match="is an archive: unpack it first"):
            open_recording(Path(archive))
    with pytest.raises(InputError, match=r"no images in .*the folder photos/ in it holds 3 images: give that"):
        open_recording(tmp_path / "scan")
    write_rgb(tmp_path / "scan" / "cover.jpg", _noise(9))
    done = CliRunner().invoke(main, ["reconstruct", str(tmp_path / "scan"), "--out", str(tmp_path / "run"), "--quiet"])
    assert done.exit_code
    assert "holds one image only; a reconstruction needs several views of a scene: the folder photos/" in done.output


def write_photos(folder: Path, placed: int, count: int) -> Path:
    """Pictures of which the first `placed` say where they were taken."""
    folder.mkdir()
    for i in range(count):
        image = Image.fromarray(np.full((48, 64, 3), 30 * i, np.uint8))
        exif = Image.Exif()
        if i < placed:
            exif[ExifTags.Base.GPSInfo] = {1: "N", 2: (55.0, 41.0, 0.1 * i), 3: "E", 4: (13.0, 11.0, 0.0)}
        image.save(folder / f"{i}.jpg", exif=exif)
    return folder


def test_how_many_pictures_say_where_they_were_taken(tmp_path: Path) -> None:
    frames = [Frame(i, f"{i}.jpg", float(i), i, 1.0) for i in range(4)]
    some, none = (open_recording(write_photos(tmp_path / str(n), n, 4), "auto") for n in (3, 0))
    assert places_figure(some, frames) == {"gps": "of 3 of 4 images"}
    assert places_figure(none, frames) == {}
