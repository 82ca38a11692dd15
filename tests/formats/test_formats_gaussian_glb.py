"""Gaussians in glTF: round trip in numbers, and other programs' readers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from msgs_slam.formats.glb import COMPRESSION, EXTENSION, write_compressed_glb, write_gaussian_glb
from tests.clouds import random_cloud
from tests.splat_readers import read_gaussian_glb


def test_round_trip_in_numbers(tmp_path: Path) -> None:
    cloud = random_cloud()
    write_gaussian_glb(tmp_path / "a.glb", cloud, ("floor", "wall"))
    write_gaussian_glb(tmp_path / "b.glb", cloud, ("floor", "wall"))
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    read = read_gaussian_glb(tmp_path / "a.glb")
    np.testing.assert_array_equal(read.means, cloud.means)
    np.testing.assert_allclose(read.log_scales, cloud.log_scales, atol=1e-6)
    np.testing.assert_allclose(read.opacity_logits, cloud.opacity_logits, atol=1e-3)
    np.testing.assert_allclose(read.colors, cloud.colors, atol=1e-6)
    assert read.class_ids is not None
    np.testing.assert_array_equal(read.class_ids, cloud.class_ids)
    turns = [Rotation.from_quat(c.quat_wxyz[:, [1, 2, 3, 0]]) for c in (read, cloud)]
    assert (turns[0].inv() * turns[1]).magnitude().max() < 1e-3


def test_another_reader_finds_what_the_extension_says(tmp_path: Path) -> None:
    cloud = random_cloud()
    write_gaussian_glb(tmp_path / "map.glb", cloud, ("floor",))
    gltf = pygltflib.GLTF2().load(str(tmp_path / "map.glb"))
    assert gltf.extensionsUsed == [EXTENSION, "KHR_materials_unlit"]
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS
    assert primitive.extensions[EXTENSION] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    attributes = vars(primitive.attributes)
    blob = gltf.binary_blob()

    def values(name: str, width: int) -> np.ndarray:
        accessor = gltf.accessors[attributes[name]]
        view = gltf.bufferViews[accessor.bufferView]
        assert view.byteLength == 4 * width * len(cloud)
        return np.frombuffer(blob, "<f4", width * len(cloud), view.byteOffset).reshape(-1, width)

    # y is up in glTF: what was down is up, what was forward comes towards the viewer.
    np.testing.assert_array_equal(values("POSITION", 3), cloud.means * (1, -1, -1))
    np.testing.assert_allclose(values(f"{EXTENSION}:SCALE", 3), np.exp(cloud.log_scales), rtol=1e-6)
    sigmoid = 1 / (1 + np.exp(-cloud.opacity_logits))
    np.testing.assert_allclose(values(f"{EXTENSION}:OPACITY", 1)[:, 0], sigmoid, atol=1e-6)
    # The covariance in the file's axes is the cloud's own, turned.
    flip = np.diag([1.0, -1, -1])
    axes = Rotation.from_quat(values(f"{EXTENSION}:ROTATION", 4)).as_matrix()
    own = Rotation.from_quat(cloud.quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    squares = np.exp(2 * cloud.log_scales.astype(np.float64))
    spread, expected = ((r * squares[:, None]) @ r.transpose(0, 2, 1) for r in (axes, flip @ own))
    np.testing.assert_allclose(spread, expected, atol=1e-5)


def test_who_does_not_know_the_extension_sees_points(tmp_path: Path) -> None:
    cloud = random_cloud()
    write_gaussian_glb(tmp_path / "map.glb", cloud)
    points = next(iter(trimesh.load_scene(tmp_path / "map.glb").geometry.values()))
    np.testing.assert_allclose(points.vertices, cloud.means * (1, -1, -1), atol=1e-6)
    colors = np.clip(cloud.colors, 0, 1)  # COLOR_0 is linear
    light = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(points.colors[:, :3], light * 255, atol=1)


def test_compressed_is_a_tenth_and_read_again(tmp_path: Path) -> None:
    cloud = random_cloud()
    write_compressed_glb(tmp_path / "small.glb", cloud)
    read = read_gaussian_glb(tmp_path / "small.glb")
    assert 0 < np.abs(read.means - cloud.means).max() < 1e-5
    assert np.abs(read.colors - cloud.colors).max() < 0.004
    gltf = pygltflib.GLTF2().load(str(tmp_path / "small.glb"))
    assert gltf.extensionsRequired == [EXTENSION, COMPRESSION]
    assert all(a.bufferView is None and a.count == len(cloud) for a in gltf.accessors)
    np.testing.assert_allclose(gltf.accessors[0].max, (cloud.means * (1, -1, -1)).max(axis=0), atol=1e-6)


def test_an_empty_cloud_is_refused(tmp_path: Path) -> None:
    for write in (write_gaussian_glb, write_compressed_glb):
        with pytest.raises(ValueError, match="empty"):
            write(tmp_path / "none.glb", replace(random_cloud(0), class_ids=None))
