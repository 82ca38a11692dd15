"""COLMAP models: pycolmap reads what we write, every digit of it comes back, and its reconstruction is arrays."""

import resource
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats.colmap import (
    ColmapModel,
    ModelArrays,
    model_suffix,
    pose_of,
    read_colmap_model,
    set_pose,
    write_colmap_model,
)
from msgs_slam.formats.errors import InputError
from tests.colmap_models import posed_images

WIDTH, HEIGHT, FX, FY, CX, CY = 640, 480, 525.0, 520.0, 321.0, 238.5


def _scene(noise: float = 0.0) -> ColmapModel:
    """6 cameras that look at 200 points, observations in random order, two points that nobody saw."""
    rng = np.random.default_rng(0)
    cam_from_world = np.tile(np.eye(4), (6, 1, 1))
    cam_from_world[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, (6, 3))).as_matrix()
    cam_from_world[:, :3, 3] = rng.normal(0, 0.3, (6, 3)) + np.array([0, 0, 5])
    points = rng.uniform(-1, 1, (200, 3))
    image, point = (a.ravel() for a in np.meshgrid(np.arange(6), np.arange(198), indexing="ij"))
    keep = rng.permutation(len(image))[:800]
    keep = np.concatenate([keep, np.setdiff1d(np.flatnonzero(image == 0), keep)])
    image, point = image[keep], point[keep]
    in_cam = np.einsum("oij,oj->oi", cam_from_world[image, :3, :3], points[point]) + cam_from_world[image, :3, 3]
    xy = in_cam[:, :2] / in_cam[:, 2:] * [FX, FY] + [CX, CY] + noise * rng.choice([-1.0, 1.0], (len(image), 2))
    return ColmapModel(
        names=tuple(f"img_{i * 7 % 6}.jpg" for i in range(6)),
        cam_from_world=cam_from_world,
        cameras=(("PINHOLE", WIDTH, HEIGHT, (FX, FY, CX, CY)),),
        points=points,
        colors=rng.integers(0, 256, (200, 3)).astype(np.uint8),
        obs_image=image,
        obs_point=point,
        obs_xy=xy,
    )


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_pycolmap_reads_both_kinds(tmp_path: Path, kind: str, noise: float) -> None:
    scene = _scene(noise)
    write_colmap_model(tmp_path, scene)
    for path in tmp_path.glob("*"):
        if path.suffix != f".{kind}":
            path.unlink()
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_reg_images(), model.num_points3D(), len(model.cameras)) == (6, 200, 1)
    stored = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    recomputed = model.compute_mean_reprojection_error()
    # COLMAP counts the two unseen points as 0 when it computes the errors anew; they are written as without one
    assert stored * 198 / 200 == pytest.approx(recomputed, abs=1e-9)
    # every observation is off by (±0.5, ±0.5)
    assert stored == pytest.approx(noise * np.sqrt(2), abs=1e-2 * noise + 1e-9)
    back = read_colmap_model(tmp_path)
    assert set(back.names) == set(scene.names)
    order = np.argsort(scene.names)
    np.testing.assert_allclose(back.cam_from_world, scene.cam_from_world[order], atol=1e-14)
    assert (back.points == scene.points).all()
    assert (back.colors == scene.colors).all()
    assert back.cameras == scene.cameras
    rank = np.argsort(order)
    ours = sorted(zip(rank[scene.obs_image], scene.obs_point, *scene.obs_xy.T, strict=True))
    assert sorted(zip(back.obs_image, back.obs_point, *back.obs_xy.T, strict=True)) == ours


def test_written_files_are_the_same_every_time(tmp_path: Path) -> None:
    write_colmap_model(tmp_path / "a", _scene())
    (left := tmp_path / "b" / ".model.tmp").mkdir(parents=True)  # by a process that was killed
    (left / "cameras.bin").write_bytes(b"half")
    write_colmap_model(tmp_path / "b", _scene())
    assert not left.exists()
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == [f"{n}{s}" for n in ("cameras", "images", "points3D") for s in (".bin", ".txt")]
    assert all((tmp_path / "a" / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in names)


def test_a_model_without_points(tmp_path: Path) -> None:
    write_colmap_model(tmp_path, posed_images(["a.png"], np.eye(4)[None], 8, 8, 5.0, 5.0, 4.0, 4.0))
    back = read_colmap_model(tmp_path)
    assert back.names == ("a.png",)
    assert back.points.shape == (0, 3)
    assert back.obs_xy.shape == (0, 2)


def test_names_with_blanks_survive_in_the_binary_files(tmp_path: Path) -> None:
    scene = _scene()
    write_colmap_model(
        tmp_path, ColmapModel(**{**scene.__dict__, "names": tuple(f"my image {i}.jpg" for i in range(6))})
    )
    assert read_colmap_model(tmp_path).names[2] == "my image 2.jpg"


@pytest.mark.parametrize("spoil", ["shape", "index", "name", "nan"])
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, spoil: str) -> None:
    scene = _scene()
    changed = {
        "shape": {"obs_xy": scene.obs_xy[:-1]},
        "index": {"obs_point": scene.obs_point + 10},
        "name": {"names": ("same.jpg",) * 6},
        "nan": {"points": scene.points * np.nan},
    }[spoil]
    with pytest.raises(ValueError, match="write_colmap_model"):
        write_colmap_model(tmp_path, ColmapModel(**{**scene.__dict__, **changed}))
    assert list(tmp_path.iterdir()) == []


