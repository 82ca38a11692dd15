"""Folders of images by one camera, or by several: what EXIF and the pixel formats say is compared and used."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from pillow_heif import register_heif_opener

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png
from msgs_slam.pipelines.frames.masks import FrameMasks, open_masks
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.source.recording import open_recording
from msgs_slam.pipelines.types import Frame
from tests.formats.test_formats_images import P3_IN_XYZ, icc_profile

register_heif_opener()  # to write HEIC, which the program only reads
EQUIVALENT, FOCAL, ZOOM, PITCH = 0xA405, 0x920A, 0xA404, 0xA20E


def _noise(seed: int, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)


def _photos(folder: Path, *lenses: dict[int, object], model: str = "Phone") -> Path:
    folder.mkdir()
    for i, tags in enumerate(lenses):
        exif = Image.Exif()
        exif[0x0110] = model
        exif.get_ifd(0x8769).update(tags)
        Image.fromarray(_noise(i)).save(folder / f"{i}.jpg", exif=exif)
    return folder


def _turned(folder: Path, *orientations: int, suffix: str = ".jpg") -> list[np.ndarray]:
    """Photos of one sensor, 64 wide and 48 high as it lies, that state these orientations; the sensor's pixels."""
    folder.mkdir()
    for i, orientation in enumerate(orientations):
        exif = Image.Exif()
        exif[0x0112] = orientation
        smooth = cv2.resize(_noise(i, (6, 8)), (64, 48), interpolation=cv2.INTER_CUBIC)
        image = Image.fromarray(smooth)
        image.getexif()[0x0112] = orientation
        image.save(folder / f"{i}{suffix}", quality=95, **({"exif": exif} if suffix == ".jpg" else {}))
    return [cv2.resize(_noise(i, (6, 8)), (64, 48), interpolation=cv2.INTER_CUBIC) for i in range(len(orientations))]


@pytest.mark.parametrize("suffix", [".jpg", ".heic"])
@pytest.mark.parametrize(("orientations", "turns"), [((6, 1, 6, 8), 3), ((1, 6, 1, 3), 0), ((8, 1), 0)])
def test_photos_of_a_phone_that_was_turned_are_all_turned_alike(
    orientations: tuple[int, ...], turns: int, suffix: str, tmp_path: Path
) -> None:
    sensor = _turned(tmp_path / "photos", *orientations, suffix=suffix)
    source, notes = open_recording(tmp_path / "photos"), []
    frames = [frame.rgb for frame in source.read(warn=notes.append)]
    for frame, pixels in zip(frames, sensor, strict=True):
        assert frame.shape[:2] == (source.height, source.width)
        assert 0 < np.abs(frame.astype(int) - np.rot90(pixels, turns)).mean() < 8
    assert any("some sideways" in note for note in notes)
    assert [source.original(i) for i in range(len(frames))] == [
        tmp_path / "photos" / f"{i}.jpg" if (suffix, turns, orientation) == (".jpg", 0, 1) else None
        for i, orientation in enumerate(orientations)
    ]


def test_masks_of_turned_photos_lie_as_their_images(tmp_path: Path) -> None:
    _turned(tmp_path / "photos", 6, 6, 1)
    source = open_recording(tmp_path / "photos")
    upright = [np.zeros((64, 48), bool), np.zeros((64, 48), bool), np.zeros((48, 64), bool)]
    for i, mask in enumerate(upright):
        mask[:10] = True
        write_grey_png(tmp_path / "masks" / f"{i}.jpg.png", np.where(mask, 0, 255).astype(np.uint8))
    masks = open_masks(tmp_path / "masks", source)
    for i, turns in enumerate((0, 0, 3)):
        found = masks.left_out(i, source.width, source.height)
        assert (found == np.rot90(upright[i], turns)).all()


def test_mirrored_photos_are_turned_each_by_its_own(tmp_path: Path) -> None:
    _turned(tmp_path / "photos", 1, 5)
    with pytest.raises(InputError, match="differ in size"):
        open_recording(tmp_path / "photos")


