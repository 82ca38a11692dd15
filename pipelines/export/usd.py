"""The mesh as USDZ, one file for Quick Look, Blender, Houdini and Omniverse; in true size where metres are known."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import atomic_path, require_room
from ...formats.errors import InputError
from ..outcome import Outcome
from ..scene.world import World
from ..types import SemanticMesh
from .mesh import mesh_of_run

USD = "mesh.usdz"


def write_usd(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """mesh.usdz of an outcome in the run's own world, for files in `world`: y up, a colour and a class at each vertex.

    Raises InputError where usd-core is not installed, or the run has no mesh, or an empty one.
    """
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise InputError(
            "USD needs the package usd-core, which is not installed: pip install 'msgs-slam[usd]'"
        ) from error
    mesh = mesh_of_run(outcome, world)
    per_unit = 1.0 if outcome.metric or world.earth or outcome.metres is None else outcome.metres.per_unit
    write_usdz(folder / USD, mesh, outcome.classes.names, world.gltf_from_exported, per_unit)
    return [folder / USD]


def write_usdz(
    path: Path, mesh: SemanticMesh, names: tuple[str, ...], turn: NDArray[np.float64], metres_per_unit: float
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


def _fill(shape: Any, mesh: SemanticMesh, names: tuple[str, ...], points: NDArray[np.float32]) -> None:
    """Triangles, linear colours, and the number of each vertex's class as the primvar `label`."""
    from pxr import Sdf, UsdGeom, Vt

    colors = mesh.colors.astype(np.float32) / 255
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4).astype(np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear))
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
