"""Every setting, its default and its meaning, once; `run/settings.py` reads and writes them."""

from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import Any

STAGES = ("frames", "proxy", "tracking", "mapping", "global_ba", "export")
GPS_OFF, GPS_AUTO = "off", "auto"
EXTENSION = "extension_"
"""Begins the folder of a run in which what it was before it was extended is kept."""
SOURCE_LIST = "source.videos"
"""The videos of a run of several, in its folder."""


@dataclass(frozen=True)
class Option:
    """An option of the command line that gives a setting: its name without dashes, and what stands for its value, where
    that is not its choices."""

    name: str
    metavar: str = ""


def setting(
    default: Any,
    help: str,
    choices: tuple[str, ...] = (),
    within: tuple[float, float] | None = None,
    or_zero: bool = False,
    paths: tuple[str, ...] = (),
    option: Option | None = None,
    draft: Any = None,
    best: Any = None,
) -> Any:
    """A dataclass field that carries all that is known of it.

    Args:
        default: its value where nothing is given.
        help: its meaning, for `msgs-slam config`.
        choices: the texts that it may be.
        within: the smallest and the largest number that it may be.
        or_zero: whether it may be 0 beside these.
        paths: what stands before the path of a file or folder that it may name, "" where it is the path alone.
        option: of the command line.
        draft: its value with `run.quality` at draft, where that is another one; `best` likewise.
    """
    return field(
        default=default,
        metadata={
            "help": help, "choices": choices, "within": within, "or_zero": or_zero, "paths": paths, "option": option,
            "draft": draft, "best": best,
        },
    )  # fmt: skip


@dataclass(frozen=True)
class RunConfig:
    """Settings of the whole run."""

    quality: str = setting(
        "normal", "draft: a third of the time or less, fewer keyframes and smaller images; best: larger images, more "
        "passes, the largest networks that are installed. Explicit options and settings take precedence",
        ("draft", "normal", "best"), option=Option("quality"),
    )  # fmt: skip
    seed: int = setting(0, "seed of every random choice", within=(0, 2**31 - 1))
    threads: int = setting(0, "CPU threads, 0 = all cores; the same count gives the same bytes", within=(0, 1024))
    format: str = setting(
        "auto", "kind of source: images (a video or plain images, ignoring files next to them) or a data set, "
        "which supplies times and camera and, with proxy.depth=files proxy.semantics=files, depth and "
        "labels; auto detects it",
        ("auto", "images", "7scenes", "replica", "tum", "euroc", "scannet", "sens", "nerfstudio", "colmap", "folder"),
        option=Option("format"),
    )  # fmt: skip
    method: str = setting(
        "default", "paper: poses from the map alone, map and loops by the equations of the paper MSGS-SLAM as printed, "
        "from each frame's own depth and semantics; slower and less exact", ("default", "paper"),
        option=Option("method"),
    )  # fmt: skip
    kappa: float = setting(
        0.0, "κ of the paper's (7), with run.method=paper: how much less an occluder hides that disagrees with the "
        "proxy depth, the scene's depth being 1; slow. 0 = as usual", within=(0, 10_000),
    )  # fmt: skip
    device: str = setting(
        "auto", "where dense work runs; auto takes a GPU if there is one", ("auto", "cpu", "cuda"),
        option=Option("device"),
    )  # fmt: skip
    memory_mb: int = setting(
        0, "memory to plan with, in MB; if given, long recordings are processed in parts that fit. 0 = "
        "half of the machine's",
        within=(100, 10_000_000), or_zero=True,
    )  # fmt: skip


