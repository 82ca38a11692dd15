"""Images of every kind a folder may hold, against OpenCV as the foreign reader and writer."""

import math
import struct
import zlib
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms
from PIL.TiffImagePlugin import IFDRational
from pillow_heif import from_bytes, register_heif_opener

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.image_folder import frame_number, list_images, natural_key, read_image_times
from msgs_slam.formats.image_tags import ExifLens, lens_of, place_of
from msgs_slam.formats.images import (
    OTHER,
    UNUSABLE,
    decode_rgb,
    exif_gps,
    exif_time,
    image_size,
    is_plain,
    read_depth_png,
    read_grey_png,
    read_header,
    read_label_png,
    read_rgb,
    read_transparent,
    write_grey_png,
    write_rgb,
)
from msgs_slam.pipelines.source.recording import open_recording

register_heif_opener()  # to write HEIC, which the program only reads


def _focal_px(path: Path, width: int, height: int) -> float | None:
    return read_header(path).lens.focal_px(width, height)


@pytest.fixture
def picture() -> np.ndarray:
    """(40, 60, 3) with smooth, different channels: no symmetry hides a flip or a channel swap."""
    y, x = np.mgrid[0:40, 0:60]
    return np.stack([4 * x, 6 * y, 120 + x - y], axis=2).clip(0, 255).astype(np.uint8)


def test_natural_order() -> None:
    names = ["img10.png", "img2.png", "img1b.png", "a", "img02.png", "7.png", "img2b10", "img2b9"]
    assert sorted(names, key=natural_key) == [
        "7.png", "a", "img1b.png", "img02.png", "img2.png", "img2b9", "img2b10", "img10.png",
    ]  # fmt: skip


def test_list_images_leaves_out_what_is_no_image(tmp_path: Path) -> None:
    for name in ["f10.JPG", "f9.png", ".f1.png", "notes.txt", "f11.jpeg"]:
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert [p.name for p in list_images(tmp_path)] == ["f9.png", "f10.JPG", "f11.jpeg"]


