"""The kinds of files that an export consists of: one row each, from which the help of `export --only` and README.txt
are made, and with which the table in docs/files.md is compared.

To add a kind: a row here, and beside this file the function that it names. Nothing here computes.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

README = "README.txt"
IMAGES = "images"
"""The folder of a data set's images by the name that trainers expect."""
WEB_PAGE = "map.html"
PIECES = "piece_"
"""Begins the folders of disconnected components."""


@dataclass(frozen=True)
class ExportedFile:
    """Files that belong together: what they are called, what they are, the programs that open them, and the first parts
    of their paths where these differ from the name."""

    name: str
    about: str
    opens: str = ""
    paths: tuple[str, ...] = ()

    @property
    def tops(self) -> tuple[str, ...]:
        """The first parts of their paths."""
        return self.paths or (self.name.partition("/")[0],)


@dataclass(frozen=True)
class Export:
    """A kind of export.

    kind: its name for `export --only`, with other names that people look for; about: what it is, in a line; files: what
    it consists of; write: "module.function" beside this file, called with (scene, target); needs: what a run must have
    for it; settings: the keys of [export] that matter for it alone; when: whether the stage writes it.
    """

    kind: str
    about: str
    files: tuple[ExportedFile, ...]
    write: str
    needs: Literal["map", "mesh"] = "map"
    settings: tuple[str, ...] = ()
    when: Literal["always", "in submaps", "asked for"] = "asked for"
    also: tuple[str, ...] = ()

    @property
    def holds_things(self) -> bool:
        """Whether some of the things can be left out of it."""
        return self.kind not in ("colmap", "depth", "tum")

    def writer(self) -> Any:
        """Import the function that writes it."""
        module, _, function = self.write.partition(".")
        return getattr(import_module(f".{module}", __package__), function)


EXPORTS = (
    Export(
        "html", "one web page that shows the map, to send to somebody",
        (
            ExportedFile(
                WEB_PAGE,
                "the map in one page, easy to share: 20 MB at most, no server or network needed; "
                "colours and classes (paler where uncertain), orbit and walk, the camera's path, a measuring tape",
                "any browser with WebGL 2, on a computer or a phone",
            ),
        ),
        "web_page.write_web_page", when="always", also=("web", "page", "map"),
    ),
    Export(
        "colmap", "undistorted images and their poses as a COLMAP model and for nerfstudio",
        (
            ExportedFile(
                "images/, sparse/0/",
                "the undistorted posed frames, as large as the source's up to export.image_side, and their camera (a "
                "pinhole), poses and points to start from (binary, text, points3D.ply)",
                "COLMAP, pycolmap, gsplat (simple_trainer.py default --data_dir THIS_FOLDER --data_factor 1), the "
                "original trainer (train.py -s THIS_FOLDER)",
                (IMAGES, "sparse"),
            ),
            ExportedFile(
                "masks/",
                "parts left out for people, as standing still, or by --masks, where there are any: NAME.png for the "
                "frame NAME, black is left out; transforms.json names them",
                "COLMAP (feature_extractor --ImageReader.mask_path masks), nerfstudio",
            ),
            ExportedFile(
                "transforms.json",
                "the same data set; it names sparse/0/points3D.ply to start from",
                "nerfstudio (ns-train splatfacto --data THIS_FOLDER), OpenSplat (opensplat THIS_FOLDER)",
            ),
        ),
        "colmap.write_colmap", settings=("image_side",), when="always", also=("nerfstudio", "transforms"),
    ),
    Export(
        "depth", "the same data set with a depth and a normal map for each image",
        (
            ExportedFile(
                "depth/",
                "with all files of the data set beside it: NAME.png for the image NAME, the depth of the map along the "
                "optical axis in thousandths of the unit (millimetres, where it is the metre), 16 bits, 0 is unknown; "
                "transforms.json names them (depth_file_path)",
                "nerfstudio (ns-train depth-nerfacto --data THIS_FOLDER)",
                ("depth", IMAGES, "sparse", "masks", "transforms.json"),
            ),
            ExportedFile(
                "normals/",
                "beside depth/: NAME.png for the image NAME, the unit normals n of the map that face the camera, in "
                "its axes (x right, y down, z forward), 127.5 (n + 1) in red, green and blue; black is unknown",
                "trainers that take normals",
            ),
        ),
        "depth.write_depth", settings=("image_side",),
    ),
    Export(
        "tum", "poses of all images of the source with their times",
        (
            ExportedFile(
                "trajectory.txt",
                "a pose for every source image, including those not in images/ unless --pose-frames "
                "leaves them out; TUM format: timestamp tx ty tz qx qy qz qw (camera in the world)",
                "evo",
            ),
        ),
        "colmap.write_trajectory", when="always", also=("poses", "trajectory"),
    ),
    Export(
        "ply", "the map as Gaussians with classes",
        (
            ExportedFile(
                "point_cloud.ply",
                "the map: Gaussians in the layout of the original 3D Gaussian splatting; after it class_id, and "
                "class_prob_N, the probability of class number N, for each class that occurs; thing, the number of its "
                "thing in things.json, 0 for none",
                "SuperSplat and other splat viewers",
            ),
            ExportedFile(
                "point_cloud_semantic.ply", "the same, coloured by class, with class_id and no probabilities",
                "splat viewers",
            ),
        ),
        "splats.write_splat_ply", when="always", also=("gaussians", "splat", "point_cloud", "pointcloud"),
    ),
    Export(
        "spz", "the map's colours, a tenth of the PLY's size",
        (ExportedFile("point_cloud.spz", "the colours of the map, small (SPZ 4)", "splat viewers on the web"),),
        "splats.write_small",
    ),
    Export(
        "sog", "the map's colours, a fifteenth of the PLY's size",
        (ExportedFile("point_cloud.sog", "the colours of the map, smaller still", "PlayCanvas, SuperSplat"),),
        "splats.write_smallest",
    ),
    Export(
        "glb", "the map as Gaussians in glTF",
        (
            ExportedFile(
                "point_cloud.glb",
                "the map in glTF (KHR_gaussian_splatting), classes as attribute _LABEL; programs that do not know the "
                "extension show coloured points",
                "Cesium, Babylon.js, PlayCanvas",
            ),
        ),
        "splats.write_gltf", also=("gltf",),
    ),
    Export(
        "tiles", "the map's colours as 3D Tiles",
        (
            ExportedFile(
                "tiles/tileset.json",
                "3D Tiles 1.1 of the map's colours, coarse from afar and fine nearby; in metres, on the globe where "
                "GPS is known. Of a map that was made in parts it is always there",
                "CesiumJS 1.130 or newer",
            ),
        ),
        "splats.write_tiles", when="in submaps", also=("3dtiles",),
    ),
    Export(
        "mesh", "the surface with classes, and with a texture",
        (
            ExportedFile(
                "mesh.ply",
                "the surface with all its vertices, and at each a colour, its class (property label) and its thing "
                "(property thing, 0 is none)",
                "MeshLab, trimesh",
            ),
            ExportedFile(
                "mesh.glb",
                "a lighter surface, at most export.triangles, with normals and nodes named after things, and classes "
                "of the rest (attribute _LABEL: its number); a texture made from the keyframes, exposure removed, or "
                "without export.texture colours of the vertices; unlit",
                "Blender, game engines, the web",
            ),
            ExportedFile(
                "things.json",
                "the things that were found: name, class, upright box with its size and how certain that is, numbers "
                "of faces, Gaussians and views; property thing of mesh.ply and point_cloud.ply has their numbers",
            ),
        ),
        "mesh.write_mesh", settings=("voxel", "planes", "texture", "triangles"), when="always", also=("texture",),
    ),
    Export(
        "collision", "a light mesh to walk in",
        (
            ExportedFile(
                "collision.glb",
                "the surface to walk in, without colours: at most 20,000 triangles, and a floor without holes where "
                "one was found",
                "game engines, PlayCanvas",
            ),
        ),
        "meshes.write_collision", needs="mesh",
    ),
    Export(
        "usd", "the mesh as USDZ (needs the package usd-core)",
        (
            ExportedFile(
                "mesh.usdz",
                "mesh.glb as USD: its texture or colours, the class of each face as primvar label, y up, and the "
                "metres of a unit in its metersPerUnit",
                "Quick Look on Apple devices, Blender, Houdini, Omniverse",
            ),
        ),
        "meshes.write_usd", needs="mesh", also=("usdz",),
    ),
    Export(
        "floorplan", "the walls from above with their lengths",
        (
            ExportedFile(
                "floorplan.svg",
                "the walls seen from above, with their lengths, and the camera's path; ≥ where an end of a wall was "
                "not seen, ≈ where a corner is flat and so uncertain. Needs to know which way is up",
                "browsers, Inkscape",
            ),
        ),
        "floor_plan.write_floor_plan", needs="mesh", also=("svg", "plan"),
    ),
)  # fmt: skip
KIND_OF = {name: export.kind for export in EXPORTS for name in (export.kind, *export.also)}
"""What people call a kind of file → its name."""

