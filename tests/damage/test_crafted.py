"""Files and names made to break readers, one by one: refused with words, at once and in little memory."""

import contextlib
import io
import itertools
import json
import os
import re
import resource
import socket
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage_doors import DOORS, make_colmap, make_images, make_truth
from PIL import Image

from msgs_slam.formats.colmap import read_colmap_model
from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.datasets.calibration import read_calibration_file, read_yaml
from msgs_slam.formats.datasets.sequence import read_class_table, read_nyu40_classes
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.glb import read_mesh_glb
from msgs_slam.formats.gps import read_track
from msgs_slam.formats.image_folder import read_image_times
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.formats.poses import read_poses
from msgs_slam.formats.tensors import load_arrays, load_tensors
from msgs_slam.formats.textfile import read_json, read_toml
from msgs_slam.formats.trajectory import read_matrices, read_tum
from msgs_slam.pipelines.source.files import video_files
from msgs_slam.pipelines.source.recording import DatasetRecording, FolderRecording, open_recording

Read = Callable[[Path], Any]
DEEP = 100_000


def ply(head: bytes, body: bytes = b"", form: bytes = b"binary_little_endian") -> bytes:
    return b"ply\nformat " + form + b" 1.0\n" + head + b"end_header\n" + body


def npz_bomb() -> bytes:
    head, out = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": (3 << 30,)})
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w", force_zip64=True) as file,
    ):
        file.write(head.getvalue())
        for _ in range(1100):
            file.write(bytes(1 << 20))
    return out.getvalue()