def test_folders_without_images_are_explained(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        list_images(tmp_path / "none")
    with pytest.raises(InputError, match="no images in"):
        list_images(tmp_path)
    _touch_images(tmp_path / "keyframes" / "images", ["0.png", "1.png", "2.png"])  # as Polycam's raw data
    _touch_images(tmp_path / "other", ["0.png", "1.png"])
    with pytest.raises(InputError, match="the folder keyframes/images/ in it holds 3 images: give that"):
        list_images(tmp_path)
    for name in ("IMG_1.DNG", "IMG_1.CR3"):
        (tmp_path / name).touch()
        with pytest.raises(InputError, match=r"\.dng files are not supported"):
            list_images(tmp_path)


@pytest.mark.parametrize("name", ["a.png", "a.bmp"])
def test_png_and_bmp_are_lossless_for_a_foreign_reader(tmp_path: Path, picture: np.ndarray, name: str) -> None:
    write_rgb(tmp_path / name, picture)
    assert (read_rgb(tmp_path / name) == picture).all()
    assert (cv2.imread(str(tmp_path / name))[:, :, ::-1] == picture).all()
    assert image_size(tmp_path / name) == (60, 40)


def test_jpeg_keeps_full_colour_resolution(tmp_path: Path) -> None:
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = (255, 0, 0)
    stripes[:, 1::2] = (0, 0, 255)
    write_rgb(tmp_path / "a.jpg", stripes)
    error = np.abs(read_rgb(tmp_path / "a.jpg").astype(int) - stripes)
    assert 0 < error.mean() < 6  # chroma subsampling would average neighbours: over 60


def test_a_foreign_writer_is_read(tmp_path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(tmp_path / "a.bmp"), picture[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "a.tiff"), picture[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "grey.png"), picture[:, :, 0])
    cv2.imwrite(str(tmp_path / "deep.png"), picture[:, :, ::-1].astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "deep_grey.png"), picture[:, :, 0].astype(np.uint16) * 257)
    alpha = np.dstack([picture[:, :, ::-1], np.full((40, 60), 128, np.uint8)])
    cv2.imwrite(str(tmp_path / "alpha.png"), alpha)
    for name in ("a.bmp", "a.tiff", "deep.png", "alpha.png"):
        assert (read_rgb(tmp_path / name) == picture).all(), name
    for name in ("grey.png", "deep_grey.png"):
        assert (read_rgb(tmp_path / name) == picture[:, :, :1]).all(), name
    assert (decode_rgb((tmp_path / "a.bmp").read_bytes(), "a") == picture).all()


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "PA", "RGBA", "CMYK", "YCbCr", "LAB", "HSV", "I;16B", "F"])
def test_every_pixel_format_is_read_as_the_picture_it_is(tmp_path: Path, mode: str) -> None:
    """A grey ramp, which every format can hold."""
    ramp = np.repeat(np.linspace(0, 255, 64).round().astype(np.uint8)[None], 16, axis=0)
    grey = Image.fromarray(ramp)
    if mode == "I;16B":
        Image.fromarray((ramp.astype(np.uint16) * 257).astype(">u2")).save(tmp_path / "a.tif")
    elif mode == "LAB":
        lab = cv2.cvtColor(np.repeat(ramp[..., None], 3, axis=2), cv2.COLOR_RGB2LAB)
        shifted = np.dstack([lab[..., 0], (lab[..., 1:].astype(int) - 128).astype(np.int8).view(np.uint8)])
        Image.frombytes("LAB", (64, 16), shifted.tobytes()).save(tmp_path / "a.tif")
    elif mode == "F":
        Image.fromarray(ramp.astype(np.float32)).save(tmp_path / "a.tif")
    elif mode in ("P", "PA", "HSV", "YCbCr"):
        made = grey.convert("RGB").convert(mode.replace("PA", "P") if mode != "HSV" else "RGB")
        made.save(tmp_path / ("a.jpg" if mode == "YCbCr" else "a.png"), **({"transparency": 0} if mode == "PA" else {}))
    else:
        (grey.convert("RGB") if mode == "CMYK" else grey).convert(mode).save(
            tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
        )
    path = next(p for p in tmp_path.iterdir())
    found = read_rgb(path).astype(int)
    assert found.shape == (16, 64, 3)
    assert np.abs(found.mean(axis=(0, 2)) - ramp[0]).max() < (256 if mode == "1" else 6 if mode[0] != "P" else 30)
    assert found[:, -8:].mean() > found[:, :8].mean() + 200


def test_transparency_of_every_kind_is_found(tmp_path: Path) -> None:
    picture = np.full((8, 10), 200, np.uint8)
    picture[:, :4] = 7
    grey, clear = Image.fromarray(picture), picture == 7
    alpha = Image.fromarray(np.where(clear, 0, 255).astype(np.uint8))
    Image.merge("LA", (grey, alpha)).save(tmp_path / "la.png")
    Image.merge("RGBA", (grey, grey, grey, alpha)).save(tmp_path / "rgba.webp", lossless=True, exact=True)
    Image.merge("RGBA", (grey, grey, grey, alpha)).save(tmp_path / "rgba.tif")
    grey.save(tmp_path / "key.png", transparency=7)
    grey.convert("RGB").save(tmp_path / "rgb_key.png", transparency=(7, 7, 7))
    palette = Image.fromarray(clear.astype(np.uint8), "P")
    palette.putpalette([9, 9, 9, 5, 5, 5])
    palette.save(tmp_path / "palette.png", transparency=1)
    deep = np.dstack([np.repeat(picture[:, :, None], 3, 2), np.asarray(alpha)]).astype(np.uint16) * 257
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 7
    for path in files:
        found = read_transparent(path)
        assert found is not None, path.name
        assert (found == clear).all(), path.name
        assert read_rgb(path).shape == (8, 10, 3)
    grey.save(tmp_path / "opaque.png")
    Image.merge("LA", (grey, Image.new("L", grey.size, 255))).save(tmp_path / "opaque_la.png")
    assert read_transparent(tmp_path / "opaque.png") is read_transparent(tmp_path / "opaque_la.png") is None


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_agrees_with_opencv(tmp_path: Path, picture: np.ndarray, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).save(tmp_path / "a.jpg", quality=95, exif=exif)
    ours = read_rgb(tmp_path / "a.jpg")
    theirs = cv2.imread(str(tmp_path / "a.jpg"))[:, :, ::-1]
    assert ours.shape == theirs.shape
    assert np.abs(ours.astype(int) - theirs).max() <= 2
    assert image_size(tmp_path / "a.jpg") == (ours.shape[1], ours.shape[0])


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_and_avif_are_upright(tmp_path: Path, picture: np.ndarray, orientation: int, suffix: str) -> None:
    """HEIC is turned by the file's own boxes, not by EXIF again: libheif does it, and says so to nobody."""
    for name in ("a.jpg", f"b{suffix}"):
        image = Image.fromarray(picture)
        image.getexif()[ExifTags.Base.Orientation] = orientation
        image.save(tmp_path / name, quality=95, **({} if name == "b.heic" else {"exif": image.getexif()}))
    jpeg, other = read_rgb(tmp_path / "a.jpg"), read_rgb(tmp_path / f"b{suffix}")
    assert image_size(tmp_path / f"b{suffix}") == (other.shape[1], other.shape[0])
    assert other.shape == jpeg.shape
    assert 0 < np.abs(other.astype(int) - jpeg).mean() < 4


