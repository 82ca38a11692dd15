"""A COLMAP project: images and the poses that COLMAP found for them."""

from pathlib import Path

import numpy as np

from ..colmap import MODEL_FOLDERS, ColmapModel, model_suffix, read_colmap_model
from ..errors import InputError
from ..image_folder import natural_key
from ..reading import named_file, resolve_within
from .matching import sequence_of
from .sequence import Camera, Sequence

_IMAGE_FOLDERS = ("images", "frames", ".", "rgb")
_LEVELS_UP = 3


def recognises(path: Path) -> bool:
    """Recognise a folder with a complete model, as text or binary, with its images in reach."""
    return _find_model(path) is not None


def open_colmap(path: Path) -> Sequence:
    """Open the registered images of a COLMAP model in natural order; lengths are in the model's own unit.

    The camera is given when all images share one; its distortion as OpenCV has it. Raises InputError when the model
    is incomplete or damaged, or its images are not found in images/, frames/ or rgb/ in the folder or above it.
    """
    folder = _find_model(path)
    if folder is None:
        raise InputError(
            f"no complete COLMAP model in {path}: expected cameras, images and points3D as .bin or .txt in it or in "
            "sparse/0"
        )
    model = read_colmap_model(folder)
    if not model.names:
        raise InputError(f"the COLMAP model in {folder} has no registered image: choose another of its models")
    root, files = _find_images(path, folder, model)
    order = sorted(range(len(model.names)), key=lambda i: natural_key(model.names[i]))
    found = [i for i in order if files[i] is not None]
    images = [file for i in found if (file := files[i]) is not None]
    camera, notes = _shared_camera(model)
    if len(found) < len(order):
        notes += (f"{len(order) - len(found)} of the model's {len(order)} images are missing in {root}",)
    return sequence_of(
        "colmap", path, images,
        names=tuple(model.names[i].replace("/", "_") for i in found),
        camera=camera,
        world_from_cam=np.asarray(np.linalg.inv(model.cam_from_world[found]), dtype=np.float64),
        metric=False,
        notes=notes,
    )  # fmt: skip


def _find_model(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    usual = [path / name for name in MODEL_FOLDERS]
    others = sorted(p for p in path.iterdir() if p.is_dir())
    return next((p for p in (*usual, *others) if model_suffix(p)), None)


def _find_images(path: Path, model_folder: Path, model: ColmapModel) -> tuple[Path, list[Path | None]]:
    """The folder that holds most of the model's images, and the file of each image, None for one that is missing."""
    above = [path, *model_folder.resolve().parents[:_LEVELS_UP]]
    places = [base / name for base in above for name in _IMAGE_FOLDERS if (base / name).is_dir()]
    for shorten in (False, True):
        found = [[named_file([place], name, model_folder, shorten) for name in model.names] for place in places]
        missing = [files.count(None) for files in found]
        if missing and min(missing) < len(model.names):
            best = missing.index(min(missing))
            for name, file in zip(model.names, found[best], strict=True):
                if file is None:
                    resolve_within(places[best], name, model_folder)
            return places[best], found[best]
    raise InputError(
        f"none of the {len(model.names)} images of the COLMAP model in {model_folder} is found (first: "
        f"{model.names[0]!r}): put them into {path / 'images'}"
    )


def _shared_camera(model: ColmapModel) -> tuple[Camera | None, tuple[str, ...]]:
    distinct = set(model.cameras)
    if len(distinct) > 1:
        return None, (f"the images have {len(distinct)} different cameras: the model's intrinsics are not used",)
    name, width, height, p = model.cameras[0]
    return camera_from_colmap(name, width, height, p)


def camera_from_colmap(
    name: str, width: int, height: int, p: tuple[float, ...]
) -> tuple[Camera | None, tuple[str, ...]]:
    """Return the camera of a COLMAP model name with its parameters; None and a note where it has no OpenCV
    equivalent."""
    focal = (p[0], p[0]) if name.startswith(("SIMPLE_", "RADIAL")) else (p[0], p[1])
    rest = p[1:] if name.startswith(("SIMPLE_", "RADIAL")) else p[2:]
    k = rest[2:]
    fisheye = name.endswith("FISHEYE")
    if name in ("SIMPLE_PINHOLE", "PINHOLE"):
        distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    elif name in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        distortion = (*k, 0.0, 0.0, 0.0)[:4]
    elif name in ("OPENCV", "OPENCV_FISHEYE"):
        distortion = k
    elif name == "FULL_OPENCV":
        distortion = k if any(k[5:]) else k[:5]
    else:
        return None, (f"COLMAP's camera model {name} is not supported: the model's intrinsics are not used",)
    return Camera(width, height, *focal, rest[0], rest[1], distortion, fisheye), ()
