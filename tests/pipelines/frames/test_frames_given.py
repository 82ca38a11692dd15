"""Poses and cameras that are given: a start, a yardstick, what carries a path where the pictures say nothing."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.colmap import write_colmap_model
from msgs_slam.formats.datasets.sequence import Camera
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.frames.findings import _require_same_images
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.run.files import GIVEN_POSES
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.candidates import GIVEN, _selection_score
from msgs_slam.pipelines.sfm.consistency import ModelReport
from msgs_slam.pipelines.sfm.given import fit_given_poses, posed_model
from msgs_slam.pipelines.sfm.lens import to_pycolmap, unknown_camera
from msgs_slam.pipelines.source.given import given_poses
from msgs_slam.pipelines.source.recording import open_recording
from msgs_slam.pipelines.types import Frame, GivenPoses
from tests.colmap_models import posed_images
from tests.pipelines.frames.made_views import structure_of, walk_round

CAMERA = to_pycolmap(Camera(640, 480, 520.0, 520.0, 320.0, 240.0))


def disturbed(cam_from_world: NDArray[np.float64], metres: float = 0.05, degrees: float = 3.0) -> NDArray[np.float64]:
    """Each pose off by its own so many metres and degrees; every tenth missing, one somewhere else altogether."""
    rng = np.random.default_rng(1)
    world_from_cam = se3.inverse(cam_from_world)
    turns = rng.normal(size=(len(world_from_cam), 3))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    world_from_cam = world_from_cam @ se3.exp(np.column_stack([np.zeros_like(turns), turns]))
    world_from_cam[:, :3, 3] += rng.normal(0, metres / np.sqrt(3), (len(world_from_cam), 3))
    world_from_cam[7, :3, 3] += [40.0, -3.0, 8.0]
    given = se3.inverse(world_from_cam)
    given[4::10] = np.nan
    return given


def test_agreement_tells_scale_noise_and_what_is_absurd() -> None:
    made = walk_round(CAMERA, views=40)
    given = disturbed(made.cam_from_world)
    known = np.isfinite(given).all(axis=(1, 2))
    ours = made.cam_from_world[known].copy()
    ours[:, :3, 3] /= 2.5
    found = fit_given_poses(ours, given[known])
    assert found is not None
    assert found.move.scale == pytest.approx(2.5, rel=0.04)
    assert found.position_sd * np.sqrt(3) == pytest.approx(0.05, rel=0.4)
    assert np.flatnonzero(known)[found.wrong].tolist() == [7]
    assert fit_given_poses(ours[:2], given[:2]) is None


def test_only_poses_that_contradict_all_of_a_sound_structure_are_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("".join(f"{i}.0 0 0 0 0 0 0 1\n" for i in range(20)))
    found = walk_round(CAMERA, views=20).cam_from_world
    warnings: list[str] = []
    context = SimpleNamespace(config=load_config(overrides=[f'frames.poses="{tmp_path / "poses.txt"}"']),
                              warn=warnings.append)  # fmt: skip

    def judge(given: NDArray[np.float64], largest: range, is_consistent: bool = True) -> None:
        report = SimpleNamespace(largest=tuple(largest), is_consistent=is_consistent)
        frames = [Frame(i, f"{i}.jpg", float(i), i, 0.0) for i in range(20)]
        structure, poses = SimpleNamespace(report=report), GivenPoses(given, False, "made up")
        _require_same_images(context, structure, poses, found, frames, [*range(20)])  # type: ignore[arg-type]

    given = disturbed(found)
    judge(np.where(np.isfinite(given), given, found), range(20))
    # A part that shares no point with the rest lies anywhere; the given poses will tell where.
    apart = found.copy()
    apart[11:] = apart[11:] @ se3.exp(np.array([9.0, -4.0, 3.0, 0.8, -1.1, 0.4]))
    judge(apart, range(11))
    other = found[np.random.default_rng(0).permutation(20)]
    judge(other, range(20), is_consistent=False)
    assert "contradict the images, by" in warnings[-1]
    with pytest.raises(InputError, match="contradict the images, by"):
        judge(other, range(20))


def test_a_camera_that_turns_where_it_stands_is_known_by_its_turns() -> None:
    rng, count = np.random.default_rng(3), 40
    turns = np.column_stack([np.zeros((count, 4)), np.linspace(-0.6, 0.6, count), np.zeros(count)])
    world_from_cam = se3.exp(turns)
    world_from_cam[:, :3, 3] = rng.normal(0, 0.04, (count, 3))
    noisy = world_from_cam @ se3.exp(np.column_stack([np.zeros((count, 3)), rng.normal(0, 0.01, (count, 3))]))
    noisy[:, :3, 3] += rng.normal(0, 0.05, (count, 3))
    own = fit_given_poses(se3.inverse(world_from_cam), se3.inverse(noisy))
    slower = fit_given_poses(se3.inverse(world_from_cam)[::2], se3.inverse(noisy)[: count // 2])
    assert own is not None
    assert own.extent_degrees == pytest.approx(np.degrees(1.2 / np.sqrt(12)), rel=0.1)
    assert own.position_sd > 0.4 * own.extent
    assert not own.is_contradiction
    assert slower is not None
    assert slower.is_contradiction


@pytest.mark.parametrize("is_known", [True, False], ids=["known_camera", "unknown_camera"])
def test_poses_that_are_far_off_make_a_model_as_good_as_none(is_known: bool, tmp_path: Path) -> None:
    made = walk_round(CAMERA)
    camera = CAMERA if is_known else unknown_camera(640, 480, 1.2 * 640, is_prior=False)
    pairs, given = made.pairs(camera), disturbed(made.cam_from_world)
    model = posed_model(camera, made.views().xy, given, pairs, not is_known, 0)
    assert model is not None
    structure = structure_of(made, camera, tmp_path, is_fixed=is_known, given=given)
    views = made.views(given)
    found = structure._build_model(GIVEN, views, pairs, pairs)
    assert found is not None
    grown = structure._register_remaining(found, views, pairs, pairs)
    assert grown[0].num_reg_images() == 20
    assert made.off(grown[0]) < (0.02 if is_known else 0.03)


def test_images_that_match_nothing_do_not_stop_the_model_from_growing(tmp_path: Path) -> None:
    made, blank = walk_round(CAMERA), {3, 12}
    given = disturbed(made.cam_from_world)
    pairs = [p for p in made.pairs(CAMERA) if not {p.first, p.second} & blank]
    structure, views = structure_of(made, CAMERA, tmp_path, given=given), made.views(given)
    found = structure._build_model(GIVEN, views, pairs, pairs)
    assert found is not None
    grown = structure._register_remaining(found, views, pairs, pairs)[0]
    assert {i - 1 for i in grown.reg_image_ids()} == set(range(20)) - blank


@pytest.mark.parametrize(("agreement", "wanted"), [(0.695, GIVEN), (0.65, "neighbours")])
def test_given_poses_decide_between_models_that_the_matches_do_not(agreement: float, wanted: str) -> None:
    model, both = pycolmap.Reconstruction(), (tuple(range(9)),)
    tried = [
        (model, "neighbours", ModelReport(9, 9, 500, 0.3, 0.7, 0.7, (), both)),
        (model, GIVEN, ModelReport(9, 9, 500, 0.3, agreement, 0.7, (), both)),
    ]
    assert max(tried, key=_selection_score)[1] == wanted


def test_given_poses_cost_nothing_where_the_pictures_are_enough(tmp_path: Path) -> None:
    made = walk_round(CAMERA)
    pairs = made.pairs(CAMERA)
    (tmp_path / "with").mkdir()
    alone = structure_of(made, CAMERA, tmp_path)._calibrated(made.views(), pairs)
    beside = structure_of(made, CAMERA, tmp_path / "with")._calibrated(
        made.views(disturbed(made.cam_from_world)), pairs
    )
    assert alone is not None
    assert beside is not None
    assert beside.mapper == alone.mapper
    assert made.off(beside.model) == pytest.approx(made.off(alone.model))


def test_they_are_kept_for_the_stages_behind(tmp_path: Path) -> None:
    given = GivenPoses(disturbed(walk_round(CAMERA).cam_from_world), True, "made up")
    again = GIVEN_POSES.read(GIVEN_POSES.save(tmp_path, given))
    np.testing.assert_array_equal(again.cam_from_world, given.cam_from_world)
    assert (again.is_metric, again.what) == (True, "made up")
    assert given.known.sum() == 18


def _ramp(start: int) -> np.ndarray:
    """An image (48, 64, 3) that is not of one colour."""
    return np.broadcast_to(np.arange(start, start + 64, dtype=np.uint8)[None, :, None], (48, 64, 3)).copy()


def test_poses_named_by_frame_numbers_belong_to_a_videos_frames(tmp_path: Path) -> None:
    """The last number in a name counts: those before it are the clip's, the camera's, the date's."""
    video = write_video(tmp_path / "clip1.avi", (_ramp(9 * i) for i in range(8)), 10, "MJPG")
    frames = [{"file_path": f"clip1_4k/clip1.{i:05d}.jpg", "transform_matrix": np.eye(4).tolist()} for i in range(8)]
    for i, frame in enumerate(frames):
        frame["transform_matrix"][0][3] = float("nan") if i == 6 else float(i)
    frames.append({"file_path": "cm².jpg", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    config, warnings = FramesConfig(poses=str(tmp_path)), []
    picked = [Frame(k, f"{k:06d}.jpg", i / 10, i, 0.0) for k, i in enumerate((1, 3, 6, 7))]
    given = given_poses(config, open_recording(video), picked, warnings.append)
    assert given is not None
    np.testing.assert_allclose(-given.cam_from_world[:, 0, 3], [1, 3, np.nan, 7])
    assert "1 of its poses are not finite" in "".join(warnings)


def test_poses_of_equal_names_belong_to_the_images_of_their_folders(tmp_path: Path) -> None:
    names = [f"cam_{c}/{i}.png" for c in "ab" for i in range(3)]
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    for i, name in enumerate(names):
        write_rgb(tmp_path / "images" / name.upper(), _ramp(9 * i))
    write_colmap_model(tmp_path / "sparse" / "0", posed_images(names, poses, 64, 48, 50.0, 50.0, 32.0, 24.0))
    for folder, expected in ((tmp_path, range(6)), (tmp_path / "images" / "CAM_B", range(3, 6))):
        source = open_recording(folder)
        frames = [Frame(i, source.name(i, i), 0.0, i, 0.0) for i in range(len(expected))]
        given = given_poses(FramesConfig(poses=str(tmp_path)), source, frames)
        assert given is not None
        assert given.cam_from_world[:, 0, 3].tolist() == list(expected)


def test_poses_of_one_number_twice_are_refused_for_a_video(tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip1.avi", (_ramp(9 * i) for i in range(8)), 10, "MJPG")
    rows = [f"{c}/{i}.jpg,0,0,0,0,0,0,1" for c in "ab" for i in range(4)]
    (tmp_path / "poses.csv").write_text("\n".join(["name,x,y,z,qx,qy,qz,qw", *rows]))
    with pytest.raises(InputError, match="two poses are of images with the number 0"):
        given_poses(FramesConfig(poses=str(tmp_path / "poses.csv")), open_recording(video), [])


KINECT = Camera(640, 480, 517.3, 516.5, 319.1, 255.8, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
PLAIN = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)


@pytest.mark.parametrize("mapper", ["global", "incremental"])
@pytest.mark.parametrize("camera", [KINECT, PLAIN], ids=["strong_distortion", "plain"])
def test_a_true_camera_is_held(camera: Camera, mapper: str, tmp_path: Path) -> None:
    """COLMAP's mappers take a camera with a coefficient above 1 for bogus unless told otherwise."""
    true = to_pycolmap(camera)
    made = walk_round(true)
    structure = structure_of(made, true, tmp_path, is_stated=True)
    found = structure._map(made.views(), made.pairs(true), (mapper,))
    assert found is not None
    assert found[0].num_reg_images() == 20
    found = structure._calibrated(made.views(), made.pairs(true))
    assert found is not None
    assert found.model.cameras[1].params.tolist() == true.params.tolist()
    assert made.off(found.model) < 0.01


def test_a_camera_that_the_pictures_refute_is_found_anew(tmp_path: Path) -> None:
    made = walk_round(to_pycolmap(PLAIN))
    stated = to_pycolmap(Camera(640, 480, 620.0, 620.0, 320.0, 240.0))
    pairs = made.pairs(stated)
    held = structure_of(made, stated, tmp_path)._calibrated(made.views(), pairs)
    found = structure_of(made, stated, tmp_path, is_stated=True)._calibrated(made.views(), pairs)
    assert held is not None
    assert found is not None
    assert held.model.cameras[1].mean_focal_length() == 620
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(520, rel=0.01)
    assert made.off(found.model) < 0.01
    assert made.off(found.model) < made.off(held.model) / 3
    assert np.isfinite(found.focal_sd)
    assert found.focal_sd > 0
