"""The mesh of a run for engines: collision.glb to walk in, with a floor without holes, and USDZ in true size."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...formats.atomic import atomic_path, require_room, temporary_folder
from ...formats.errors import InputError, install_extra
from ...formats.glb import ClassMesh, Part, linear, material, write_primitive
from ...formats.images import write_rgb
from ..run.target import Target
from ..types import Array
from .light import simplified
from .scene import ExportScene

USD, COLLISION = "mesh.usdz", "collision.glb"
_TEXTURE = "texture.jpg"
MAX_FACES = 20_000
"""Triangles that physics engines on the web and on phones take."""


def write_collision(scene: ExportScene, target: Target) -> None:
    """Write collision.glb: no colours, y up. Raises InputError where the run has no mesh, or an empty one."""
    mesh, world = scene.mesh(), scene.world
    light = simplified(mesh, MAX_FACES)
    points, faces = light.vertices.astype(np.float64), light.faces
    if world.axes == "up" and world.has_floor:
        points, faces = with_floor(points, faces)
    parts = [Part.of("POSITION", points @ world.gltf_from_exported.T), Part.of("", faces.astype(np.uint32).ravel())]
    extras = {"materials": [material(unlit=False)]}
    write_primitive(target.path(COLLISION), parts, {"mode": 4, "material": 0}, (), {"name": "collision"}, extras)


def with_floor(points: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The mesh (V, 3), (F, 3), z up, with a floor at z = 0 under everything; without where it is a line from above."""
    try:
        rim = points[ConvexHull(points[:, :2]).vertices, :2]  # counterclockwise
    except QhullError:
        return points, faces
    n, start = len(rim), len(points)
    fan = start + np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    floor = np.column_stack([rim, np.zeros(n)])
    return np.concatenate([points, floor]), np.concatenate([faces, fan]).astype(np.int32)


def write_usd(scene: ExportScene, target: Target) -> None:
    """Write mesh.usdz: y up, the mesh of mesh.glb with its normals, texture or colours, and the class of each face.

    Raises InputError where usd-core is not installed, or the run has no mesh, or an empty one.
    """
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise InputError(f"USD needs the package usd-core, which is not installed: {install_extra('usd')}") from error
    if (mesh := scene.light_mesh()) is None:
        raise InputError(f"{scene.outcome.run.root}: the mesh is empty, so there is nothing to write: film it again")
    write_usdz(
        target.path(USD), mesh, scene.outcome.classes.names, scene.world.gltf_from_exported, scene.metres_per_unit
    )


def write_usdz(path: Path, mesh: ClassMesh, names: tuple[str, ...], turn: Array, metres_per_unit: float) -> None:
    """Write a package with one binary layer in it, and the texture where the mesh has one; `turn` (3, 3) makes y up.
    Raises DiskFullError where there is no room for it."""
    from pxr import Usd, UsdGeom, UsdUtils

    require_room(path, 2 * 24 * len(mesh.vertices))  # a layer, and the package with a copy of it
    with atomic_path(path) as temporary, temporary_folder(path.with_suffix("")) as scratch:
        stage = Usd.Stage.CreateNew(str(layer := scratch / "mesh.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, metres_per_unit)
        root = UsdGeom.Xform.Define(stage, "/Scene")
        stage.SetDefaultPrim(root.GetPrim())
        shape = UsdGeom.Mesh.Define(stage, "/Scene/Mesh")
        _fill(shape, mesh, names, turn)
        if mesh.texture.size:
            write_rgb(scratch / _TEXTURE, mesh.texture)
            _paint(stage, shape, _add_texture(stage, shape, mesh.corner_uv))
        else:
            _paint(stage, shape, _add_colors(stage, shape, mesh.colors[mesh.corner_vertex]))
        stage.Save()
        package = scratch / USD
        UsdUtils.CreateNewUsdzPackage(str(layer), str(package))
        package.replace(temporary)


def _fill(shape: Any, mesh: ClassMesh, names: tuple[str, ...], turn: Array) -> None:
    """Triangles with normals, and the number of each face's class as the primvar `label`."""
    from pxr import Sdf, UsdGeom, Vt

    points, normals = ((a[mesh.corner_vertex] @ turn.T).astype(np.float32) for a in (mesh.vertices, mesh.normals))
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("label", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
    primvar.Set(Vt.IntArray.FromNumpy(mesh.labels.astype(np.int32)))
    shape.GetPrim().SetCustomDataByKey("classes", Vt.StringArray(list(names)))


def _add_colors(stage: Any, shape: Any, colors: NDArray[np.uint8]) -> Any:
    """The output of a shader with the colour of each vertex: some viewers ignore these without a material."""
    from pxr import Sdf, UsdGeom, Vt

    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear(colors / 255)))
    reader = _shader(stage, "Reader", "UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    return reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)


def _add_texture(stage: Any, shape: Any, uv: NDArray[np.float32]) -> Any:
    """The output of a shader with the texture, whose v counts from below in USD."""
    from pxr import Sdf, UsdGeom, Vt

    types = Sdf.ValueTypeNames
    st = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", types.TexCoord2fArray, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv * [1, -1] + [0, 1], np.float32)))
    reader = _shader(stage, "Reader", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    texture = _shader(stage, "Texture", "UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(f"./{_TEXTURE}")
    texture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    texture.CreateInput("wrapS", types.Token).Set("clamp")
    texture.CreateInput("wrapT", types.Token).Set("clamp")
    texture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    return texture.CreateOutput("rgb", types.Float3)


def _shader(stage: Any, name: str, kind: str) -> Any:
    from pxr import UsdShade

    shader = UsdShade.Shader.Define(stage, f"/Scene/Colours/{name}")
    shader.CreateIdAttr(kind)
    return shader


def _paint(stage: Any, shape: Any, color: Any) -> None:
    """A material with the colour that a shader puts out."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/Scene/Colours")
    surface = _shader(stage, "Surface", "UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