@pytest.mark.parametrize(
    ("latitude", "south", "expected"),
    [((10.51,), "S", -10.51), (10.51, "N", 10.51), (-10.51, "S", -10.51), ((10.0, 30.6), "S", -10.51)],
)
def test_places_of_one_or_two_numbers_are_read(latitude: object, south: str, expected: float) -> None:
    found = place_of({1: south, 2: latitude, 3: "E", 4: (20.0, 15.0, 36.0)})
    assert found is not None
    assert found[:2] == pytest.approx((expected, 20.26))


@pytest.mark.parametrize("south", ["S", b"S\0"])
def test_heic_tells_focal_length_time_and_place(tmp_path: Path, picture: np.ndarray, south: str | bytes) -> None:
    exif = Image.Exif()
    camera, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    camera[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    camera[ExifTags.Base.DateTimeOriginal] = "2024:05:06 07:08:09"
    gps |= {1: south, 2: (10.0, 30.0, 0.0), 3: "E", 4: (20.0, 15.0, 36.0), 6: 120.5}
    Image.fromarray(picture).save(tmp_path / "IMG_1.HEIC", exif=exif)
    path = tmp_path / "IMG_1.HEIC"
    assert list_images(tmp_path) == [path]
    assert _focal_px(path, 6000, 4000) == pytest.approx(26 * 6000 / 36, rel=1e-6)
    assert exif_time(path) == (datetime(2024, 5, 6, 7, 8, 9) - datetime(1970, 1, 1)).total_seconds()
    assert exif_gps(path) == pytest.approx((-10.5, 20.26, 120.5))
    path.rename(tmp_path / "IMG_1.jpg")  # phones' programs send them under that name
    assert not is_plain(tmp_path / "IMG_1.jpg")
    whole = (tmp_path / "IMG_1.jpg").read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match="damaged or no image"):
        read_rgb(path)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.heic"])
def test_deep_pictures_have_no_bands(tmp_path: Path, name: str) -> None:
    """Every one of the 256 levels of a ramp of 16 bits (of 10 in HEIC), each where it belongs."""
    ramp = np.repeat(np.linspace(0, 65535, 2048).astype(np.uint16)[None], 8, axis=0)
    if name == "a.heic":
        deep = from_bytes("RGB;16", (2048, 8), np.repeat(ramp[..., None], 3, axis=2).tobytes())
        deep.save(tmp_path / name, quality=-1, chroma=444)
    else:
        cv2.imwrite(str(tmp_path / name), np.repeat(ramp[..., None], 3, axis=2))
    levels = read_rgb(tmp_path / name).astype(int)
    assert len(np.unique(levels)) > 250
    assert np.abs(levels - ramp[..., None] / 257).max() < 1.5
    assert (np.diff(levels[4, :, 1]) >= 0).all()


