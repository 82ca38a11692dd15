"""A COLMAP project: images and the poses that COLMAP found for them."""

from pathlib import Path

import numpy as np

from ..colmap import ColmapModel, find_models, read_colmap_model
from ..errors import InputError
from ..image_folder import Listed, count_images, named_file, natural_key
from ..reading import resolve_within
from .calibration import camera_from_colmap
from .folder import images_outside, sequence_of
from .sequence import Camera, Dataset

_IMAGE_FOLDERS = ("images", "frames", ".", "rgb", "images_2", "images_4", "images_8")
"""Where a project keeps its images; those of images_N are reduced to one N-th, and the camera with them."""
_LEVELS_UP, _MAX_NAMED = 3, 3


def open_colmap(path: Path) -> Dataset:
    """Open the images of a COLMAP project in natural order: those of its largest model, with poses in the model's own
    unit, and those beside them that it could not register.

    The camera is given when all images share one; its distortion as OpenCV has it. Masks are those of masks/, called
    as the images with .png after it. Raises InputError when the model is incomplete or damaged, or its images are not
    found in images/, frames/, rgb/ or a reduced images_N/ in the folder or above it.
    """
    models = find_models(path) if path.is_dir() else []
    if not models:
        raise InputError(
            f"no complete COLMAP model in {path}: expected cameras, images and points3D as .bin or .txt in it or in "
            "sparse/0"
        )
    folder, *others = models
    model = read_colmap_model(folder)
    if not model.names:
        raise InputError(f"the COLMAP model in {folder} has no registered image: choose another of its models")
    root, files = _find_images(path, folder, model)
    posed = {file: i for i, file in enumerate(files) if file is not None}
    if len(posed) < len(files) - files.count(None):
        raise InputError(f"{root}: two images of the model {folder} are one file there: put them where their names say")
    unposed = images_outside(list(posed))
    names = {file: model.names[i] for file, i in posed.items()} | {f: f.relative_to(root).as_posix() for f in unposed}
    images = sorted(names, key=lambda file: natural_key(names[file]))
    poses = np.full((len(images), 4, 4), np.nan)
    poses[[file in posed for file in images]] = np.linalg.inv(
        model.cam_from_world[[posed[file] for file in images if file in posed]]
    )
    camera, notes = _shared_camera(model)
    masks = tuple(_mask((root if root == path else root.parent) / "masks", names[file]) for file in images)
    return sequence_of(
        "colmap", path, images,
        names=tuple(names[file].replace("/", "_") for file in images),
        camera=camera,
        world_from_cam=poses,
        metric=False,
        mask_paths=masks if any(masks) else (),
        notes=(
            *notes,
            *_notes(path, root, folder, others, len(posed), len(model.names), len(unposed)),
            *_other_folders(path, root, images),
        ),
    )  # fmt: skip


def _notes(
    path: Path, root: Path, folder: Path, others: list[Path], posed: int, in_model: int, unposed: int
) -> tuple[str, ...]:
    """What of the project is missing, and what of it has no part in the sequence."""
    named = " and ".join(f"{other.name}/" for other in others[:_MAX_NAMED]) + (", …" * (len(others) > _MAX_NAMED))
    said = (
        (posed < in_model, f"{in_model - posed} of the model's {in_model} images are missing in {root}"),
        (unposed, f"{unposed} of the {posed + unposed} images in {root.name}/ have no pose in the model {folder.name}/"
         f": they are used as well. Where poses of the others help, give --poses {path}"),
        (others, f"of {len(others) + 1} models the largest, {folder.name}/, is used, not {named}"),
    )  # fmt: skip
    return tuple(text for holds, text in said if holds)


def _other_folders(path: Path, root: Path, images: list[Path]) -> list[str]:
    """What is said of folders beside those of the images, such as of another camera of a rig."""
    used = {image.parent for image in images}
    folders = [] if root == path else [p for p in sorted(root.rglob("*")) if p.is_dir() and p not in used]
    counts = {p.relative_to(root).as_posix(): count for p in folders if (count := count_images(p))}
    named = ", ".join(f"{count} in {root.name}/{name}/" for name, count in list(counts.items())[:_MAX_NAMED])
    return [f"folders without an image of the model are left out ({named})"] if counts else []


def _mask(folder: Path, name: str) -> Path | None:
    """The mask of an image, as COLMAP calls it, or with .png in place of its suffix."""
    tried = (folder / f"{name}.png", (folder / name).with_suffix(".png"))
    return next((path for path in tried if path.is_file()), None)


def _find_images(path: Path, model_folder: Path, model: ColmapModel) -> tuple[Path, list[Path | None]]:
    """The folder that holds most of the model's images, and the file of each image, None for one that is missing."""
    above = [path, *model_folder.resolve().parents[:_LEVELS_UP]]
    places = [base / name for base in above for name in _IMAGE_FOLDERS if (base / name).is_dir()]
    listed: Listed = {}
    for shorten in (False, True):
        found = [[named_file([place], name, model_folder, shorten, listed) for name in model.names] for place in places]
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
