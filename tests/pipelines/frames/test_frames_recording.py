"""Data sets as sources: what their readers know reaches the frames, the camera and the proxies."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import LAYOUTS, START, seven_scenes, tum
from PIL import Image

from msgs_slam.formats.datasets import Camera, Dataset, open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.frames.keyframes import pick_frames
from msgs_slam.pipelines.frames.tasks import known_camera
from msgs_slam.pipelines.geometry.camera import resize_depth
from msgs_slam.pipelines.geometry.sequence import Sequence as ProxySequence
from msgs_slam.pipelines.proxy.selection import (
    Choice,
    ProviderContext,
    check_proxy,
    open_given_depth,
    open_given_semantics,
)
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import CALIBRATION, FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.lens import FramePixels, distortion_of, make_lens, to_pycolmap
from msgs_slam.pipelines.source.recording import DatasetRecording, FolderRecording, open_recording
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Calibration, Frame, Intrinsics
from tests.pipelines.part_of_sequence import part_of


@pytest.fixture(scope="session")
def short(truth: Dataset) -> Dataset:
    """Five frames of the room are enough to tell one layout from another."""
    return part_of(truth, range(0, 20, 4))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_is_recognised_and_read(layout: str, short: Dataset, tmp_path: Path) -> None:
    write, format, timed, _, _ = LAYOUTS[layout]
    path = write(short, tmp_path / "set")
    source = open_recording(path)
    assert isinstance(source, DatasetRecording)
    assert (source.sequence.format, source.expected_frames, source.is_timed()) == (format, 5, timed)
    frames = list(source.read())
    wanted = np.stack([short.rgb(i) for i in range(5)]).astype(float)
    if layout == "euroc":
        wanted = np.repeat(wanted[..., 1:2], 3, axis=-1)
    # A .sens file holds JPEGs.
    assert np.abs(np.stack([f.rgb for f in frames]) - wanted).mean() < (3 if layout == "sens" else 1e-9)
    if timed:
        gaps = 0.1 if layout in ("scannet", "seven_scenes") else np.diff(short.timestamps)
        np.testing.assert_allclose(np.diff([f.timestamp for f in frames]), gaps, atol=1e-5)
    camera, true = source.camera(), short.camera
    assert camera is not None
    assert true is not None
    found, expected = ((c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (camera, true))
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert len({source.name(i, i) for i in range(5)}) == 5
    assert open_recording(path, format).expected_frames == 5


def test_warnings_of_an_interrupted_attempt_are_given_once(short: Dataset, tmp_path: Path) -> None:
    source = open_recording(seven_scenes(short, tmp_path / "set"))
    for _ in range(2):
        context = StageContext(RunFolder(tmp_path), source.path, Config(), tmp_path, SilentProgress())
        context.warn("looks like panoramas")  # by every attempt, before it picks
        pick_frames(context, source, None)
        assert context.warnings.count("looks like panoramas") == 1


def test_a_camera_of_a_file_is_fixed_and_one_of_the_kind_is_a_start(short: Dataset, tmp_path: Path) -> None:
    path = seven_scenes(short, tmp_path / "set")
    context = StageContext(RunFolder(tmp_path), path, Config(), tmp_path, SilentProgress())
    camera, origin = known_camera(context, open_recording(path), None)
    assert (origin, camera.params.tolist()) == ("stated", pytest.approx([208, 208, 120, 90], abs=20))
    (path / "camera-intrinsics-color.txt").unlink()
    camera, origin = known_camera(context, open_recording(path), None)
    assert (origin, camera.model.name, camera.has_prior_focal_length) == ("self-calibrated", "SIMPLE_RADIAL", True)
    assert camera.params.tolist() == [525 * 240 / 640, 120, 90, 0]


@pytest.mark.parametrize("layout", [name for name, row in LAYOUTS.items() if row[3]])
def test_depth_and_labels_of_the_set_are_the_oracle(layout: str, short: Dataset, tmp_path: Path) -> None:
    write, _, _, _, has_labels = LAYOUTS[layout]
    path = write(short, tmp_path / "set")
    around = surroundings(path)
    depths = open_given_depth(around, Choice("files"))
    assert depths.missing(around.sequence.frames) == []
    wanted = short.depth(3)
    assert wanted is not None
    found = depths.estimate(around.sequence.frames[3])
    assert found.depth.shape == (90, 120)
    off = np.abs(found.depth - resize_depth(wanted, 90, 120))
    if layout == "seven_scenes":  # by a camera beside: what things hide from it is unknown, slopes are a pixel aside
        assert off.max() > 0
        assert np.median(off[found.depth > 0]) < 6e-3
        assert (found.depth > 0).mean() > 0.9
    else:
        assert off.max() < 2e-3
    assert (found.confidence == (found.depth > 0)).all()
    if not has_labels:
        with pytest.raises(InputError, match="has no labels: --semantics files:FOLDER"):
            open_given_semantics(around, Choice("files"))
        return
    labels = open_given_semantics(around, Choice("files"))
    labels.fit(around.sequence.frames, lambda frame: depths.estimate(frame))
    true = short.labels(3)
    assert true is not None
    given = labels.estimate(around.sequence.frames[3], found).labels
    names = [*labels.classes().names]
    expected = (
        [*short.class_names] if layout == "semantic_nerf" else [f"class {i + 1}" for i in range(len(short.classes))]
    )
    for value in np.unique(given):
        where = true[1::2, 1::2][given == value]
        assert (where == (VOID if value == VOID else expected.index(names[value]))).all()


def test_a_data_set_without_any_depth_value_is_refused_before_anything_slow(short: Dataset, tmp_path: Path) -> None:
    path = tum(short, tmp_path / "set")
    config = load_config(overrides=["proxy.depth=files"])
    check_proxy(path, config)
    for file in (path / "depth").iterdir():
        write_grey_png(file, np.zeros((180, 240), np.uint16))
    with pytest.raises(InputError, match="hold no depth at all"):
        check_proxy(path, config)


def surroundings(path: Path) -> ProviderContext:
    source = open_recording(path)
    assert isinstance(source, DatasetRecording)
    camera = source.camera()
    assert camera is not None
    k = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    frames = [Frame(i, source.name(i, i), 0.1 * i, i, 1.0) for i in range(source.expected_frames)]
    calibration = Calibration(k, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    sequence = ProxySequence(frames, calibration, k.resized(120, 90), None, lambda frame: source.sequence.rgb(frame.id))
    config = Config().proxy
    return ProviderContext(
        path, sequence, config, lambda name: path / name, 1, "cpu", SilentProgress(), source
    )  # fmt: skip


def _config(depth: str, semantics: str) -> Config:
    return load_config(overrides=[f"proxy.depth={depth}", f"proxy.semantics={semantics}"])


@pytest.mark.parametrize("distortion", [(-0.2, 0.03, 0.001, 0.0), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)])
def test_maps_follow_the_lens(distortion: tuple[float, ...]) -> None:
    """Sampling by the calibration alone finds the pixels that undistortion took, also those of a third coefficient."""
    lens = make_lens(to_pycolmap(Camera(320, 240, 258.0, 257.0, 159.0, 121.0, distortion)))
    assert lens.shift_px > 3
    calibration = Calibration(lens.pinhole, "given", 0.0, distortion_of(lens.camera))
    column = np.tile(np.arange(320, dtype=np.float32) * 0.7 + 10, (240, 1))
    taken = lens.undistort_image(np.repeat(column[..., None], 3, axis=2))[..., 0].astype(float)
    error = FramePixels(calibration).sample(column) - taken
    assert 0 < np.abs(error)[3:-3, 3:-3].max() < 0.7 * 0.5 + 1.1  # half a pixel, and the picture's own rounding
    ideal = FramePixels(Calibration(lens.pinhole, "given", 0.0, (0.0,) * 4)).sample(column) - taken
    assert np.abs(ideal).max() > 2


def test_a_folder_of_images_is_no_data_set_by_what_lies_beside_it(short: Dataset, tmp_path: Path) -> None:
    path = LAYOUTS["semantic_nerf"][0](short, tmp_path / "set")
    assert isinstance(open_recording(path / "rgb"), FolderRecording)
    seven = LAYOUTS["seven_scenes"][0](short, tmp_path / "seven")
    assert isinstance(open_recording(seven), DatasetRecording)
    assert isinstance(open_recording(seven, "images"), FolderRecording)
    for i in range(5):
        write_rgb(tmp_path / "plain" / f"{i}.png", short.rgb(i))
    LAYOUTS["colmap"][0](short, tmp_path / "plain")
    assert isinstance(open_recording(tmp_path / "plain"), FolderRecording)
    assert isinstance(open_recording(tmp_path / "plain", "colmap"), DatasetRecording)
    with pytest.raises(InputError, match="did you mean 'scannet'"):
        open_recording(tmp_path / "plain", "scanet")


@pytest.mark.parametrize(
    "strays", [["thumbnail.jpg"], ["banana.png", "trimesh.PNG"], ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]]
)
@pytest.mark.parametrize("layout", ["colmap", "nerfstudio", "images", "frames"])
def test_pictures_beside_the_images_do_not_hide_a_project(
    layout: str, strays: list[str], short: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "project"
    LAYOUTS["nerfstudio" if layout == "nerfstudio" else "colmap"][0](short, path)
    if layout in ("images", "frames"):
        shutil.rmtree(path / "sparse")
        (path / "images").rename(path / layout)
    for name in (*strays, "._0.jpg", ".DS_Store", "Thumbs.db"):
        Image.new("RGB", (20, 30)).save(path / name, "PNG")
    source = open_recording(path)
    assert isinstance(source, DatasetRecording)
    assert source.sequence.format == (layout if layout in ("colmap", "nerfstudio") else "folder")
    assert source.expected_frames == 5
    if source.sequence.format == "folder":
        assert f"the 5 images in {layout}/ are used, not the {len(strays)} in project/" in source.sequence.notes
    assert isinstance(open_recording(path, "images"), FolderRecording)


def test_a_damaged_first_image_does_not_cost_the_set(short: Dataset, tmp_path: Path) -> None:
    for layout in ("tum", "nerfstudio", "scannet", "colmap", "nice_slam", "seven_scenes"):
        path = LAYOUTS[layout][0](short, tmp_path / layout)
        first = open_sequence(path).image_paths[0]
        first.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
        warnings: list[str] = []
        source = open_recording(path)
        assert (source.width, len(list(source.read(warn=warnings.append)))) == (240, 4), layout
        assert "git-LFS" in "".join(warnings)


def test_a_data_set_is_reconstructed_with_what_it_knows(truth: Dataset, tmp_path: Path) -> None:
    """TUM layout, nothing said but that its depth is wanted: its camera is taken, lengths are metres, times its own."""
    path, run = tum(truth, tmp_path / "set"), RunFolder(tmp_path / "set.msgs")
    config = load_config(overrides=["proxy.depth=files", "frames.rate=4", "run.threads=2"])
    reconstruct(path, run, config, SilentProgress(), until="tracking")
    calibration = run.load(CALIBRATION)
    assert calibration.origin == "given"
    assert truth.camera is not None
    assert calibration.intrinsics.fx == pytest.approx(truth.camera.fx)
    assert run.load(FRAMES)[0].timestamp > START - 1
    result = evaluate_outcome(load_outcome(run), open_sequence(path))
    assert result["frames"]["with true pose"] == result["frames"]["posed"] == len(run.load(FRAMES))
    assert 0 < result["trajectory"]["se3 all"]["rmse"] < 0.03
    # The same pictures under another name are another source.
    with pytest.raises(InputError, match="another source"):
        reconstruct(path / "rgb", run, replace(config, run=replace(config.run, format="images")), SilentProgress())