@dataclass(frozen=True)
class FramesConfig:
    """Picking frames and finding the camera's intrinsics."""

    rate: float = setting(
        10.0,
        "frames per second to keep of a video; the sharpest of each window, more where they hardly overlap. 0 = all",
        within=(0.1, 1000),
        or_zero=True,
    )
    max_side: int = setting(
        960, "longer images are reduced to this many pixels on the long side", within=(64, 8192), draft=640, best=1280
    )
    intrinsics: str = setting(
        "", "the camera, in pixels of the source (first pixel's centre at 0.5, 0.5), or a file; empty = the data "
        "set's, by EXIF, else self-calibrated", paths=("",),
        option=Option("intrinsics", "FX,FY,CX,CY[,K1,K2,P1,P2]|FILE"),
    )  # fmt: skip
    camera: str = setting(
        "auto", "equirectangular for whole 360° panoramas, each of which becomes six images, fisheye for a lens given "
        "by frames.intrinsics (k1 to k4 of OpenCV's fisheye); auto: from the source's metadata",
        ("auto", "perspective", "equirectangular", "fisheye"), option=Option("camera"),
    )  # fmt: skip
    poses: str = setting(
        "", "camera poses from another program to start from: a COLMAP model, a transforms.json, ARKit's JSON, a TUM "
        "trajectory or lines of 4x4 matrices; they may be inexact or incomplete", paths=("",),
        option=Option("poses", "FILE|FOLDER"),
    )  # fmt: skip
    rolling_shutter: str = setting(
        "auto",
        "rolling shutter: seconds from a frame's first row to its last; auto estimates them where "
        "they explain something; off",
    )
    parallax: float = setting(
        0.025,
        "a new keyframe when points have moved by this fraction of the longer side, or of 4/3 of the other if less",
        within=(0.001, 0.5),
        draft=0.06,
    )
    features: str = setting("sift", "sift; aliked, with LightGlue, needs networks of 49 MB", ("sift", "aliked"))
    max_features: int = setting(
        3000, "features of a keyframe, at most about this many", within=(50, 100_000), draft=2000
    )
    overlap: int = setting(
        8, "each keyframe is matched with this many after it (and a few further ones)", within=(1, 1000), draft=6
    )
    masks: str = setting(
        "", "folder of masks for some or all images: NAME.png for an image NAME, or the frame's number for a video; "
        "black pixels are ignored", paths=("",), option=Option("masks", "FOLDER"),
    )  # fmt: skip
    people: str = setting(
        "auto", "auto masks people who move, if a person network is installed; mask: everybody; keep: nobody",
        ("auto", "mask", "keep"),
    )  # fmt: skip
    still: str = setting(
        "auto", "auto masks what stands still in the image while the rest moves (a car bonnet, an overlay, a "
        "border); keep: it counts as scene", ("auto", "keep"),
    )  # fmt: skip
    mapper: str = setting("auto", "structure from motion at once or view by view", ("auto", "global", "incremental"))


@dataclass(frozen=True)
class ProxyConfig:
    """Proxy depth and semantics of every keyframe."""

    depth: str = setting(
        "auto", "proxy depth: auto, best (the largest network that is installed), multiview (needs no weights), "
        "files[:FOLDER], onnx:CARD, or a network by its name in `models list`",
        paths=("files:", "onnx:"), option=Option("depth", "PROVIDER"), best="best",
    )  # fmt: skip
    semantics: str = setting(
        "auto", "semantics: auto, segments (needs no weights), files[:FOLDER], onnx:CARD, or a network by its name",
        paths=("files:", "onnx:"), option=Option("semantics", "PROVIDER"),
    )  # fmt: skip
    classes: str = setting(
        "", 'classes to look for, e.g. "radiator, bookshelf, lamp"; needs a semantics network whose card '
        'names a text encoder',
        option=Option("classes", "WORDS"),
    )  # fmt: skip
    max_side: int = setting(
        640, "the maps are at most this many pixels on the long side", within=(64, 8192), draft=320, best=960
    )
    depth_scale: float = setting(0.001, "metres per unit of integer depth files", within=(1e-9, 1000))
    scale_ref: str = setting(
        "",
        "gives metres without metric depth: IMAGE:X1,Y1,X2,Y2=METRES, two pixels of one image of the source "
        "(an image's name or a video frame's number; the first pixel's centre is 0.5,0.5), height=METRES of the "
        "camera over the floor, or poses: those of frames.poses are in metres", option=Option("scale-ref", "REF"),
    )  # fmt: skip
    stereo_side: int = setting(
        640, "multiview matches images of this many pixels on the long side", within=(32, 4096), draft=320, best=960
    )
    moving: str = setting("auto", "auto masks what moved, judged by depth and poses; keep maps it", ("auto", "keep"))


@dataclass(frozen=True)
class MappingConfig:
    """Settings of the Gaussian map."""

    max_side: int = setting(
        640,
        "longer keyframes are mapped at this many pixels on the long side; 0 = as they are",
        within=(16, 8192),
        or_zero=True,
        draft=320,
        best=960,
    )
    hold_out: int = setting(
        0,
        "every n-th frame is never used for the map, only to measure it (evaluate); 0 = use all",
        within=(2, 1_000_000),
        or_zero=True,
        option=Option("hold-out", "N"),
    )  # fmt: skip
    passes: float = setting(
        9.0, "how often each keyframe is visited once all are seeded", within=(0, 1000), draft=6.0, best=14.0
    )
    min_iterations: int = setting(400, "at least this many visits in total", within=(0, 10_000_000), draft=150)
    max_gaussians: int = setting(1000000, "most Gaussians of the map, or of each submap", within=(100, 50_000_000))
    submap: int = setting(
        250, "more keyframes than this, or than run.memory_mb has room for, are mapped in overlapping "
        "parts of this many. 0 = never",
        within=(4, 1_000_000), or_zero=True,
    )  # fmt: skip
    depth_weight: float = setting(4.8, "λ_D of eq. (18); 0 = no depth loss", within=(0, 1000))
    refine_poses: bool = setting(True, "refine keyframe poses together with the map")