def test_unreadable_images_are_explained(tmp_path: Path, picture: np.ndarray) -> None:
    write_rgb(tmp_path / "good.jpg", picture)
    write_rgb(tmp_path / "good.png", picture)
    for name in ("good.jpg", "good.png"):
        data = (tmp_path / name).read_bytes()
        cut = tmp_path / f"cut_{name}"
        cut.write_bytes(data[: len(data) * 6 // 10])
        with pytest.raises(InputError, match="is damaged or no image"):
            read_rgb(cut)
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.jpg").write_text("I am no picture")
    for name, why in (("empty.png", "is empty"), ("text.jpg", "of no image format"), ("none.jpg", "no such file")):
        with pytest.raises(InputError, match=why):
            read_rgb(tmp_path / name)


def _png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    idat = chunk(b"IDAT", zlib.compress(b"\0" * 1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + idat + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [11_000, 12_000, 60_000])
def test_bombs_are_refused_by_their_header(tmp_path: Path, side: int) -> None:
    (tmp_path / "bomb.png").write_bytes(_png_claiming(side, side))
    limit = r"bomb\.png.* is over the limit of 120 million pixels: scale it down"
    with pytest.raises(InputError, match=limit):
        read_rgb(tmp_path / "bomb.png")


def test_depth_and_labels_come_back_and_palettes_give_indices(tmp_path: Path) -> None:
    depth = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60) * 27
    depth[0, 0] = 65535
    write_grey_png(tmp_path / "d.png", depth)
    assert (read_depth_png(tmp_path / "d.png") == depth).all()
    assert (cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED) == depth).all()
    np.testing.assert_allclose(read_grey_png(tmp_path / "d.png"), depth / 65535, atol=1e-6)
    labels = (depth % 23).astype(np.uint8)
    write_grey_png(tmp_path / "l.png", labels)
    paletted = Image.fromarray(labels, mode="P")
    paletted.putpalette(list(np.random.default_rng(0).integers(0, 256, 768)))
    paletted.save(tmp_path / "p.png")
    for name in ("l.png", "p.png"):
        assert (read_label_png(tmp_path / name) == labels).all(), name


def test_wrong_kinds_of_maps_are_refused(tmp_path: Path, picture: np.ndarray) -> None:
    write_rgb(tmp_path / "colour.png", picture)
    write_grey_png(tmp_path / "preview.png", picture[:, :, 0])
    with pytest.raises(InputError, match="colour image"):
        read_label_png(tmp_path / "colour.png")
    with pytest.raises(InputError, match="8 bits"):
        read_depth_png(tmp_path / "preview.png")
    with pytest.raises(ValueError, match="expected uint8"):
        write_rgb(tmp_path / "x.png", picture.astype(np.float32))
    with pytest.raises(ValueError, match="none of"):
        write_rgb(tmp_path / "x.gif", picture)
    assert not (tmp_path / "x.gif").exists()


def _with_exif(path: Path, size: tuple[int, int], **tags: object) -> Path:
    exif = Image.Exif()
    names = {"equivalent": 0xA405, "focal": 0x920A, "pitch": 0xA20E, "unit": 0xA210, "width": 0xA002,
             "taken": 0x9003, "subsec": 0x9291}  # fmt: skip
    exif.get_ifd(0x8769).update({names[k]: v for k, v in tags.items()})
    Image.new("RGB", size).save(path, exif=exif)
    return path


PITCH = {"focal": 10.0, "pitch": 5080.0, "unit": 2, "width": 4000}
"""4000 px over 20 mm = 200 px/mm = 5080 px/inch; 10 mm = 2000 px of the original, 1000 px at half size."""


@pytest.mark.parametrize(
    ("tags", "size", "focal"),
    [
        # a 4:3 picture whose diagonal of 500 px stands for 43.27 mm
        ({"equivalent": 26}, (400, 300), 26 / 43.2666 * 500),
        ({"equivalent": 26}, (200, 150), 26 / 43.2666 * 250),
        (PITCH, (2000, 1500), 1000),
        (PITCH | {"pitch": 72.0}, (2000, 1500), None),
        ({}, (40, 30), None),
        *(({"equivalent": wrong}, (400, 300), None) for wrong in (0, 1, 6, 1300, 65535)),
        *((PITCH | {"equivalent": wrong}, (2000, 1500), 1000) for wrong in (1, 65535)),
    ],
)
def test_exif_focal(tmp_path: Path, tags: dict, size: tuple[int, int], focal: float | None) -> None:
    found = _focal_px(_with_exif(tmp_path / "a.jpg", (400, 300), **tags), *size)
    assert found == (focal if focal is None else pytest.approx(focal, rel=1e-4))


def test_malformed_exif_costs_what_it_says_and_not_the_image(tmp_path: Path, picture: np.ndarray) -> None:
    half = IFDRational(1, 2)
    zero, nothing = IFDRational(5, 0), IFDRational(0, 0)
    assert place_of({1: b"S\0", 2: (10, 30, 0), 3: b"w", 4: (20, 15, half * 0)}) == pytest.approx(
        (-10.5, -20.25, math.nan), nan_ok=True
    )
    assert place_of({1: "S", 2: (10, zero, 0), 3: "E", 4: (20, 15, 36)}) is None
    assert place_of({1: "S", 2: (10, nothing, 0), 3: "E", 4: (20, 15, 36)}) is None
    assert place_of({1: "S", 2: 10.0, 3: "E", 4: ("a", "b", "c")}) is None
    bad = {0xA405: (26,), 0x920A: zero, 0xA20E: nothing, 0xA210: [2], 0xA404: zero}
    assert lens_of({271: b"Maker\0", 272: 5}, bad, (40, 30)) == ExifLens(camera="Maker 5")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(picture).save(tmp_path / "a.jpg", exif=exif.tobytes()[:-8] + b"\xff" * 8)
    Image.fromarray(picture).save(tmp_path / "b.jpg", exif=b"Exif\0\0no TIFF header at all")
    for name in ("a.jpg", "b.jpg"):
        assert read_rgb(tmp_path / name).size == picture.size
        assert (_focal_px(tmp_path / name, 40, 30), exif_gps(tmp_path / name)) == (None, None)


def test_exif_time(tmp_path: Path) -> None:
    path = _with_exif(tmp_path / "a.jpg", (40, 30), taken="1970:01:02 00:00:01", subsec="25")
    assert exif_time(path) == pytest.approx(86401.25)
    assert exif_time(_with_exif(tmp_path / "c.jpg", (40, 30), taken="    :  :     :  :  ")) is None


def test_real_phone_photos_agree_with_their_reconstruction(shared_data: Path) -> None:
    for path in list_images(shared_data / "format_cases" / "colmap_table10" / "images")[:3]:
        assert _focal_px(path, *image_size(path)) is None  # the messenger removed it
    names = [p.name for p in list_images(shared_data / "format_cases" / "colmap_table10" / "images")]
    assert names[-1] == "10table.jpeg"


def _touch_images(folder: Path, names: list[str]) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", (4, 4)).save(folder / name)
    return [folder / name for name in names]


def test_times_by_order_by_number_and_by_name(tmp_path: Path) -> None:
    images = _touch_images(tmp_path / "rgb", ["000000.png", "000003.png", "000006.png"])
    (tmp_path / "timestamps.txt").write_text("".join(f"{i / 10}\n" for i in range(9)))
    assert read_image_times(images) == pytest.approx([0, 0.3, 0.6])
    (tmp_path / "rgb" / "timestamps.txt").write_text("1.5\n2.5\n4\n")
    assert read_image_times(images) == pytest.approx([1.5, 2.5, 4])
    (tmp_path / "rgb" / "timestamps.txt").write_text("# time name\n5 rgb/000003.png\n4 rgb/000000.png\n6 000006.png")
    assert read_image_times(images) == pytest.approx([4, 5, 6])
    # As the stage `frames` of a run writes them.
    (tmp_path / "rgb" / "timestamps.txt").write_text("000003.png 5\n000000.png 4\n000006.png 6\n")
    assert read_image_times(images) == pytest.approx([4, 5, 6])


def test_times_above_count_only_where_they_fit(tmp_path: Path) -> None:
    images = _touch_images(tmp_path / "photos", ["a.png", "b.png"])
    for text in ("bus leaves at 9\n", "1\n"):
        (tmp_path / "times.txt").write_text(text)
        assert read_image_times(images) is None
    (tmp_path / "times.txt").write_text("1\n2\n")
    assert read_image_times(images) == pytest.approx([1, 2])


def test_times_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    images = _touch_images(tmp_path, ["a.png", "b.png"])
    assert read_image_times(images) is None
    for text, message in [
        ("1\n2\n3\n", "3 times for 2"), ("2\n1\n", "increase"), ("1 a.png\n2 c.png", "no time for 'b.png'"),
        ("1 a.png\ntwo b.png", "states no seconds"),
    ]:  # fmt: skip
        (tmp_path / "timestamps.txt").write_text(text)
        with pytest.raises(InputError, match=message):
            read_image_times(images)


def test_times_from_exif_count_from_the_first(tmp_path: Path) -> None:
    paths = [
        _with_exif(tmp_path / f"{i}.jpg", (8, 8), taken="2020:01:01 10:00:0" + str(i), subsec=str(i)) for i in range(3)
    ]
    assert read_image_times(paths) == pytest.approx([0, 1.1, 2.2])
    assert read_image_times([paths[0], paths[0]]) is None


def test_frame_numbers() -> None:
    assert frame_number(Path("x1/frame-000012.color.jpg")) == 12
    assert frame_number(Path("rgb_7.png")) == 7
    assert frame_number(Path("cover.png")) is None
    assert frame_number(Path("9" * 5000)) is None


SRGB_IN_XYZ = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
P3_IN_XYZ = np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]])
"""Columns are red, green and blue, by the white of ICC profiles (D50)."""