def test_a_real_model_in_both_kinds(shared_data: Path) -> None:
    binary = read_colmap_model(shared_data / "format_cases" / "colmap_table10" / "sparse" / "0")
    text = read_colmap_model(shared_data / "format_cases" / "colmap_table10" / "text")
    assert (len(binary.names), len(binary.points)) == (10, 2167)
    assert binary.names == text.names
    assert binary.cameras[0][0] == "SIMPLE_RADIAL"
    for field in ("cam_from_world", "points", "colors", "obs_image", "obs_point", "obs_xy"):
        np.testing.assert_allclose(
            getattr(binary, field), getattr(text, field), atol=6e-3 if field == "obs_xy" else 1e-4
        )


def test_incomplete_models_are_explained(shared_data: Path, tmp_path: Path) -> None:
    assert model_suffix(shared_data / "phone_desk" / "sparse" / "0") is None
    with pytest.raises(InputError, match="no complete COLMAP model"):
        read_colmap_model(shared_data / "phone_desk" / "sparse" / "0")
    assert len(read_colmap_model(shared_data / "phone_desk" / "colmap_derived").names) == 70


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_truncated_files_are_refused_before_memory_is_spent(tmp_path: Path, part: str) -> None:
    write_colmap_model(tmp_path / "whole", _scene())
    data = (tmp_path / "whole" / f"{part}.bin").read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for keep in (0, 4, 9, len(data) // 3, len(data) - 1):
        folder = tmp_path / str(keep)
        shutil.copytree(tmp_path / "whole", folder)
        (folder / f"{part}.bin").write_bytes(data[:keep])
        with pytest.raises(InputError, match=r"is damaged|is empty"):
            read_colmap_model(folder)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Twelve images of one camera, one of them without a pose; features without a point among those with one."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D, options.num_points2D_without_point3D = 60, 5
    made = pycolmap.synthesize_dataset(options)
    made.deregister_frame(made.images[5].frame_id)
    return made


def test_the_observations_are_those_of_the_model_image_after_image(model: pycolmap.Reconstruction) -> None:
    found = ModelArrays.of(model)
    assert found.image_ids.tolist() == sorted(model.reg_image_ids())
    assert 5 not in found.image_ids
    assert len(found.obs_cam) == model.compute_num_observations() > 100
    for i, own in zip(found.image_ids.tolist(), found.rows(), strict=True):
        features = model.images[i].points2D
        seen = [k for k, p in enumerate(features) if p.has_point3D()]
        assert found.obs_feature[own].tolist() == seen
        assert np.array_equal(found.obs_xy[own], [features[k].xy for k in seen])
        assert found.point_ids[found.obs_point[own]].tolist() == [features[k].point3D_id for k in seen]
    assert all(np.array_equal(model.points3D[p].xyz, at) for p, at in zip(found.point_ids, found.points, strict=True))


def test_images_in_another_order_and_none_at_all(model: pycolmap.Reconstruction) -> None:
    ids = sorted(model.reg_image_ids())[::-2]
    assert ModelArrays.of(model, ids).image_ids.tolist() == ids
    nothing = ModelArrays.of(pycolmap.Reconstruction())
    assert nothing.cam_from_world.shape == (0, 4, 4)
    assert nothing.obs_xy.shape == (0, 2)
    assert nothing.rows() == []


def test_what_has_moved_is_read_again_and_the_rest_is_kept(model: pycolmap.Reconstruction) -> None:
    before = ModelArrays.of(model)
    pose, point = pose_of(model.images[3]), int(before.point_ids[7])
    pose[:3, 3] += [1.0, 2.0, 3.0]
    set_pose(model, 3, pose)
    model.points3D[point].xyz = [4.0, 5.0, 6.0]
    after = before.reread(model)
    moved = before.image_ids.tolist().index(3)
    assert np.allclose(after.cam_from_world[moved], pose)
    assert np.array_equal(after.points[7], [4.0, 5.0, 6.0])
    assert np.array_equal(np.delete(after.cam_from_world, moved, 0), np.delete(before.cam_from_world, moved, 0))
    assert after.obs_xy is before.obs_xy