def glb(header: dict[str, Any]) -> bytes:
    text = json.dumps(header).encode()
    text = text.ljust((len(text) + 3) // 4 * 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


BAD_FILES: dict[str, tuple[str, bytes, Read]] = {
    "JSON of a hundred thousand levels": ("a.json", b'{"a":' * DEEP + b"1" + b"}" * DEEP, read_json),
    "list of a hundred thousand levels": ("a.json", b"[" * DEEP + b"]" * DEEP, read_json),
    "JSON number of 5000 digits": ("a.json", b'{"a": ' + b"1" * 5000 + b"}", read_json),
    "JSON number of 400 digits": ("a.json", b"[1" + b"0" * 400 + b"]", read_json),
    "JSON number beyond floats": ("a.json", b"[1e999]", read_json),
    "JSON NaN": ("a.json", b'{"a": NaN}', read_json),
    "half a character": ("a.json", b'["\\ud800"]', read_json),
    "TOML of a hundred thousand levels": ("a.toml", b"a = " + b"[" * DEEP + b"]" * DEEP, read_toml),
    "key of a hundred thousand parts": ("a.toml", b".".join([b"a"] * DEEP) + b" = 1", read_toml),
    "inline key of many parts": ("a.toml", b"x = {" + b".".join([b"a"] * DEEP) + b" = 1}", read_toml),
    "TOML number of 5000 digits": ("a.toml", b"a = " + b"1" * 5000, read_toml),
    "date that is none": ("a.toml", b"a = 2024-02-31", read_toml),
    "PLY of a million million rows": ("a.ply", ply(b"element vertex 1000000000000\nelement face 0\n"), read_mesh_ply),
    "face that points far outside": (
        "a.ply",
        ply(b"element vertex 3\nelement face 1\n", bytes(3 * 16) + b"\3" + b"\xff\xff\xff\x7f" * 3),
        read_mesh_ply,
    ),
    "vertex that is no number": (
        "a.ply", ply(b"element vertex 1\nelement face 0\n", b"\xff" * 16), read_mesh_ply,
    ),
    "GLB of a billion zeros": (
        "a.glb", glb({"meshes": [0], "bufferViews": 5 * [{"byteOffset": 0, "byteLength": 10**9}]}), read_mesh_glb,
    ),
    "GLB that names another file": (
        "a.glb", glb({"textures": [], "meshes": [0], "buffers": [{"uri": "/etc/passwd"}]}), read_mesh_glb,
    ),
    "npz bomb": ("a.npz", npz_bomb(), load_arrays),
    "safetensors header of 2^62 bytes": ("a.safetensors", struct.pack("<Q", 1 << 62) + b"{}", load_tensors),
    "quaternion of length 3": ("a.txt", b"0 0 0 0 0 0 0 3\n", read_tum),
    "quaternion whose length overflows": ("a.txt", b"0 0 0 0 1e308 1e308 0 0\n", read_tum),
    "position beyond reach": ("a.txt", b"0 1e300 0 0 0 0 0 1\n", read_tum),
    "matrix that is scaled": ("a.txt", b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1\n", read_matrices),
    "matrix whose products overflow": ("a.txt", b"1e300 1e300 0 0 -1e300 1e300 0 0 0 0 1 0 0 0 0 1\n", read_matrices),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD_FILES)
def test_it_is_refused_in_little_memory(what: str, tmp_path: Path) -> None:
    name, data, read = BAD_FILES[what]
    (tmp_path / name).write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError) as error:
        read(tmp_path / name)
    assert len(str(error.value)) < 1000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000


def test_a_colmap_pose_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    make_colmap(".txt")(tmp_path)
    path = tmp_path / "images.txt"
    good, lines = path.read_text(), path.read_text().splitlines()
    row = next(i for i, line in enumerate(lines) if line.endswith(".png"))
    for place, value in ((1, "3.0"), (1, "nan"), (5, "nan"), (6, "1e300")):
        words = good.splitlines()[row].split()
        words[place] = value
        path.write_text("\n".join([*lines[:row], " ".join(words), *lines[row + 1 :]]) + "\n")
        with pytest.raises(InputError):
            read_colmap_model(tmp_path)


def test_a_camera_for_another_shape_is_refused_and_a_resized_one_fits(tmp_path: Path) -> None:
    make_truth(tmp_path)
    path = tmp_path / "intrinsics.json"
    camera = json.loads(path.read_text())["camera"]
    path.write_text(json.dumps(camera | {"w": 640, "h": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}))
    known = DatasetRecording(open_sequence(tmp_path)).camera()
    assert known is not None
    assert known.fx == known.fy == 50
    for change in ({"w": 1920, "h": 1920}, {"w": 1e19}, {"fx": 1e30}, {"fy": 1e-30}, {"k1": 1e30}, {"depth_scale": -1}):
        path.write_text(json.dumps(camera | change))
        with pytest.raises(InputError):
            DatasetRecording(open_sequence(tmp_path)).camera()


def test_a_card_must_name_the_output(tmp_path: Path) -> None:
    DOORS["card"].make(tmp_path)
    card = tmp_path / "card.toml"
    text = re.sub(r'^output = ".*"$', 'output = ""', card.read_text(), flags=re.MULTILINE)
    assert text != card.read_text()
    card.write_text(text)
    with pytest.raises(InputError, match="it has no output ''"):
        DOORS["card"].read(tmp_path / DOORS["card"].entry)


# time ----------------------------------------------------------------------------------------------------------------

REPEATED = {
    "blank lines": "\n", "blanks": " ", "one word": "a", "one number": "1", "numbers": "1 ", "commas": ",",
    "semicolons": ";", "quotes": '"', "escaped quotes": '\\"', "lists": "[", "lists of keys": "data: [\n",
    "objects": '{"a":', "elements": "<a>",
    "comments": "# 1\n", "colons": "a:", "brackets": "[latitude: ", "dots": "1.", "indents": " -\n",
}  # fmt: skip
PARSERS: dict[str, tuple[str, Read]] = {
    "TUM": ("a.txt", read_tum),
    "poses": ("a.csv", read_poses),
    "poses, JSON": ("a.json", read_poses),
    "poses, XML": ("a.xml", read_poses),
    "track": ("a.gpx", read_track),
    "track, table": ("a.csv", read_track),
    "track, subtitles": ("a.srt", read_track),
    "calibration, YAML": ("a.yaml", lambda p: read_calibration_file(p, (64, 48))),
    "calibration, XML": ("a.xml", lambda p: read_calibration_file(p, (64, 48))),
    "calibration, text": ("a.txt", lambda p: read_calibration_file(p, (64, 48))),
    "calibration, JSON": ("a.json", lambda p: read_calibration_file(p, (64, 48))),
    "EuRoC's sensor": ("sensor.yaml", read_yaml),
    "classes": ("a.txt", read_class_table),
    "classes of ScanNet": ("a.tsv", read_nyu40_classes),
    "TOML": ("a.toml", read_toml),
    "transforms": ("transforms.json", open_sequence),
    "times": ("times.txt", lambda p: read_image_times([p.parent / "1.png"])),
    "PLY": ("a.ply", read_mesh_ply),
    "list of videos": ("a.videos", video_files),
}


@pytest.mark.parametrize("what", PARSERS)
def test_text_is_read_in_a_time_that_grows_as_it_does(what: str, tmp_path: Path) -> None:
    """Eight times as much takes eight times as long, with room for noise and for what takes no time at all."""
    name, read = PARSERS[what]
    head = {"PLY": "ply\n", "track": "<gpx>", "poses, XML": "<a>", "calibration, XML": "<a>"}.get(what, "")

    def seconds(text: str) -> float:
        (tmp_path / name).write_text(head + text)
        started = time.process_time()
        with contextlib.suppress(InputError):
            read(tmp_path / name)
        return time.process_time() - started

    for kind, piece in REPEATED.items():
        few = max(seconds(piece * 2000), 0.03)
        assert seconds(piece * 16_000) < 24 * few, kind


# sources ------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes in the file system")
def test_what_is_no_file_is_no_source(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "s.mp4"))
    (tmp_path / "loop.mp4").symlink_to("loop.mp4")
    for path in (
        tmp_path / "pipe.mp4", tmp_path / "s.mp4", tmp_path / "loop.mp4", Path("/dev/zero"), Path("/dev/null"),
        Path("/proc/self/environ"), tmp_path / ("x" * 300), tmp_path / ("x/" * 3000), tmp_path / "nowhere",
    ):  # fmt: skip
        with pytest.raises(InputError):
            open_recording(path)
    listener.close()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("name", [n for n, d in DOORS.items() if d.entry])