@dataclass(frozen=True)
class GlobalBaConfig:
    """Poses of the images between the picked frames."""

    posed: str = setting(
        "every", "every: all images of a video get a pose, those between the picked frames (frames.rate a second) too; "
        "picked: those frames alone", ("every", "picked"), option=Option("pose-frames"), draft="picked",
    )  # fmt: skip


@dataclass(frozen=True)
class ExportConfig:
    """Files for other programs."""

    axes: str = setting(
        "up",
        "up: z up where gravity is found, the floor at 0 where one is found; first: those of the first posed camera",
        ("up", "first"),
    )
    gps: str = setting(
        "auto",
        "georeferences the export (x east, y north, metres): auto by GPS in the images' EXIF, off, or a track, GPX or "
        "CSV with the columns time, lat, lon, alt (a video counts from its start)",
        paths=("",),
        option=Option("gps", "FILE"),
    )  # fmt: skip
    voxel: float = setting(
        0.008, "voxel of the mesh, in units of the scene's median depth", within=(0.0005, 1), draft=0.014
    )
    planes: str = setting(
        "complete",
        "floors, walls and fronts of the mesh: straight moves what no match confirms onto the planes around it; "
        "complete continues these, too, behind what hides them, marked in mesh.glb; off leaves all as it is",
        ("complete", "straight", "off"),
    )
    image_side: int = setting(
        1600,
        "pixels on the long side of images/, read again from the source: at most its own, at least the frames'",
        within=(16, 16384),
    )
    scale: str = setting(
        "auto",
        "where metres are unknown, auto estimates how long a unit is, by a network and usual sizes; free does not; "
        "neither rescales coordinates",
        ("auto", "free"),
        option=Option("scale"),
    )  # fmt: skip
    texture: bool = setting(True, "texture mesh.glb from the keyframes; false: colours of its vertices", draft=False)
    triangles: int = setting(
        500_000, "triangles of mesh.glb at most", within=(100, 10_000_000), draft=150_000, best=1_500_000
    )


@dataclass(frozen=True)
class Config:
    """The complete settings of a run; a section for each stage that has some."""

    run: RunConfig = field(default_factory=RunConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    proxy: ProxyConfig = field(default_factory=ProxyConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    global_ba: GlobalBaConfig = field(default_factory=GlobalBaConfig)
    export: ExportConfig = field(default_factory=ExportConfig)


def allowed_values(known: Field[Any]) -> str:
    """Describe the allowed values of a setting; "" where every value of its type is allowed."""
    return " | ".join(known.metadata["choices"]) or (range_text(known) if known.metadata["within"] else "")


def value_of(known: Field[Any], quality: str) -> Any:
    """Return what a setting is with `run.quality` at `quality`."""
    value = known.metadata.get(quality)
    return known.default if value is None else value


def meaning_of(known: Field[Any]) -> str:
    """Return a setting's help, with its values at draft and best where these are others."""
    of = {quality: known.metadata[quality] for quality in ("draft", "best")}
    others = ", ".join(f"{quality} {value}" for quality, value in of.items() if value is not None)
    return known.metadata["help"] + (f" [{others}]" if others else "")


def range_text(known: Field[Any]) -> str:
    """Return the numbers that a setting may be, in words."""
    low, high = known.metadata["within"]
    return f"{low:.10g} to {high:.10g}" + (", or 0" if known.metadata["or_zero"] else "")


def config_to_dict(config: Any) -> dict[str, Any]:
    """Nested plain values, for fingerprints and JSON."""
    return {
        f.name: config_to_dict(value) if is_dataclass(value := getattr(config, f.name)) else value
        for f in fields(config)
    }


def settings_with_options() -> dict[str, Field[Any]]:
    """Find the settings that an option of the command line gives, by `section.key`."""
    sections = {f.name: fields(getattr(Config(), f.name)) for f in fields(Config)}
    return {f"{name}.{f.name}": f for name, known in sections.items() for f in known if f.metadata["option"]}
