"""Splat files: read again by the formats' descriptions and by other programs."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from msgs_slam.formats.splats import (
    COMPRESSION,
    EXTENSION,
    SH_C0,
    GaussianCloud,
    isotropic_cloud,
    spz_bytes,
    write_compressed_glb,
    write_gaussian_glb,
    write_gaussian_ply,
    write_sog,
)
from tests.clouds import random_cloud
from tests.splat_readers import read_gaussian_glb, read_gaussian_ply, read_spz, unpack_spz


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
    write_gaussian_ply(tmp_path / "a.ply", _cloud())
    ours = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data.dtype
    names = tuple(n for n in reference.names if not n.startswith("f_rest"))  # no view-dependent colour
    assert ours.names == (*names, "class_id", *(f"class_prob_{i}" for i in range(7)))
    assert all(ours[name] == reference[name] for name in names)
    assert ours["class_id"] == np.uint8


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


def test_ply_round_trip(tmp_path: Path) -> None:
    cloud = _cloud()
    write_gaussian_ply(tmp_path / "g.ply", cloud)
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
    np.testing.assert_allclose(_rotations(read), _rotations(cloud), atol=1e-3)


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
    sigmoid = _sigmoid(cloud.opacity_logits)
    np.testing.assert_allclose(values(f"{EXTENSION}:OPACITY", 1)[:, 0], sigmoid, atol=1e-6)
    # The covariance in the file's axes is the cloud's own, turned.
    flip = np.diag([1.0, -1, -1])
    axes = Rotation.from_quat(values(f"{EXTENSION}:ROTATION", 4)).as_matrix()
    own = _rotations(cloud)
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
    for write in (write_sog, write_gaussian_glb, write_compressed_glb):
        with pytest.raises(ValueError, match=r"empty|without Gaussians"):
            write(tmp_path / "none", replace(random_cloud(0), class_ids=None))