@pytest.mark.parametrize("kind", ["12 bit grey", "thermal", "12 bit colour", "float with gaps"])
def test_deep_images_that_use_a_part_of_the_range_share_one_scale(kind: str, tmp_path: Path) -> None:
    """Levels are kept, an image that is darker than the others stays darker, and gaps are black."""
    ramp = np.tile(np.linspace(0, 4095, 512), (64, 1))
    for i, share in enumerate((1.0, 0.5)):
        values = ramp * share
        if kind == "12 bit colour":
            deep = np.repeat(values.astype(np.uint16)[:, :, None], 3, axis=2)
            cv2.imwrite(str(tmp_path / f"{i}.png"), deep)
        elif kind == "float with gaps":
            values = (values / 4095 * 3 - 1).astype(np.float32)
            values[0, 0], values[0, 1] = np.nan, np.inf
            Image.fromarray(values).save(tmp_path / f"{i}.tif")
        else:
            start = 51000 if kind == "thermal" else 0
            Image.fromarray((start + values).astype(np.uint16)).save(tmp_path / f"{i}.png")
    source = open_recording(tmp_path)
    bright, dark = (frame.rgb for frame in source.read())
    assert len(np.unique(bright)) > 200
    assert bright[9].max() == 255
    assert 100 < dark[9].max() < 160
    if kind == "float with gaps":
        assert bright[0, :2, 0].tolist() == [0, 255]
    assert [f.rgb.sum() for f in open_recording(tmp_path).read()] == [bright.sum(), dark.sum()]


def test_a_transparent_background_is_left_out_beside_the_masks(tmp_path: Path) -> None:
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:20], alpha[20:24] = 0, 130
    for i in range(3):
        opaque = np.full_like(alpha, 255)
        picture = np.dstack([_noise(i), opaque if i == 2 else alpha])
        Image.fromarray(picture).save(tmp_path / f"{i}.png")
    given = np.zeros((48, 64), bool)
    given[:, :8] = True
    write_grey_png(tmp_path / "masks" / "1.png", np.where(given, 0, 255).astype(np.uint8))
    source = open_recording(tmp_path)
    config = load_config(overrides=[f"frames.masks={tmp_path / 'masks'}"])
    masks = FrameMasks(config, source, tmp_path / "people", tmp_path / "picked", 1)
    frames = [Frame(i, f"{i}.png", float(i), i, 1.0) for i in range(3)]
    assert (masks.left_out(frames[0], 64, 48) == (alpha < 128)).all()
    assert (masks.left_out(frames[1], 64, 48) == ((alpha < 128) | given)).all()
    assert masks.left_out(frames[2], 64, 48) is None
    assert (masks.left_out(frames[0], 32, 24) == (alpha < 128)[::2, ::2]).all()


def test_files_of_several_pictures_and_several_cameras_are_told(tmp_path: Path) -> None:
    _photos(tmp_path / "photos", {}, {})
    _photos(tmp_path / "others", {}, model="Camera")
    (tmp_path / "others" / "0.jpg").rename(tmp_path / "photos" / "2.jpg")
    pages = [Image.fromarray(_noise(i)) for i in range(3)]
    pages[0].save(tmp_path / "photos" / "3.tif", save_all=True, append_images=pages[1:])
    notes: list[str] = []
    assert len(list(open_recording(tmp_path / "photos").read(warn=notes.append))) == 4
    assert any("2 cameras (2 by Phone, 1 by Camera)" in note for note in notes)
    assert any("of which the first is used: 3.tif (3)" in note for note in notes)


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ({EQUIVALENT: 28}, {EQUIVALENT: 56}, r"4 with .* 28 mm .*\(0\.jpg, 1\.jpg, …\); 2 with .* 56 mm"),
        ({EQUIVALENT: 24, FOCAL: 4.2}, {EQUIVALENT: 28, FOCAL: 4.2}, r"24 mm .* 28 mm"),
        ({FOCAL: 10.0, PITCH: 81.28}, {FOCAL: 20.0, PITCH: 81.28}, r"2 lenses or zooms: 4 with"),
        ({FOCAL: 4.25}, {FOCAL: 6.0}, r"4 with a focal length of 4\.25 mm \("),
        ({EQUIVALENT: 26, FOCAL: 4.2, ZOOM: 0.0}, {EQUIVALENT: 26, FOCAL: 4.2, ZOOM: 2.0}, r"digital zoom of 1 .* 2 "),
    ],
)
def test_images_of_several_lenses_are_refused_by_their_groups(
    first: dict[int, object], second: dict[int, object], told: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=told):
        open_recording(_photos(tmp_path / "photos", *4 * [first], *2 * [second]))


