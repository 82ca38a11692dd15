"""The mesh as USDZ, read by USD's own library and passed by its checker."""

import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.glb import ClassMesh, write_mesh_glb
from msgs_slam.formats.images import decode_rgb
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export.stage import export_run, find_world
from msgs_slam.pipelines.run.files import CLASSES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.target import LIST
from msgs_slam.pipelines.scene.world import WORLD

OracleRun = Callable[..., RunFolder]


@pytest.fixture
def run(oracle_run: OracleRun) -> RunFolder:
    """Its mesh is in the world of its exported files."""
    run = oracle_run(mesh=True)
    world, _ = find_world(load_outcome(run), ExportConfig())
    assert world.axes == "up"
    WORLD.save(run.stage("export"), world)
    mesh = read_mesh_ply(run.file("export", "mesh.ply"))
    uv, nothing = np.zeros((len(mesh.vertices), 2), np.float32), np.zeros((0, 0, 3), np.uint8)
    turned, labels = mesh.vertices @ world.gltf_from_exported.T, mesh.labels[mesh.faces[:, 0]]
    light = ClassMesh(turned.astype(np.float32), mesh.colors, labels, np.arange(len(uv)), uv, mesh.faces, nothing)
    write_mesh_glb(run.stage("export") / "mesh.glb", light)
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    return run


def test_usd_reads_the_mesh_with_its_colours_and_classes(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    from pxr import Usd, UsdGeom, UsdValidation

    path = export_run(run, tmp_path / "out", "usd")[0]
    stage = Usd.Stage.Open(str(path))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    shape = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Mesh"))
    mesh = read_mesh_ply(run.file("export", "mesh.ply"))
    points, corners, normals = (
        np.array(a.Get()) for a in (shape.GetPointsAttr(), shape.GetFaceVertexIndicesAttr(), shape.GetNormalsAttr())
    )
    order = np.argsort(mesh.labels[mesh.faces[:, 0]], kind="stable")
    turned = mesh.vertices @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)
    np.testing.assert_allclose(points[corners], turned[mesh.faces[order].ravel()], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    labels = UsdGeom.PrimvarsAPI(shape).GetPrimvar("label")
    assert labels.GetInterpolation() == "uniform"
    np.testing.assert_array_equal(np.array(labels.Get()), mesh.labels[mesh.faces[order, 0]])
    assert list(shape.GetPrim().GetCustomDataByKey("classes")) == list(run.load(CLASSES).names)
    linear = np.array(shape.GetDisplayColorPrimvar().Get())
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * shown[corners], mesh.colors[mesh.faces[order].ravel()], atol=0.51)
    assert sorted(p.name for p in path.parent.iterdir()) == [LIST, "README.txt", "mesh.usdz", "world.json"]


def test_usd_has_the_texture_of_the_glb(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    world = run.load(WORLD)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 2], [0, 0, 2.0]], np.float32)  # upright in the exported world
    texture = np.zeros((16, 16, 3), np.uint8)
    texture[:8] = (200, 30, 120)  # above
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    faces, labels = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([1, 2], np.uint8)
    wall = ClassMesh(
        (corners @ world.gltf_from_exported.T).astype(np.float32), np.zeros((4, 3), np.uint8), labels, np.arange(4), uv,
        faces, texture,
    )  # fmt: skip
    write_mesh_glb(run.stage("export") / "mesh.glb", wall, ("a", "b", "c"))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    path = export_run(run, tmp_path / "out", "usd")[0]
    stage = Usd.Stage.Open(str(path))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    shape = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Mesh"))
    points, indices = (np.array(a.Get()) for a in (shape.GetPointsAttr(), shape.GetFaceVertexIndicesAttr()))
    st, label = (np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar(n).Get()) for n in ("st", "label"))
    np.testing.assert_allclose(points[indices][:, 1], corners[faces.ravel()][:, 2], atol=1e-5)  # y is up
    np.testing.assert_allclose(st[indices][:, 1], corners[faces.ravel()][:, 2] / 2, atol=1e-5)
    np.testing.assert_array_equal(label, labels)
    with zipfile.ZipFile(path) as package:
        (name,) = (n for n in package.namelist() if n.endswith(".jpg"))
        shown = decode_rgb(package.read(name), name)
    np.testing.assert_allclose(shown[2, 8], (200, 30, 120), atol=6)
    file = UsdShade.Shader(stage.GetPrimAtPath("/Scene/Colours/Texture")).GetInput("file").Get()
    assert file.resolvedPath.endswith(f"[{name}]")


def test_without_the_package_or_a_mesh_nothing_is_written(
    run: RunFolder, oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"-m pip install 'usd-core>="):
        export_run(run, tmp_path / "out", "usd")
    assert not (tmp_path / "out").exists()
