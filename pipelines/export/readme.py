"""The README of an export: what each file is for."""

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..networks.registry import ModelStore
from ..scene.world import World
from ..types import Metres

WIDTH = 100
"""Characters a line, so that it fits a terminal, an editor and the report."""
_COLUMN = 27


@dataclass(frozen=True)
class Facts:
    """Facts on which the text depends. textured: whether mesh.glb has a texture; every_image: whether images of the
    source between the frames have a pose."""

    textured: bool = True
    every_image: bool = True


def _every_image(facts: Facts) -> bool:
    return facts.every_image


def _picked_images(facts: Facts) -> bool:
    return not facts.every_image


def _textured(facts: Facts) -> bool:
    return facts.textured


def _plain(facts: Facts) -> bool:
    return not facts.textured


@dataclass(frozen=True)
class Entry:
    """A line of the README: a name for the files, what they are, which of the `EXPORTS` writes them ("" = the notes of
    a whole export, "*" = each), the first parts of their paths, where these differ from the name, and of which exports
    the text is true."""

    name: str
    text: str
    kind: str = ""
    files: tuple[str, ...] = ()
    when: Callable[[Facts], bool] = lambda facts: True

    @property
    def entries(self) -> tuple[str, ...]:
        """The first parts of the paths of its files."""
        return self.files or (self.name.rstrip("/"),)

    @property
    def lines(self) -> str:
        """Its name, and the text beside it; below it where the name is long."""
        first = "" if len(self.name) < _COLUMN - 1 else f"{self.name}\n"
        head = " " * _COLUMN if first else self.name.ljust(_COLUMN)
        return first + textwrap.fill(
            self.text, WIDTH, initial_indent=head, subsequent_indent=" " * _COLUMN, break_on_hyphens=False
        )


_PIECES = "piece_"


_TUM = "in TUM format: timestamp tx ty tz qx qy qz qw (camera in the world); evo."
_ENTRIES = (
    Entry(
        "map.html",
        "the map to look at in any browser, without a server or a network, on a computer or a phone.", "html",
    ),
    Entry(
        "images/, sparse/0/",
        "a COLMAP data set: undistorted frames with a known pose, and their camera, poses and points (binary, "
        "text, and points3D.ply). Pinhole, no distortion left. A frame of which only the rotation is known is in "
        "trajectory.txt alone. Opens in COLMAP, pycolmap, gsplat (simple_trainer.py default --data_dir "
        "THIS_FOLDER --data_factor 1), the original trainer (train.py -s THIS_FOLDER).",
        "colmap", ("images", "sparse"),
    ),
    Entry(
        "masks/",
        "parts left out for people, as standing still, or by --masks: NAME.png for the frame NAME, black is left out "
        "(colmap feature_extractor --ImageReader.mask_path masks; transforms.json names them).",
        "colmap",
    ),
    Entry(
        "transforms.json",
        "the same for nerfstudio (ns-train splatfacto --data THIS_FOLDER) and OpenSplat (opensplat THIS_FOLDER); "
        "it names sparse/0/points3D.ply to start from.",
        "colmap",
    ),
    Entry(
        "trajectory.txt", f"a pose for every image of the source, those between the frames of images/ too, {_TUM}",
        "tum", when=_every_image,
    ),
    Entry("trajectory.txt", f"a pose for every frame, {_TUM}", "tum", when=_picked_images),
    Entry(
        "point_cloud.ply",
        "the map: Gaussians in the layout of the original 3D Gaussian splatting; after it class_id, and "
        "class_prob_N, the probability of class number N, for each class that occurs. Splat viewers (SuperSplat "
        "and others).",
        "ply",
    ),
    Entry("point_cloud_semantic.ply", "the same, coloured by class, with class_id and no probabilities.", "ply"),
    Entry("point_cloud.spz", "the colours of the map, small, for viewers on the web.", "spz"),
    Entry("point_cloud.sog", "the colours of the map, smaller still (PlayCanvas, SuperSplat).", "sog"),
    Entry(
        "point_cloud.glb",
        "the map in glTF (KHR_gaussian_splatting), classes as attribute _LABEL; programs that do not know the "
        "extension show coloured points.",
        "glb",
    ),
    Entry(
        "mesh.ply",
        "the surface with all its vertices, a colour and a label (property label) at each. MeshLab, trimesh.",
        "mesh",
    ),
    Entry(
        "mesh.glb",
        "the surface with a tenth of those vertices (labels: attribute _LABEL), and a texture made from the "
        "keyframes, exposure removed; unlit. Blender, game engines, the web.",
        "mesh", when=_textured,
    ),
    Entry(
        "mesh.glb",
        "the same for glTF: a colour and a label (attribute _LABEL) at each vertex; unlit. Blender, game engines, the "
        "web.",
        "mesh", when=_plain,
    ),
    Entry(
        "collision.glb",
        "the surface to walk in, without colours: at most 20,000 triangles, and a floor without holes where one "
        "was found. Game engines, PlayCanvas.",
        "collision",
    ),
    Entry(
        "mesh.usdz",
        "the mesh as USD: the texture of mesh.glb or else colours, the class of each vertex as primvar label, y up, "
        "and the metres of a unit in its metersPerUnit. Quick Look on Apple devices, Blender, Houdini, Omniverse.",
        "usd",
    ),
    Entry(
        "floorplan.svg",
        "the walls seen from above, with their lengths, and the camera's path. Browsers, Inkscape.", "floorplan",
    ),
    Entry("classes.json", 'number, name and colour of each class; 255 is "unknown".'),
    Entry(
        "scale.json", "how many metres a unit of the run is, its relative standard deviation, and its sources."
    ),
    Entry(
        "tiles/",
        "3D Tiles 1.1 of the map's colours, coarse from afar and fine nearby, on the globe where GPS is known; "
        "open tiles/tileset.json (CesiumJS).",
        "tiles",
    ),
    Entry(
        "piece_2/ and so on",
        "frames that are not connected to the rest: the same files for them, in a coordinate system of their own.",
        "", (_PIECES,),
    ),
    Entry("world.json", "what the axes are, how up was found, and the transform from the run's own frame.", "*"),
)  # fmt: skip
_MORE = "More kinds of files: msgs-slam export --help"

