"""The export opened as other programs open it: the names, keys and types that their own loaders ask for, step by step.

Each test names the source whose steps it takes. The steps are told again here; nothing of those programs runs.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile
import pycolmap
import pytest
from finished import note_finished
from numpy.typing import NDArray
from PIL import Image

from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export.kinds import EXPORTS
from msgs_slam.pipelines.export.stage import WIDTH, export_run
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import SPARSE
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome

OracleRun = Callable[..., RunFolder]


@pytest.fixture(scope="module")
def folder(oracle_run: OracleRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cameras, pictures, points and Gaussians as in any export."""
    run, folder = oracle_run(video=True), tmp_path_factory.mktemp("opened") / "export"
    SPARSE.save(run.stage("tracking"), sparse_model(load_outcome(run)))
    note_finished(run, ("frames", "proxy", "tracking", "mapping"))
    for kind in ("colmap", "ply"):
        export_run(run, folder, kind, settings=ExportConfig())
    return folder


def sparse_model(outcome: Outcome) -> SparseModel:
    """Some of the Gaussians' centres as points, each seen by the keyframes in whose pictures it falls."""
    t, k, m = outcome.trajectory, outcome.calibration.intrinsics, outcome.require_map()
    keyframes = np.flatnonzero(t.is_keyframe)
    points = m.means.numpy()[::97].astype(np.float64)
    seen: list[tuple[int, int, float, float]] = []
    for row, frame in enumerate(keyframes):
        pose = t.cam_from_world[frame]
        xy, z = project(points @ pose[:3, :3].T + pose[:3, 3], k)
        inside = (z > 0) & (xy > 0).all(axis=1) & (xy < (k.width, k.height)).all(axis=1)
        seen += [(row, int(n), *xy[n]) for n in np.flatnonzero(inside)]
    table = np.array(seen)
    frame_index, point_index = (table[:, i].astype(np.int64) for i in (0, 1))
    colors = (255 * m.colors.numpy()[::97]).clip(0, 255).astype(np.uint8)
    poses = t.cam_from_world[keyframes]
    return SparseModel(t.frame_ids[keyframes], poses, points, colors, frame_index, point_index, table[:, 2:])


def seen_in(points: NDArray, camera_from_world: NDArray, intrinsics: NDArray, size: tuple[int, int]) -> float:
    """Share of points (P, 3) that fall into a picture of that size: of a wrong axis or path, next to none do."""
    in_camera = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    pixels = in_camera @ intrinsics.T
    xy = pixels[:, :2] / pixels[:, 2:]
    return float(((in_camera[:, 2] > 0) & (xy > 0).all(axis=1) & (xy < size).all(axis=1)).mean())


def test_gsplat_simple_trainer(folder: Path) -> None:
    """gsplat, examples/datasets/colmap.py, class Parser, with `--data_factor 1`.

    sparse/0 by pycolmap's Reconstruction, a pinhole camera, `images` hard-coded, its files in the order of the model's
    names; points, their errors and colours of points3D.
    """
    model = pycolmap.Reconstruction(str(folder / "sparse/0/"))
    image_folder = folder / "images"
    files = sorted(str(p.relative_to(image_folder)) for p in image_folder.rglob("*") if p.is_file())
    names = sorted(image.name for image in model.images.values())
    assert files == names, "both lists are joined by their order"
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert Image.open(image_folder / image.name).size == (camera.width, camera.height)
    assert sum(len(image.get_observation_points2D()) for image in model.images.values()) > 100
    points = np.array([p.xyz for p in model.points3D.values()], np.float32)
    colors = np.array([p.color for p in model.points3D.values()], np.uint8)
    errors = np.array([p.error for p in model.points3D.values()], np.float32)
    assert len(points) == len(colors) == len(errors) > 100
    assert np.isfinite(errors).all()
    assert np.ptp(colors) > 50