WORLD_NOTE = ExportedFile(
    "world.json", "what the axes are, how up was found, and the transform from the run's own frame"
)
NOTES = (
    ExportedFile(
        "classes.json",
        'number, name and colour of each class; 255 is "unknown". A name has the same colour in every run unless the '
        "data set gives its own; unnamed objects are grey",
    ),
    ExportedFile("scale.json", "how many metres a unit of the run is, how certain, and its sources"),
    WORLD_NOTE,
    ExportedFile(
        "piece_2/ and so on",
        "frames that are not connected to the rest: the same files for them, in a coordinate system of their own; RUN/"
        "piece_2 is a run like any other for view, report, render and evaluate",
        paths=(PIECES,),
    ),
)
"""What a whole export has beside the kinds; of these each kind alone comes with `WORLD_NOTE`."""


def export_of(kind: str) -> Export:
    """Return the row of a kind, by any of its names. Raises ValueError for another name."""
    row = next((export for export in EXPORTS if export.kind == KIND_OF.get(kind.lower())), None)
    if row is None:
        raise ValueError(f"{kind!r} is no kind of export: {', '.join(export.kind for export in EXPORTS)}")
    return row


def names_of(exports: Iterable[Export], notes: Iterable[ExportedFile]) -> set[str]:
    """Return the first parts of the paths of these files, README.txt included."""
    files = [*(file for export in exports for file in export.files), *notes]
    return {README, *(top for file in files for top in file.tops if top != PIECES)}


def kinds_help() -> str:
    """Return a line for each kind, and the settings that matter for it alone."""
    width = max(len(export.kind) for export in EXPORTS)
    lines = []
    for export in EXPORTS:
        settings = f" ({', '.join(export.settings)})" if export.settings else ""
        lines.append(f"{export.kind.ljust(width)}  {export.about}{settings}")
    return "\n".join(lines)