def test_what_may_not_be_read_is_said(name: str, tmp_path: Path) -> None:
    DOORS[name].make(tmp_path)
    (tmp_path / DOORS[name].entry).chmod(0)
    with pytest.raises(InputError, match="permission denied"):
        DOORS[name].read(tmp_path / DOORS[name].entry)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a\nb.jpg",), "control character"),
        (("\x1b[31m.jpg",), "control character"),
        (("\udcff\udcfe.jpg",), "no UTF-8"),
        (("a.bmp", "a.bmp.png"), "would both become"),
        (("b.png", "B.png"), "would both become"),
        (("x" * 251 + ".bmp",), "longer than 255 bytes"),
    ],
)
def test_names_that_a_run_cannot_keep_are_refused_at_the_start(
    tmp_path: Path, names: tuple[str, ...], message: str
) -> None:
    for name in names:
        Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(tmp_path / "x.png")
        os.rename(tmp_path / "x.png", tmp_path / name)
    with pytest.raises(InputError, match=message):
        FolderRecording(tmp_path)


def test_long_and_foreign_names_are_kept(tmp_path: Path) -> None:
    names = ["x" * 251 + ".png", "Aufnahme\u202f10 ü.png", "コ.png"]
    for name in names:
        write_rgb(tmp_path / name, np.zeros((24, 32, 3), np.uint8))
    source = FolderRecording(tmp_path)
    assert {source.name(0, i) for i in range(3)} == set(names)


def test_what_is_no_picture_makes_no_other_source(tmp_path: Path) -> None:
    make_images(tmp_path)
    before = open_recording(tmp_path, "auto").digest
    for name in (".DS_Store", "Thumbs.db", "._frame_1.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"\0anything")
    assert open_recording(tmp_path, "auto").digest == before
    times = tmp_path / "timestamps.txt"
    times.write_text(times.read_text().replace("0.1", "0.15"))
    assert open_recording(tmp_path, "auto").digest != before


def png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


@pytest.mark.parametrize("junk", [b"", b"no picture", png_claiming(60_000, 60_000), png_claiming(64, 48)[:60]])
@pytest.mark.parametrize("name", ["0.png", "9.png"])
@pytest.mark.parametrize("timed", [True, False])
def test_a_folder_does_without_the_picture_that_cannot_be_read(
    tmp_path: Path, junk: bytes, name: str, timed: bool
) -> None:
    for i in range(1, 5):
        exif = Image.Exif()
        exif[0x0112] = 1
        if timed:
            exif.get_ifd(0x8769)[0x9003] = f"2024:01:02 03:04:{10 * i:02d}"
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / f"{i}.png", exif=exif)
    (tmp_path / name).write_bytes(junk)
    source, warnings = FolderRecording(tmp_path), list[str]()
    frames = list(source.read(warn=warnings.append))
    assert len(frames) == 4
    assert len(warnings) == 1
    assert source.is_timed() is timed
    steps = {round(b.timestamp - a.timestamp, 6) for a, b in itertools.pairwise(frames)}
    assert steps == {10} if timed else all(np.isnan(frame.timestamp) for frame in frames)


@pytest.mark.parametrize("orientation", ["six", b"\xff\xff", 99, 0])
def test_an_orientation_that_is_none_turns_nothing(tmp_path: Path, orientation: Any) -> None:
    for i in range(2):
        picture = Image.fromarray(np.zeros((24, 32, 3), np.uint8))
        picture.save(tmp_path / f"{i}.jpg", exif=exif_with_orientation(orientation))
    source = FolderRecording(tmp_path)
    assert (source.width, source.height) == (32, 24)
    assert len(list(source.read())) == 2
    assert source.original(0) is not None


def exif_with_orientation(value: str | bytes | int) -> bytes:
    """Written by hand: Pillow would put the right type."""
    kind, data = 2, str(value).encode() + b"\0"
    if not isinstance(value, str):
        kind, data = (7, value) if isinstance(value, bytes) else (3, struct.pack("<H", value))
    entry = struct.pack("<HHI", 0x0112, kind, 1 if kind == 3 else len(data)) + data.ljust(4, b"\0")
    return b"Exif\0\0II*\0\x08\0\0\0\x01\0" + entry + bytes(4)