def read_binary(path: Path) -> tuple[dict[int, tuple], int]:
    """images.bin by the struct layout that the original trainer's colmap_loader.py unpacks: id → (qvec, tvec, camera
    id, name), and the bytes left over."""
    data, at = path.read_bytes(), 8
    images: dict[int, tuple] = {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *pose, camera = struct.unpack_from("<idddddddi", data, at)
        at += 64
        end = data.index(b"\0", at)
        points = struct.unpack_from("<Q", data, end + 1)[0]
        images[number] = (pose[:4], pose[4:], camera, data[at:end].decode("utf-8"))
        at = end + 9 + 24 * points
    return images, len(data) - at


def test_original_trainer(folder: Path) -> None:
    """graphdeco-inria/gaussian-splatting, scene/__init__.py (a folder `sparse` makes it a COLMAP scene) and
    scene/dataset_readers.py: readColmapSceneInfo, readColmapCameras, fetchPly.

    sparse/0/images.bin and cameras.bin, pinhole only; `images/` with the names' last parts; sparse/0/points3D.ply with
    x y z, nx ny nz, red green blue, which it makes of points3D.bin where it is missing.
    """
    assert (folder / "sparse").exists()
    images, left = read_binary(folder / "sparse/0/images.bin")
    assert left == 0
    camera = struct.unpack_from("<QiiQQ4d", (folder / "sparse/0/cameras.bin").read_bytes())
    assert camera[:3] == (1, 1, 1), "one camera, number 1, model 1: PINHOLE"
    stems = [Path(name).name.split(".")[0] for *_, name in images.values()]
    assert len(set(stems)) == len(images)
    for *_, camera_id, name in images.values():
        assert camera_id == 1
        assert Image.open(folder / "images" / Path(name).name).size == camera[3:5]
    vertices = plyfile.PlyData.read(str(folder / "sparse/0/points3D.ply"))["vertex"]
    positions = np.vstack([vertices[n] for n in ("x", "y", "z")]).T
    colors = np.vstack([vertices[n] for n in ("red", "green", "blue")]).T / 255.0
    normals = np.vstack([vertices[n] for n in ("nx", "ny", "nz")]).T
    assert positions.shape == colors.shape == normals.shape
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    points = [model.points3D[i] for i in sorted(model.points3D)]
    np.testing.assert_allclose(positions, [p.xyz for p in points], atol=1e-5)
    np.testing.assert_array_equal(np.rint(255 * colors), [p.color for p in points])


def opened_transforms(folder: Path) -> dict:
    """What both readers of transforms.json take: keys of the whole, and of each frame."""
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] in ("OPENCV", "PINHOLE")
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        assert float(meta[key]) > 0
    assert not any(meta[key] for key in ("k1", "k2", "p1", "p2"))
    for frame in meta["frames"]:
        assert Image.open(folder / frame["file_path"]).size == (meta["w"], meta["h"])
        assert np.array(frame["transform_matrix"]).shape == (4, 4)
    return meta


def test_nerfstudio(folder: Path) -> None:
    """nerfstudio, data/dataparsers/nerfstudio_dataparser.py: _generate_dataparser_outputs and _load_3D_points.

    transforms.json in the folder, `file_path` relative to it, `transform_matrix` in OpenGL's axes, `ply_file_path`
    relative to it, read by open3d (x y z and red green blue as uchar).
    """
    meta = opened_transforms(folder)
    ply = plyfile.PlyData.read(str(folder / meta["ply_file_path"]))["vertex"]
    assert {ply.ply_property(n).val_dtype for n in ("red", "green", "blue")} == {"u1"}
    points = np.vstack([ply[n] for n in ("x", "y", "z")]).T
    intrinsics = np.array([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]])
    shares = []
    for frame in meta["frames"]:
        camera = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])  # x right, y down, z forward
        shares.append(seen_in(points, np.linalg.inv(camera), intrinsics, (meta["w"], meta["h"])))
    assert np.mean(shares) > 0.15
    assert any("mask_path" in frame for frame in meta["frames"]) == all("mask_path" in f for f in meta["frames"])


def header_as_opensplat_reads_it(lines: list[str]) -> int:
    """Vertices by OpenSplat's header rules; ValueError where it would throw."""
    if lines[0] != "ply" or lines[1] != "format binary_little_endian 1.0":
        raise ValueError(lines[:2])
    rest = iter(lines[2:])
    vertex = next(line for line in rest if not line.startswith(("comment", "obj_info")))
    if not vertex.startswith("element vertex"):
        raise ValueError(vertex)
    for name in "xyz":
        if not (line := next(rest)).endswith(name):
            raise ValueError(line)
    after = list(rest)
    colors = [i for i, line in enumerate(after) if line.split()[-1] in ("red", "green", "blue")]
    if colors != list(range(colors[0], colors[0] + 3)) or after[-1].split()[-1] != "blue":
        raise ValueError(after)
    return int(vertex.split()[2])


