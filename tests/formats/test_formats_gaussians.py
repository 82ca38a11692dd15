"""Gaussian splat files: the reference layout to the byte, read again by plyfile."""

import time
from pathlib import Path

import numpy as np
import plyfile
import pytest

from msgs_slam.formats.gaussians import GaussianCloud, isotropic_cloud
from msgs_slam.formats.ply import SH_C0, write_gaussian_ply
from tests.splat_readers import read_gaussian_ply


def _cloud(m: int = 300, classes: int = 7) -> GaussianCloud:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 3, (m, classes))
    probs = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return isotropic_cloud(
        rng.normal(0, 3, (m, 3)).astype(np.float32),
        rng.normal(-4, 1, m).astype(np.float32),
        rng.normal(0, 3, m).astype(np.float32),
        rng.uniform(0, 1, (m, 3)).astype(np.float32),
        probs.astype(np.float32),
    )


def test_the_property_order_is_that_of_the_original(tmp_path: Path, shared_data: Path) -> None:
    reference = plyfile.PlyData.read(
        str(shared_data / "format_cases" / "ply_other_writers" / "test-splat.3-points-from-train.ply")
    )["vertex"].data.dtype
    write_gaussian_ply(tmp_path / "3.ply", _cloud(), sh_degree=3)
    write_gaussian_ply(tmp_path / "0.ply", _cloud())
    full = plyfile.PlyData.read(str(tmp_path / "3.ply"))["vertex"].data.dtype
    lean = plyfile.PlyData.read(str(tmp_path / "0.ply"))["vertex"].data.dtype
    extra = ("class_id", *(f"class_prob_{i}" for i in range(7)))
    assert full.names == reference.names + extra
    assert all(full[name] == reference[name] for name in reference.names)
    assert lean.names == tuple(n for n in reference.names if not n.startswith("f_rest")) + extra
    assert lean["class_id"] == np.uint8


def test_values_are_stored_as_a_viewer_expects(tmp_path: Path) -> None:
    cloud = isotropic_cloud(
        np.array([[1, 2, 3]], np.float32),
        np.log(np.array([0.05], np.float32)),
        np.array([2.0], np.float32),
        np.array([[1.0, 0.5, 0.0]], np.float32),
        np.array([[0.2, 0.7, 0.1]], np.float32),
    )
    write_gaussian_ply(tmp_path / "g.ply", cloud, ("wall", "floor", "sofa"))
    ply = plyfile.PlyData.read(str(tmp_path / "g.ply"))
    row = ply["vertex"][0]
    assert (row["x"], row["y"], row["z"]) == (1, 2, 3)
    assert [row[f"f_dc_{i}"] * SH_C0 + 0.5 for i in range(3)] == pytest.approx([1, 0.5, 0])
    assert [np.exp(row[f"scale_{i}"]) for i in range(3)] == pytest.approx([0.05] * 3)
    assert [row[f"rot_{i}"] for i in range(4)] == [1, 0, 0, 0]
    assert 1 / (1 + np.exp(-row["opacity"])) == pytest.approx(0.8808, abs=1e-4)
    assert row["class_id"] == 1
    assert ply.comments == ["class 0 wall", "class 1 floor", "class 2 sofa"]


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_round_trip(tmp_path: Path, sh_degree: int) -> None:
    cloud = _cloud()
    write_gaussian_ply(tmp_path / "g.ply", cloud, sh_degree=sh_degree)
    back = read_gaussian_ply(tmp_path / "g.ply")
    for field in ("means", "log_scales", "quat_wxyz", "opacity_logits", "class_ids", "class_probs"):
        assert (getattr(back, field) == getattr(cloud, field)).all(), field
    np.testing.assert_allclose(back.colors, cloud.colors, atol=3e-7)


def test_a_long_class_table_costs_only_the_classes_that_occur(tmp_path: Path) -> None:
    names = tuple(f"thing {i}" for i in range(102))
    cloud = _cloud(50, 102)
    assert cloud.class_probs is not None
    cloud.class_probs[:] = 0
    cloud.class_probs[:, 7], cloud.class_probs[:, 90] = 0.75, 0.25
    write_gaussian_ply(tmp_path / "g.ply", cloud, names)
    properties = [p.name for p in plyfile.PlyData.read(str(tmp_path / "g.ply"))["vertex"].properties]
    assert [n for n in properties if n.startswith("class_prob")] == ["class_prob_7", "class_prob_90"]
    back = read_gaussian_ply(tmp_path / "g.ply").class_probs
    assert back is not None
    assert back.shape == (50, 102)
    assert (back == cloud.class_probs).all()


def test_a_cloud_in_parts_is_the_same_file(tmp_path: Path) -> None:
    cloud, names = _cloud(300, 7), tuple("abcdefg")
    assert cloud.class_probs is not None
    cloud.class_probs[:200, 2] = 0  # a class that occurs in the last part only
    parts = [cloud.only(rows) for rows in np.array_split(np.arange(300), [1, 200, 200])]
    write_gaussian_ply(tmp_path / "whole", cloud, names)
    write_gaussian_ply(tmp_path / "parts", parts, names)
    assert (tmp_path / "parts").read_bytes() == (tmp_path / "whole").read_bytes()


def test_values_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    cloud = _cloud(5)
    cloud.means[2, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        write_gaussian_ply(tmp_path / "g.ply", cloud)
    assert list(tmp_path.iterdir()) == []


def test_half_a_million_are_fast(tmp_path: Path) -> None:
    cloud = _cloud(500_000, 20)
    start = time.process_time()
    write_gaussian_ply(tmp_path / "g.ply", cloud)
    back = read_gaussian_ply(tmp_path / "g.ply")
    assert time.process_time() - start < 15
    assert (back.means == cloud.means).all()
