"""Videos and pictures of a finished map, and the demo around them."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.datasets import Sequence, open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_writer import write_video
from msgs_slam.pipelines.evaluation.demo import TRUTH, VIDEO, demo_summary, run_demo, unpack_demo_clip
from msgs_slam.pipelines.evaluation.image_quality import psnr
from msgs_slam.pipelines.outcome import load_outcome
from msgs_slam.pipelines.run.folder import RunFolder, load_records
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.viewer.render_run import film_seconds, render_run
from tests.world import make_world, render_frame
from tests.world.demo_clip import OPTIONS, pack_clip

OracleRun = Callable[..., RunFolder]


def test_own_path_in_colour_shows_the_frames(oracle_run: OracleRun, truth: Sequence, tmp_path: Path) -> None:
    folder = render_run(oracle_run(), tmp_path / "pictures", kind="color", path="own", fps=1.6)
    pictures = [read_rgb(p) for p in list_images(folder)]
    assert len(pictures) == 5
    # Frames 0 and 31 are the ends of the path; 0 is a keyframe.
    assert 18 < psnr(pictures[0], truth.rgb(0)) < 45
    assert psnr(pictures[0], truth.rgb(0)) > psnr(pictures[0], truth.rgb(20)) + 4


def test_a_rendering_replaces_an_earlier_one_and_no_photographs(oracle_run: OracleRun, tmp_path: Path) -> None:
    run, folder, photos = oracle_run(), tmp_path / "pictures", tmp_path / "photos"
    for fps, count in ((1.6, 5), (1.6, 5), (1.0, 3)):
        assert len(list_images(render_run(run, folder, path="own", fps=fps, size=(32, 24)))) == count
    write_rgb(photos / "000001.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "film.mp4").write_bytes(b"precious")
    for target in (photos, tmp_path / "film.mp4"):
        with pytest.raises(InputError, match=r"which msgs-slam has not written.*--overwrite"):
            render_run(run, target, path="own", fps=1.0, size=(32, 24))
    assert [p.name for p in list_images(photos)] == ["000001.png"]
    assert (tmp_path / "film.mp4").read_bytes() == b"precious"
    render_run(run, photos, path="own", fps=1.0, size=(32, 24), overwrite=True)
    assert len(list_images(photos)) == 3


def test_a_video_whose_name_has_no_suffix_is_no_folder(oracle_run: OracleRun, tmp_path: Path) -> None:
    run, clip = oracle_run(), tmp_path / "clip"
    for there, is_folder in ((lambda: None, True), (lambda: clip.write_bytes(b"video"), False)):
        there()  # what is gone is judged by its name
        write_manifest(run.manifest_file, Manifest(Source(str(clip), ""), load_records(run)))
        assert load_outcome(RunFolder(run.root)).source_is_folder is is_folder


@pytest.mark.parametrize(
    ("count", "apart", "seconds"), [(32, 0.2, 6.2), (32, 300.0, 31), (11, 3e7, 10), (320, 90.0, 60), (3000, 0.1, 299.9)]
)
def test_photos_are_a_second_of_film_each_and_a_minute_in_all(count: int, apart: float, seconds: float) -> None:
    assert film_seconds(np.arange(count) * apart) == pytest.approx(seconds)


def test_the_length_of_a_film_is_said_first(
    oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    outcome, told = load_outcome(run), list[str]()
    walk = replace(outcome.trajectory, timestamps=np.arange(32) * 300.0)
    monkeypatch.setattr(
        "msgs_slam.pipelines.viewer.render_run.load_outcome", lambda _: replace(outcome, trajectory=walk)
    )
    folder = render_run(run, tmp_path / "film", path="own", fps=0.2, size=(24, 18), tell=told.append)
    assert len(list_images(folder)) == 6  # of 31 seconds, not of 9,300
    assert told == ["rendering 6 images: a film of 30 s at 0.2 images a second"]


@pytest.mark.parametrize("name", ["out.gif", "out.mov", "OUT.WEBM", "out.mpg4"])
def test_suffixes_that_cannot_be_written_are_refused_before_the_work(
    name: str, oracle_run: OracleRun, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"cannot be written as .*\.mp4, \.avi, \.mkv, or a folder"):
        render_run(oracle_run(), tmp_path / name)
    assert not (tmp_path / name).exists()


def test_side_by_side_video_of_an_orbit(oracle_run: OracleRun, tmp_path: Path) -> None:
    video = render_run(oracle_run(), tmp_path / "orbit.mp4", "side-by-side", "orbit", fps=0.4)
    frames = [f.rgb for f in VideoReader(video)]
    assert len(frames) == 4
    assert frames[0].shape == (180, 3 * 240, 3)
    for first, second in ((frames[0], frames[1]), (frames[0][:, :240], frames[0][:, 240:480])):
        assert np.abs(first.astype(float) - second).mean() > 5


def test_unknown_kinds_and_runs_without_a_map_are_refused(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run()
    with pytest.raises(InputError, match="kind is one of"):
        render_run(run, tmp_path / "x", kind="colour")
    with pytest.raises(InputError, match="path is one of"):
        render_run(run, tmp_path / "x", path="helix")
    (tmp_path / "taken.txt").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        render_run(run, tmp_path / "taken.txt")
    note_finished(run, ("frames", "proxy", "tracking"))
    with pytest.raises(InputError, match="no map yet"):
        render_run(run, tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.fixture
def clip(world_sequence: Path, tmp_path: Path) -> Path:
    """The walk of `world_sequence`, packed as the demo's own clip is."""
    pictures = (read_rgb(p) for p in list_images(world_sequence / "rgb"))
    folder = tmp_path / "clip"
    video = write_video(folder / "made" / VIDEO, pictures, 10.0)
    return pack_clip(folder, video, world_sequence)


