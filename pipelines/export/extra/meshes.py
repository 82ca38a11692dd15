"""The mesh of a run for engines: collision.glb to walk in, with a floor without holes, and USDZ in true size."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ....formats.atomic import atomic_path, require_room
from ....formats.errors import InputError, install_extra
from ....formats.glb import Part, linear, material, write_primitive
from ....formats.mesh import MeshArrays, read_mesh_ply
from ...outcome import Outcome
from ...run.files import MESH
from ...scene.world import WORLD, World
from .atlas import simplified

USD = "mesh.usdz"

COLLISION = "collision.glb"
MAX_FACES = 20_000
"""Triangles that physics engines on the web and on phones take."""


def mesh_of_run(outcome: Outcome, world: World) -> MeshArrays:
    """The mesh that a run's own export has made, in `world`; `outcome` is in the run's own.

    Raises InputError where there is none, or an empty one.
    """
    run = outcome.run
    if not run.has("export", MESH):
        raise InputError(
            f"{run.root} has no mesh yet, and this file is made from it: finish the run with msgs-slam resume"
        )
    mesh = read_mesh_ply(run.file("export", MESH))
    if len(mesh.faces) == 0:
        raise InputError(f"{run.root}: the mesh is empty, so there is nothing to write: film the scene again")
    if (own := run.find(WORLD)) is None:
        return mesh
    move = world.exported_from_run @ own.exported_from_run.inverse()
    return replace(mesh, vertices=move.apply(mesh.vertices.astype(np.float64)).astype(np.float32))


def write_collision(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """collision.glb of an outcome in the run's own world, for files in `world`: no colours, y up.

    Raises InputError where the run has no mesh, or an empty one.
    """
    mesh = mesh_of_run(outcome, world)
    light = simplified(mesh, MAX_FACES / len(mesh.faces)) if len(mesh.faces) > MAX_FACES else mesh
    points = light.vertices.astype(np.float64)
    faces = light.faces
    if world.axes == "up" and world.has_floor:
        points, faces = with_floor(points, faces)
    parts = [Part.of("POSITION", points @ world.gltf_from_exported.T), Part.of("", faces.astype(np.uint32).ravel())]
    extras = {"materials": [material(unlit=False)]}
    write_primitive(folder / COLLISION, parts, {"mode": 4, "material": 0}, (), {"name": "collision"}, extras)
    return [folder / COLLISION]


def with_floor(points: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The mesh (V, 3), (F, 3) with z up, and a floor at z = 0, seen from above, under everything; without one where the
    mesh is a line from above."""
    try:
        rim = points[ConvexHull(points[:, :2]).vertices, :2]  # counterclockwise
    except QhullError:
        return points, faces
    n, start = len(rim), len(points)
    fan = start + np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    floor = np.column_stack([rim, np.zeros(n)])
    return np.concatenate([points, floor]), np.concatenate([faces, fan]).astype(np.int32)


def write_usd(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """mesh.usdz of an outcome in the run's own world, for files in `world`: y up, a colour and a class at each vertex.

    Raises InputError where usd-core is not installed, or the run has no mesh, or an empty one.
    """
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise InputError(f"USD needs the package usd-core, which is not installed: {install_extra('usd')}") from error
    mesh = mesh_of_run(outcome, world)
    per_unit = 1.0 if outcome.metric or world.earth or outcome.metres is None else outcome.metres.per_unit
    write_usdz(folder / USD, mesh, outcome.classes.names, world.gltf_from_exported, per_unit)
    return [folder / USD]


def write_usdz(
    path: Path, mesh: MeshArrays, names: tuple[str, ...], turn: NDArray[np.float64], metres_per_unit: float
) -> None:
    """Write a package with one binary layer in it; `turn` (3, 3) makes y up. Raises DiskFullError where there
    is no room for it."""
    from pxr import Usd, UsdGeom, UsdUtils

    require_room(path, 2 * 24 * len(mesh.vertices))  # a layer, and the package with a copy of it
    with atomic_path(path) as temporary, tempfile.TemporaryDirectory(dir=temporary.parent) as scratch:
        stage = Usd.Stage.CreateNew(str(layer := Path(scratch) / "mesh.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, metres_per_unit)
        root = UsdGeom.Xform.Define(stage, "/Scene")
        stage.SetDefaultPrim(root.GetPrim())
        shape = UsdGeom.Mesh.Define(stage, "/Scene/Mesh")
        _fill(shape, mesh, names, (mesh.vertices @ turn.T).astype(np.float32))
        _paint(stage, shape)
        stage.Save()
        package = Path(scratch) / USD
        UsdUtils.CreateNewUsdzPackage(str(layer), str(package))
        package.replace(temporary)


def _fill(shape: Any, mesh: MeshArrays, names: tuple[str, ...], points: NDArray[np.float32]) -> None:
    """Triangles, linear colours, and the number of each vertex's class as the primvar `label`."""
    from pxr import Sdf, UsdGeom, Vt

    colors = linear(mesh.colors / 255)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(colors))
    labels = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("label", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
    labels.Set(Vt.IntArray.FromNumpy(mesh.labels.astype(np.int32)))
    shape.GetPrim().SetCustomDataByKey("classes", Vt.StringArray(list(names)))


def _paint(stage: Any, shape: Any) -> None:
    """A material that shows the colours: some viewers ignore them without one."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/Scene/Colours")
    surface = UsdShade.Shader.Define(stage, "/Scene/Colours/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    reader = UsdShade.Shader.Define(stage, "/Scene/Colours/Reader")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