_UPRIGHT = """\
Axes: z is up, from the {source}; {height}.
{heading}. So have trajectory.txt and mesh.ply. Trainers and viewers of splats take y for down:
sparse/0, transforms.json and point_cloud*.ply and .sog are turned to x right, y down, z forward, (x, y, z) to
(x, -z, y). In GLB, SPZ and USD files y is up, as these formats define it.
"""

_OWN_HEADING = """\
x and y count from the middle of the camera's path, and y points where the first camera looked"""

_FIRST = """\
Axes: the run's own, about those of the first posed camera: x right, y down, z forward{why}.
"""

_FREE = "The unit of lengths is free: one camera cannot measure metres. Metric depth or --scale-ref makes them metres."


def names_of(kinds: Iterable[str] | None = None, with_notes: bool = True) -> set[str]:
    """Return the names that some of the `EXPORTS`, None = all, have in the folder of an export, with the notes of a
    whole export or without them."""
    wanted = None if kinds is None else {"*", *kinds, *[""] * with_notes}
    entries = [e for e in _ENTRIES if (wanted is None or e.kind in wanted) and e.files != (_PIECES,)]
    return {"README.txt", *(name for entry in entries for name in entry.entries)}


def lengths(metres: Metres | None, metric: bool) -> str:
    """Describe the unit of length in a line or two of plain text."""
    if metres is None:
        return "Lengths are metres." if metric else _FREE
    if metric:
        return f"Lengths are metres: {metres.text}."
    return (
        f"{metres.text[0].upper()}{metres.text[1:]}.\n"
        f"Coordinates are not rescaled: multiply lengths by {metres.per_unit:.3g} to have them in metres."
    )


def readme(
    world: World, metres: Metres | None, metric: bool, files: Iterable[str] = (), facts: Facts | None = None
) -> str:
    """Return the text of README.txt for files in that world, by their relative paths."""
    if world.axes == "up":
        height = "the floor is at z = 0" if world.has_floor else "no floor was found, so z counts from that path too"
        heading = "x is east and y north (GPS, see world.json)" if world.earth else _OWN_HEADING
        axes = _UPRIGHT.format(source=world.source, height=height, heading=heading)
    else:
        axes = _FIRST.format(why=", since the gravity direction is unknown or was not asked for (export.axes)")
    tops = {name.partition("/")[0] for name in files}
    tops |= {_PIECES for top in tops if top.startswith(_PIECES)}
    here = [e for e in _ENTRIES if e.when(facts or Facts()) and (e.kind == "*" or not tops.isdisjoint(e.entries))]
    entries = [e.lines for e in here]
    about = [
        textwrap.fill(line, WIDTH, break_on_hyphens=False) for line in (axes + lengths(metres, metric)).splitlines()
    ]
    return "\n".join(["What is in this folder", "", *entries, "", _MORE, "", *about]) + "\n"


def licences(figures: Iterable[Mapping[str, Any]], metres: Metres | None) -> str:
    """Name the networks that figures of stages and the metres rest on, with their licences; "" without any."""
    said = " ".join(str(value) for of_stage in figures for value in of_stage.values())
    named = set(re.findall(r"(?:onnx|tflite):([\w.-]+)", said))
    named |= set(re.findall(r"network ([\w.-]+)", metres.text if metres else ""))
    lines = [
        f"  {m.name}: {m.licence}{'' if m.commercial else ' (ask before commercial use)'}"
        for m in ModelStore.open().models
        if m.name in named
    ]
    return "\n".join(["\nNetworks that these results were made with, and their licences:", *lines, ""]) if lines else ""