def test_opensplat(folder: Path) -> None:
    """OpenSplat, input_data.cpp (a transforms.json makes it a nerfstudio project), nerfstudio.cpp and point_io.cpp.

    `ply_file_path` must not be empty; its PLY has x y z first as floats, then nx ny nz, then red green blue side by
    side as bytes, and nothing after them: rows are read by that order alone.
    """
    meta = opened_transforms(folder)
    assert meta["ply_file_path"]
    data = (folder / meta["ply_file_path"]).read_bytes()
    head, body = data.split(b"end_header\n", 1)
    count = header_as_opensplat_reads_it(head.decode().splitlines())
    assert len(body) == count * (3 * 4 + 3 * 4 + 3) > 0


def test_brush(folder: Path) -> None:
    """ArthurBrussee/brush, crates/brush-dataset/src/formats: colmap.rs and mod.rs.

    Of all models below the folder that of the most images, binary before text; an image is the first file whose path
    ends in its name, outside of masks/; its mask has its name or stem there. It starts from the last of all PLY files,
    whatever is in them: that must be the points, not the mesh or the map.
    """
    files = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file()]
    models = [p for p in files if p.name in ("cameras.bin", "cameras.txt")]
    counts = {p: pycolmap.Reconstruction(str(folder / p.parent)).num_reg_images() for p in models}
    chosen = min(models, key=lambda p: (-counts[p], p))
    assert chosen == Path("sparse/0/cameras.bin")
    model = pycolmap.Reconstruction(str(folder / chosen.parent))
    for image in model.images.values():
        found = min(p for p in files if p.as_posix().endswith(image.name) and "masks" not in p.parts)
        assert found == Path("images", image.name)
        assert Image.open(folder / found).size == (image.camera.width, image.camera.height)
        assert image.camera.model.name == "PINHOLE"
    images = {name for p in files if p.parts[0] == "images" for name in (p.name, p.stem)}
    assert {p.stem for p in files if p.parts[0] == "masks"} <= images
    written = {Path(file.name) for kind in EXPORTS for file in kind.files if file.name.endswith(".ply")}
    start = max(written | {p for p in files if p.suffix == ".ply"})
    assert start == Path("sparse/0/points3D.ply")
    assert Path("mesh.ply") in written
    ply = plyfile.PlyData.read(str(folder / start))["vertex"]
    assert [ply.ply_property(n).val_dtype for n in ("x", "red", "green", "blue")] == ["f4", "u1", "u1", "u1"]


def test_the_semantic_map_has_classes_and_no_probabilities(folder: Path) -> None:
    """What README.txt and docs/files.md say of the two PLY files; a splat viewer reads the properties of the original
    code (scene/gaussian_model.py, load_ply) by name."""
    whole, semantic = (
        plyfile.PlyData.read(str(folder / n))["vertex"] for n in ("point_cloud.ply", "point_cloud_semantic.ply")
    )
    names = [[p.name for p in v.properties] for v in (whole, semantic)]
    probabilities = [n for n in names[0] if n.startswith("class_prob_")]
    assert probabilities
    assert all(n.removeprefix("class_prob_").isdecimal() for n in probabilities)
    assert names[1] == [n for n in names[0] if n not in probabilities]
    np.testing.assert_array_equal(whole["class_id"], semantic["class_id"])
    total = sum(whole[n].astype(float) for n in probabilities)
    np.testing.assert_allclose(total, 1, atol=1e-5)
    for name in ("x", "y", "z", "opacity", "f_dc_0", "f_dc_2", "scale_0", "scale_2", "rot_0", "rot_3"):
        assert name in names[1]


def explained(folder: Path) -> list[str]:
    """Names of the files that README.txt has an entry for."""
    entries = (folder / "README.txt").read_text().partition("\nMore kinds of files")[0].splitlines()[2:]
    return [line.split("  ")[0] for line in entries if line and not line.startswith(" ")]


def test_a_kind_alone_says_what_it_is(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run(video=True)
    export_run(run, tmp_path, "spz", settings=ExportConfig())
    assert explained(tmp_path) == ["point_cloud.spz", "world.json"]
    export_run(run, tmp_path, settings=ExportConfig(voxel=0.05))
    assert max(map(len, (tmp_path / "README.txt").read_text().splitlines())) <= WIDTH
    names = explained(tmp_path)
    assert "mesh.ply" in names
    assert "point_cloud.spz" in names, "it is still there"
    assert not any(name.startswith(("masks/", "tiles/", "piece_2", "depth/")) for name in names)
