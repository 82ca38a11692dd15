"""pycolmap's reconstruction as arrays."""

import numpy as np
import pycolmap
import pytest

from msgs_slam.formats.colmap import ModelArrays, pose_of, set_pose


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
