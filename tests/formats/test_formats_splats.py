"""SPZ, SOG and transforms.json, read again by the formats' descriptions."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Camera, open_sequence
from msgs_slam.formats.datasets.nerfstudio import write_transforms
from msgs_slam.formats.gaussians import GaussianCloud
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import SH_C0
from msgs_slam.formats.sog import write_sog
from msgs_slam.formats.spz import spz_bytes
from tests.clouds import random_cloud
from tests.matrices import random_poses
from tests.splat_readers import read_gaussian_ply, read_spz, unpack_spz


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def _rotations(cloud: GaussianCloud) -> np.ndarray:
    return Rotation.from_quat(cloud.quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()


@pytest.mark.parametrize(("extent", "version"), [(0.01, 4), (5.0, 2), (5.0, 4), (3000.0, 4)])
def test_spz_round_trip_within_its_steps(extent: float, version: int) -> None:
    cloud = random_cloud(extent=extent)
    data = spz_bytes(cloud, version)
    assert data == spz_bytes(cloud, version)
    back = unpack_spz(data)
    error = np.abs(back.means - cloud.means).max()
    assert 0 < error <= max(0.51 / 2**16, extent / 2**20)
    assert 0 < np.abs(back.log_scales - cloud.log_scales).max() <= 0.5 / 16 + 1e-5
    assert np.abs(_sigmoid(back.opacity_logits) - _sigmoid(cloud.opacity_logits)).max() <= 0.51 / 255
    assert np.abs(back.colors - cloud.colors).max() <= 0.51 / 255 / 0.15 * 0.2821
    steps = 255 if version == 2 else 1024  # of a component; where the fourth is small its error is a larger one
    assert 0 < np.abs(_rotations(back) - _rotations(cloud)).max() < (0.2 if version == 2 else 8 / steps)
    assert len(data) < 25 * len(cloud) + 200
    assert len(unpack_spz(spz_bytes(random_cloud(0), version))) == 0
    cloud.means[0, 0] = 1e9
    with pytest.raises(ValueError, match="below 4 million"):
        spz_bytes(cloud, version)


def test_the_reader_of_these_tests_reads_what_another_program_wrote(shared_data: Path) -> None:
    """Of SPZ and PLY, the same Gaussians."""
    folder = shared_data / "format_cases" / "ply_other_writers"
    ply = read_gaussian_ply(folder / "test-splat.3-points-from-train.ply")
    spz = read_spz(folder / "test-splat.3-points-from-train.spz")
    np.testing.assert_allclose(spz.means, ply.means, atol=2e-4)
    np.testing.assert_allclose(spz.log_scales, ply.log_scales, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(_rotations(spz), _rotations(ply), atol=0.02)
    np.testing.assert_allclose(_sigmoid(spz.opacity_logits), _sigmoid(ply.opacity_logits), atol=1 / 255)
    np.testing.assert_allclose(spz.colors, ply.colors, atol=1 / 255 / 0.15 * 0.2821)


def test_transforms_come_back_through_the_data_set_reader(tmp_path: Path) -> None:
    poses = random_poses(3)
    names = [f"frames/{i}.png" for i in range(3)]
    for name in names:
        write_rgb(tmp_path / name, np.zeros((6, 8, 3), np.uint8))
    write_transforms(tmp_path / "transforms.json", 8, 6, 7.0, 7.5, 4.25, 3.0, names, poses, "map.ply")
    sequence = open_sequence(tmp_path)
    assert sequence.format == "nerfstudio"
    assert sequence.camera == Camera(8, 6, 7.0, 7.5, 4.25, 3.0)
    np.testing.assert_allclose(sequence.world_from_cam, poses, atol=1e-12)
    with pytest.raises(ValueError, match="got 2 images"):
        write_transforms(tmp_path / "transforms.json", 8, 6, 7.0, 7.5, 4.25, 3.0, names[:2], poses)


def _unpacked(path: Path) -> tuple[dict, dict[str, NDArray[np.float64]]]:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def picture(name: str) -> NDArray[np.float64]:
            image = Image.open(io.BytesIO(archive.read(name)))
            assert (image.format, image.mode) == ("WEBP", "RGBA") or image.mode == "RGB"
            return np.asarray(image.convert("RGBA"), np.float64).reshape(-1, 4)[: meta["count"]]

        low, high = (picture(n)[:, :3] for n in meta["means"]["files"])
        mins, maxs = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        logs = mins + (high * 256 + low) / 65535 * (maxs - mins)
        color, quats = picture(meta["sh0"]["files"][0]), picture(meta["quats"]["files"][0])
        scales = np.array(meta["scales"]["codebook"])[picture(meta["scales"]["files"][0])[:, :3].astype(int)]
        base = np.array(meta["sh0"]["codebook"])[color[:, :3].astype(int)]
    parts = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(1 - (parts**2).sum(1), 0))
    wxyz = np.array(
        [np.insert(p, int(kind) - 252, whole) for p, kind, whole in zip(parts, quats[:, 3], largest, strict=True)]
    )
    return meta, {
        "means": np.sign(logs) * np.expm1(np.abs(logs)), "log_scales": scales, "colors": 0.5 + SH_C0 * base,
        "opacity": color[:, 3] / 255, "quat_wxyz": wxyz,
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 17, 3000])
def test_a_cloud_is_what_was_written(tmp_path: Path, count: int) -> None:
    cloud = random_cloud(count)
    write_sog(tmp_path / "a.sog", cloud)
    meta, found = _unpacked(tmp_path / "a.sog")
    assert (meta["version"], meta["count"]) == (2, count)
    row = np.linalg.norm(found["means"][:, None] - cloud.means[None], axis=2).argmin(axis=1)
    assert sorted(row.tolist()) == list(range(count))
    np.testing.assert_allclose(found["means"], cloud.means[row], atol=2e-3)
    np.testing.assert_allclose(found["log_scales"], cloud.log_scales[row], atol=0.25)
    assert np.abs(found["log_scales"] - cloud.log_scales[row]).mean() < 0.01
    assert np.abs(found["colors"] - cloud.colors[row]).max() < 1 / 255
    np.testing.assert_allclose(found["opacity"], 1 / (1 + np.exp(-cloud.opacity_logits[row])), atol=0.003)
    assert (np.abs((found["quat_wxyz"] * cloud.quat_wxyz[row]).sum(1)) > 0.9999).all()


def test_the_same_cloud_gives_the_same_bytes_and_none_is_refused(tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, random_cloud(100))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    with pytest.raises(ValueError, match="without Gaussians"):
        write_sog(tmp_path / "c.sog", random_cloud(0))