@pytest.mark.parametrize(
    ("lenses", "equivalent"),
    [
        (({EQUIVALENT: 28}, {EQUIVALENT: 29}, {EQUIVALENT: 29}), 29),
        (({}, {EQUIVALENT: 28}, {EQUIVALENT: 1}, {EQUIVALENT: 0}), 28),
        (({FOCAL: 4.0}, {EQUIVALENT: 26, FOCAL: 4.0}), 26),
        (({EQUIVALENT: 26, FOCAL: 4.2}, {EQUIVALENT: 26, FOCAL: 1.6, ZOOM: 2.0}), 26),  # the macro mode of phones
        (({}, {}), None),
    ],
)
def test_focal_lengths_that_agree_are_one_camera(
    lenses: tuple[dict[int, object], ...], equivalent: float | None, tmp_path: Path
) -> None:
    source = open_recording(_photos(tmp_path / "photos", *lenses))
    wanted = None if equivalent is None else pytest.approx(equivalent / 43.2666 * 80, rel=1e-4)
    assert source.exif_focal() == wanted


def _sized(folder: Path, *sizes: tuple[int, int]) -> Path:
    """Images of these heights and widths."""
    folder.mkdir()
    for i, size in enumerate(sizes):
        Image.fromarray(_noise(i, size)).save(folder / f"{i}.png")
    return folder


def test_a_few_images_of_another_size_are_left_out_and_named(tmp_path: Path) -> None:
    """Also where it is the first one, and beside photos of a phone that was turned."""
    source, said = open_recording(_sized(tmp_path / "a", (64, 48), *[(48, 64)] * 9, (30, 40))), []
    assert (source.width, source.height) == (64, 48)
    assert [f.source_index for f in source.read(warn=said.append)] == list(range(1, 10))
    assert said == ["2 of 11 images are left out, as their size is not 64x48: 10.png (40x30), 0.png (48x64)"]
    _turned(tmp_path / "b", 6, 1, 6, 8, 6)
    Image.fromarray(_noise(0, (20, 20))).save(tmp_path / "b" / "9.png")
    said.clear()
    source = open_recording(tmp_path / "b")
    assert [f.source_index for f in source.read(warn=said.append)] == list(range(5))
    assert any("1 of 6 images are left out" in s for s in said)
    assert any("some sideways" in s for s in said)


def test_sizes_without_a_clear_majority_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"differ in size: 0\.png is 64x48, 3\.png is 48x64 \(1 of 4 differ"):
        open_recording(_sized(tmp_path / "a", *[(48, 64)] * 3, (64, 48)))


def test_images_with_a_profile_are_written_anew(tmp_path: Path) -> None:
    """A copy would be shown in other colours than those of the map."""
    profile = icc_profile(P3_IN_XYZ, 2.2)
    for i in range(3):
        Image.fromarray(_noise(i)).save(tmp_path / f"{i}.png", **({"icc_profile": profile} if i == 1 else {}))
    source = open_recording(tmp_path)
    assert [source.original(i) is not None for i in range(3)] == [True, False, True]
