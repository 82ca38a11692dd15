"""Which data set a folder or file is, and opening it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

from ..errors import InputError
from ..image_folder import unused_pictures
from ..images import IMAGE_SUFFIXES, UNREAD_SUFFIXES
from ..reading import reaching
from . import benchmarks, colmap, folder, nerfstudio, scannet
from .sequence import Dataset


@dataclass(frozen=True)
class _Reader:
    recognises: Callable[[Path], bool]
    open: Callable[[Path], Dataset]


# In the order of trying: a plain folder of images comes last, because most data sets are also that.
_READERS = {
    "7scenes": _Reader(lambda path: any(path.glob("frame-*.color.*")), benchmarks.open_seven_scenes),
    "replica": _Reader(benchmarks.recognises_replica, benchmarks.open_replica),
    "tum": _Reader(lambda path: (path / "rgb.txt").is_file() and (path / "rgb").is_dir(), benchmarks.open_tum_rgbd),
    "euroc": _Reader(
        lambda path: any((root / "cam0" / "data.csv").is_file() for root in (path / "mav0", path)),
        benchmarks.open_euroc,
    ),
    "scannet": _Reader(scannet.is_scannet, scannet.open_scannet),
    "sens": _Reader(lambda path: path.is_file() and path.suffix.lower() == ".sens", scannet.open_sens),
    "nerfstudio": _Reader(nerfstudio.is_nerfstudio, nerfstudio.open_nerfstudio),
    "colmap": _Reader(colmap.is_colmap_model, colmap.open_colmap),
    "folder": _Reader(folder.is_plain_folder, folder.open_folder),
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


def recognise(path: Path) -> str | None:
    """Return the format of a data set by its files, "folder" for plain images, None for anything else."""
    with reaching(path):
        found = _recognise(Path(path))
    return found[0] if found else None


def recognise_source(path: Path) -> str | None:
    """Return the format of a recording to reconstruct; None for a video, and for a folder that holds images directly.

    Other than `recognise`, it takes what a user points at literally: a folder of images is no data set because of what
    is above it, nor because somebody has left a COLMAP model in it; but a few pictures beside images/ are no source.
    """
    path = Path(path)
    with reaching(path):
        names = [name for name, reader in _READERS.items() if path.exists() and reader.recognises(path)]
        holds_images = path.is_dir() and folder.image_folder(path) == path
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


def _recognise(path: Path) -> tuple[str, Path] | None:
    """The format and the place to open it at: of the images folder inside a data set, that data set."""
    names = [name for name, reader in _READERS.items() if path.exists() and reader.recognises(path)]
    if names == ["folder"] and path.name in _IMAGE_FOLDERS:
        above = path.resolve().parent
        names_above = [name for name in _READERS if name not in _NOT_FROM_INSIDE and _READERS[name].recognises(above)]
        if names_above:
            return names_above[0], above
    return (names[0], path) if names else None


def open_sequence(path: Path, format: str = "auto") -> Dataset:
    """Open a recorded sequence of a known data set, or a folder of images with its companion files.

    Images are not read yet, text files are. Raises InputError for an unknown format, a missing path, a path that is
    no such data set, or parts that contradict each other.
    """
    path = Path(path)
    if format not in FORMATS:
        nearest = get_close_matches(format, FORMATS, 1)
        hint = f", did you mean {nearest[0]!r}?" if nearest else ""
        raise InputError(f"no data set format {format!r}{hint or '.'} Known: {', '.join(FORMATS)}")
    with reaching(path):
        if not path.exists():
            raise InputError(f"no such file or folder: {path}: check the spelling, and that the disk is mounted")
        return _open(path, format)


def _open(path: Path, format: str) -> Dataset:
    found = _recognise(path) if format == "auto" else (format, path)
    if found is None:
        raise InputError(
            f"{path} is none of the known data sets ({', '.join(_READERS)}): give the folder of one sequence, "
            "or name the format"
        )
    name, place = found
    sequence = _READERS[name].open(place)
    others = {*sequence.depth_paths, *sequence.label_paths, *sequence.mask_paths}
    return replace(sequence, notes=(*sequence.notes, *unused_pictures(sequence.image_paths, others)))