def test_demo_reconstructs_the_video_alone_and_then_opens_the_truth(
    oracle_run: OracleRun, clip: Path, tmp_path: Path
) -> None:
    seen: list[Path] = []

    def reconstruct(video: Path, run: RunFolder) -> None:
        seen.append(video)
        shutil.copytree(oracle_run(video=True, metric=False, rename=True).root, run.root)

    result = run_demo(tmp_path, reconstruct, SilentProgress(), clip)
    assert seen == [tmp_path / VIDEO]
    assert sum(1 for _ in VideoReader(tmp_path / VIDEO)) == 32
    assert result.figures["trajectory"]["sim3 all"]["rmse"] < 1e-6
    assert "32 of 32 frames posed" in demo_summary(result)[0]
    assert (result.run.root / "evaluation" / "views.png").exists()
    stamp = (tmp_path / VIDEO).stat().st_mtime_ns
    assert unpack_demo_clip(tmp_path, clip)[0].stat().st_mtime_ns == stamp


def test_demo_does_not_write_over_another_video(tmp_path: Path) -> None:
    (tmp_path / VIDEO).write_bytes(b"mine")
    with pytest.raises(InputError, match="not the demo's"):
        unpack_demo_clip(tmp_path)
    assert (tmp_path / VIDEO).read_bytes() == b"mine"
    assert not (tmp_path / TRUTH).exists()


def test_the_demo_comes_with_what_the_made_up_world_shows(tmp_path: Path) -> None:
    _, truth = unpack_demo_clip(tmp_path)
    sequence, world = open_sequence(truth), make_world(texel=0.02)  # coarser textures on the same surfaces
    assert len(sequence) == OPTIONS.frames
    for index in (0, 20):
        frame = render_frame(world, OPTIONS, index)
        np.testing.assert_allclose(sequence.world_from_cam[index], frame.world_from_cam, atol=1e-8)
        np.testing.assert_allclose(sequence.depth(index), frame.depth, atol=6e-4)
        told, shown = np.array(sequence.class_names), np.array(world.class_names)
        np.testing.assert_array_equal(told[sequence.labels(index)], shown[frame.labels])
        assert sequence.timestamps[index] == pytest.approx(frame.timestamp)
        here, later = (psnr(sequence.rgb(i), frame.rgb) for i in (index, index + 3))
        assert later + 2 < here < 60