def icc_profile(in_xyz: np.ndarray, gamma: float) -> bytes:
    """An RGB profile of version 2 by its primaries (3, 3) and exponent."""

    def xyz(values: np.ndarray) -> bytes:
        return b"XYZ " + bytes(4) + struct.pack(">3i", *(round(65536 * v) for v in values))

    curve = b"curv" + bytes(4) + struct.pack(">IH2x", 1, round(256 * gamma))
    about = b"desc" + bytes(4) + struct.pack(">I", 5) + b"made\0" + bytes(79)
    tags = {b"desc": about, b"cprt": b"text" + bytes(4) + b"none", b"wtpt": xyz(np.array([0.9642, 1.0, 0.8249]))}
    for i, name in enumerate(b"rgb"):
        tags[bytes([name]) + b"XYZ"], tags[bytes([name]) + b"TRC"] = xyz(in_xyz[:, i]), curve
    table, body, at = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for name, data in tags.items():
        table += name + struct.pack(">II", at + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4xI4s4s4s12x4s", at + len(body), 0x02200000, b"mntr", b"RGB ", b"XYZ ", b"acsp")
    white = struct.pack(">3i", 63190, 65536, 54061)
    return (head.ljust(68, b"\0") + white).ljust(128, b"\0") + table + body


def in_srgb(numbers: np.ndarray, in_xyz: np.ndarray, gamma: float) -> np.ndarray:
    """What numbers (..., 3) of such a profile are in sRGB, 0 to 255."""
    light = ((numbers / 255.0) ** gamma @ (np.linalg.inv(SRGB_IN_XYZ) @ in_xyz).T).clip(0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.fixture
def patches() -> np.ndarray:
    """(64, 96, 3) of flat colours."""
    return np.kron(np.random.default_rng(3).integers(30, 225, (4, 6, 3)), np.ones((16, 16, 1))).astype(np.uint8)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "palette.png", "alpha.png", "a.tif", "a.webp", "a.avif", "a.heic"])
