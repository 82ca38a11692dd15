"""Readers of the data sets that the field uses, and which of them a folder or file is.

A folder or file goes in; a `Dataset` comes out: names, times and images, with whatever camera, poses, depth and labels
the set has, in one set of conventions. Begin with `open_sequence` and with `sequence.Dataset`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

from ..errors import InputError
from ..image_folder import unused_pictures
from ..images import IMAGE_SUFFIXES, UNREAD_SUFFIXES
from ..reading import reaching
from . import benchmarks, colmap, folder, nerfstudio, scannet
from .sequence import VOID_LABEL, Camera, Dataset, LabelClass

__all__ = ["FORMATS", "VOID_LABEL", "Camera", "Dataset", "LabelClass", "open_sequence"]


@dataclass(frozen=True)
class _Reader:
    recognises: Callable[[Path], bool]
    open: Callable[[Path], Dataset]


# In the order of trying: a plain folder of images comes last, because most data sets are also that.
_READERS = {
    "7scenes": _Reader(lambda path: any(path.glob("frame-*.color.*")), benchmarks.open_seven_scenes),
    "replica": _Reader(lambda path: benchmarks.replica_folder(path) is not None, benchmarks.open_replica),
    "tum": _Reader(lambda path: (path / "rgb.txt").is_file() and (path / "rgb").is_dir(), benchmarks.open_tum_rgbd),
    "euroc": _Reader(
        lambda path: any((root / "cam0" / "data.csv").is_file() for root in (path / "mav0", path)),
        benchmarks.open_euroc,
    ),
    "scannet": _Reader(
        lambda path: (path / "color").is_dir() and any((path / "pose").glob("*.txt")), scannet.open_scannet
    ),
    "sens": _Reader(lambda path: path.is_file() and path.suffix.lower() == ".sens", scannet.open_sens),
    "nerfstudio": _Reader(lambda path: nerfstudio.table_of(path) is not None, nerfstudio.open_nerfstudio),
    "colmap": _Reader(lambda path: path.is_dir() and bool(colmap.find_models(path)), colmap.open_colmap),
    "folder": _Reader(lambda path: folder.image_folder(path) is not None, folder.open_folder),
}

_IMAGE_FOLDERS = frozenset({"rgb", "images", "color", "results"})
# An earlier reconstruction beside images is no part of their recording.
_NOT_FROM_INSIDE = frozenset({"folder", "colmap"})

_TRACES = frozenset({
    *_IMAGE_FOLDERS, "frames", "mav0", "cam0", "pose", "sparse", "transforms.json", "rgb.txt",
    *(f"{name}{suffix}" for name in ("cameras", "points3D") for suffix in (".bin", ".txt")),
})  # fmt: skip
"""Names that a data set has in its folder, complete or not."""
FORMATS = ("auto", *_READERS)
"""What `open_sequence` accepts as a format."""


def _recognised(path: Path) -> list[str]:
    """The formats that a path could be of, the likeliest first."""
    with reaching(path):
        return [name for name, reader in _READERS.items() if path.exists() and reader.recognises(path)]


def recognise_source(path: Path) -> str | None:
    """Return the format of a recording to reconstruct; None for a video, and for a folder that holds images directly.

    Other than `open_sequence`, it takes what a user points at literally: a folder of images is no data set because of
    what is above it, nor because somebody has left a COLMAP model in it; but a few pictures beside images/ are no
    source.
    """
    names, holds_images = _recognised(path), path.is_dir() and folder.image_folder(path) == path
    return next((name for name in names if not (holds_images and name in _NOT_FROM_INSIDE)), None)


def is_recording_folder(path: Path) -> bool:
    """Return whether a folder holds images, or a data set, or what is left of one: opening it may still fail, with the
    reason.

    Raises InputError where the folder may not be read.
    """
    with reaching(path):
        names = [p.name for p in path.iterdir() if not p.name.startswith(".")]
    is_image = any(Path(name).suffix.lower() in IMAGE_SUFFIXES | UNREAD_SUFFIXES for name in names)
    return is_image or not _TRACES.isdisjoint(names) or recognise_source(path) is not None


def open_sequence(path: Path, format: str = "auto") -> Dataset:
    """Open a recorded sequence of a known data set, or a folder of images with its companion files; by the images
    folder inside a data set, that data set.

    Images are not read yet, text files are. Raises InputError for an unknown format, a missing path, a path that is
    no such data set, or parts that contradict each other.
    """
    path = Path(path)
    if format not in FORMATS:
        nearest = get_close_matches(format, FORMATS, 1)
        hint = f", did you mean {nearest[0]!r}?" if nearest else "."
        raise InputError(f"no data set format {format!r}{hint} Known: {', '.join(FORMATS)}")
    with reaching(path):
        if not path.exists():
            raise InputError(f"no such file or folder: {path}: check the spelling, and that the disk is mounted")
        names = _recognised(path) if format == "auto" else [format]
        if names == ["folder"] and path.name in _IMAGE_FOLDERS and format == "auto":
            above = [name for name in _recognised(path.resolve().parent) if name not in _NOT_FROM_INSIDE]
            names, path = (above, path.resolve().parent) if above else (names, path)
        if not names:
            raise InputError(
                f"{path} has the layout of no known data set ({', '.join(_READERS)}): give the folder of one sequence, "
                "or name the format"
            )
        sequence = _READERS[names[0]].open(path)
        others = {*sequence.depth_paths, *sequence.label_paths, *sequence.mask_paths}
        return replace(sequence, notes=(*sequence.notes, *unused_pictures(sequence.image_paths, others)))