def test_colours_of_a_profile_become_srgb(tmp_path: Path, patches: np.ndarray, name: str) -> None:
    image = Image.fromarray(patches)
    if name == "palette.png":
        image = image.quantize(24)
    if name == "alpha.png":
        image.putalpha(Image.new("L", image.size, 200))
    image.save(
        tmp_path / name, icc_profile=icc_profile(P3_IN_XYZ, 2.2), quality=100 if name[-3:] in ("jpg", "ebp") else 95
    )
    wanted, found = in_srgb(patches, P3_IN_XYZ, 2.2)[8::16, 8::16], read_rgb(tmp_path / name)[8::16, 8::16]
    assert np.abs(wanted - patches[8::16, 8::16]).mean() > 8
    assert 0 < np.abs(wanted - found).mean() < (2.5 if name[-4:] in ("webp", "avif", "heic") else 1.2)
    assert read_header(tmp_path / name).colours == OTHER
    assert not is_plain(tmp_path / name)


def test_primaries_that_heif_states_become_srgb(tmp_path: Path, patches: np.ndarray) -> None:
    stated = {"color_primaries": 12, "transfer_characteristics": 13, "matrix_coefficients": 6, "full_range_flag": 1}
    Image.fromarray(patches).save(tmp_path / "a.heic", quality=95, **stated)
    srgb_light = np.where(patches <= 10.3, patches / 3294.6, ((patches / 255 + 0.055) / 1.055) ** 2.4)
    wanted = in_srgb(255 * srgb_light, P3_IN_XYZ, 1.0)[8::16, 8::16]
    assert 0 < np.abs(wanted - read_rgb(tmp_path / "a.heic")[8::16, 8::16]).mean() < 2.5


def test_grey_of_another_gamma_becomes_srgb(tmp_path: Path) -> None:
    """An RGB profile beside grey pixels, as raw converters write it."""
    ramp = np.repeat(np.arange(16, 240, 8, dtype=np.uint8)[None], 4, axis=0)
    Image.fromarray(ramp).save(tmp_path / "a.png", icc_profile=icc_profile(SRGB_IN_XYZ, 1.8))
    wanted = in_srgb(np.repeat(ramp[..., None], 3, axis=2), SRGB_IN_XYZ, 1.8)
    assert np.abs(wanted - read_rgb(tmp_path / "a.png")).max() < 2.5


@pytest.mark.parametrize("spelling", ["lcms", "by hand"])
def test_srgb_stays_as_it_is_byte_for_byte(tmp_path: Path, patches: np.ndarray, spelling: str) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    if spelling == "by hand":
        profile = profile.replace(b"sRGB", b"mine")
    Image.fromarray(patches).save(tmp_path / "a.png", icc_profile=profile)
    assert (read_rgb(tmp_path / "a.png") == patches).all()
    assert is_plain(tmp_path / "a.png")


@pytest.mark.parametrize("damage", ["cut", "noise", "lab", "no text"])
def test_an_unusable_profile_changes_nothing_and_is_named(tmp_path: Path, patches: np.ndarray, damage: str) -> None:
    whole = icc_profile(P3_IN_XYZ, 2.2)
    profile = {
        "cut": whole[:200],
        "no text": whole[:16] + b"\xff" * 4 + whole[20:],
        "noise": np.random.default_rng(0).bytes(500),
        "lab": ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes(),
    }[damage]
    for i in range(3):
        Image.fromarray(patches).save(tmp_path / f"{i}.png", **({"icc_profile": profile} if i else {}))
    assert (read_rgb(tmp_path / "1.png") == patches).all()
    assert read_header(tmp_path / "1.png").colours == UNUSABLE
    assert not is_plain(tmp_path / "1.png")
    said: list[str] = []
    assert len(list(open_recording(tmp_path).read(warn=said.append))) == 3
    (only,) = said
    assert "colour profile of 2 images is damaged" in only
    assert only.endswith("taken for sRGB: 1.png, 2.png")


def test_images_that_are_not_read_are_named(tmp_path: Path, picture: np.ndarray) -> None:
    """But for the raw file of a photograph that lies there as JPEG, too."""
    for name in ["a.jpg", "b.JPG", "c.png"]:
        write_rgb(tmp_path / name.lower(), picture)
        (tmp_path / name.lower()).rename(tmp_path / name)
    for name in ["a.CR3", "d10.jxl", "d9.raf", "e.Orf", "notes.txt", "b.dng", ".f.rw2"]:
        (tmp_path / name).write_bytes(b"\xff\x0a")
    said: list[str] = []
    assert len(list(open_recording(tmp_path).read(warn=said.append))) == 3
    assert len(said) == 1
    assert "3 files of kinds that are not read (1 .jxl, 1 .orf, 1 .raf) are left out, d9.raf first" in said[0]
