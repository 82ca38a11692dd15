"""Every reader of bytes from outside, with a good file for it and a judge of what it lets in.

`make(folder)` writes the good files; `read(path)` reads them as the product does and raises `Nonsense` for what no
reader should have accepted: a value that is not finite, a matrix that is no rotation, an index out of range, a file
outside the folder. A reader may refuse anything with InputError.
"""

import math
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from damage_mutate import Mutator, in_json, in_ply, in_text, in_zip, with_json_head
from layouts import LAYOUTS
from PIL import Image
from pillow_heif import register_heif_opener
from tiny_tflite import write_tflite
from tokenizers import Tokenizer, normalizers, pre_tokenizers, trainers
from tokenizers import models as tokenizer_models

from msgs_slam.formats.colmap import read_colmap_model, write_colmap_model
from msgs_slam.formats.datasets import Camera, Dataset, open_sequence, recognise_source
from msgs_slam.formats.datasets.calibration import read_intrinsics_json
from msgs_slam.formats.datasets.sequence import read_class_table, read_nyu40_classes
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gps import read_track
from msgs_slam.formats.image_folder import (
    list_images,  # fmt: skip
    read_image_times,
)
from msgs_slam.formats.images import (
    exif_time,
    image_size,
    read_depth_png,
    read_grey_png,
    read_header,
    read_label_png,
    read_rgb,
    write_grey_png,
    write_rgb,
)
from msgs_slam.formats.ply import MeshArrays, MeshBlocks, read_mesh_ply, write_mesh_ply
from msgs_slam.formats.poses import read_poses
from msgs_slam.formats.splats import GaussianCloud
from msgs_slam.formats.tensors import load_arrays, load_tensors, save_arrays, save_tensors
from msgs_slam.formats.textfile import read_toml, write_json
from msgs_slam.formats.trajectory import read_matrices, read_tum, write_tum
from msgs_slam.formats.video import VideoReader, probe_video
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.depth.files import read_depth
from msgs_slam.pipelines.evaluation.labels import read_class_map
from msgs_slam.pipelines.frames.masks import open_masks
from msgs_slam.pipelines.networks.card import Card, read_card
from msgs_slam.pipelines.networks.network_pass import ResultCache
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.networks.session import Network
from msgs_slam.pipelines.networks.words import load_linear_head, load_word_head, open_tokenizer, with_words
from msgs_slam.pipelines.source.given import read_intrinsics
from msgs_slam.pipelines.source.recording import open_recording
from tests.clouds import random_cloud
from tests.colmap_models import posed_images
from tests.matrices import random_poses, write_matrices
from tests.networks import save_network

WIDTH, HEIGHT, FRAMES = 64, 48, 4


class Nonsense(AssertionError):
    """A reader accepted what makes no sense."""


@dataclass(frozen=True)
class Door:
    """`entry` is the file that is given to `read`, "" for the folder; `damaged` the one that is damaged, "" for any;
    `mutate` the way, None for one that fits the file's name; `weight` says how many cases it is worth."""

    make: Callable[[Path], Any]
    read: Callable[[Path], Any]
    entry: str = ""
    mutate: Mutator | None = None
    damaged: str = ""
    weight: float = 1.0


def need(holds: Any, what: str) -> None:
    if not holds:
        raise Nonsense(what)


def finite(values: Any, what: str) -> None:
    need(np.isfinite(np.asarray(values, np.float64)).all(), f"{what}: not finite")


# what is let in ---------------------------------------------------------------------------------------------------


def judge_poses(poses: np.ndarray | None) -> None:
    if poses is None:
        return
    known = np.isfinite(poses).all(axis=(1, 2))
    need((known | np.isnan(poses).all(axis=(1, 2))).all(), "a pose known in part")
    turns = poses[known, :3, :3]
    need(np.abs(turns.transpose(0, 2, 1) @ turns - np.eye(3)).max(initial=0) < 1e-6, "no rotation")
    need((np.linalg.det(turns) > 0).all(), "a mirrored rotation")


def judge_camera(camera: Camera | None) -> None:
    if camera is None:
        return
    finite([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion], "camera")
    need(0 < camera.width < 1e5 and 0 < camera.height < 1e5, "size of the camera")
    need(min(camera.fx, camera.fy) > 1e-3 and max(camera.fx, camera.fy) < 1e7, "focal length")


def colmap_model(folder: Path) -> None:
    model = read_colmap_model(folder)
    judge_poses(model.cam_from_world)
    for values in (model.cam_from_world, model.points, model.obs_xy, *(c[3] for c in model.cameras)):
        finite(values, "model")
    need(all(c[1] > 0 and c[2] > 0 for c in model.cameras), "a camera without a size")
    need(len(set(model.names)) == len(model.names), "a name twice")
    need((model.obs_point < len(model.points)).all(), "a point that is not there")


def mesh(read: Callable[[Path], MeshArrays]) -> Callable[[Path], None]:
    return lambda path: finite(read(path).vertices, "vertices")


def tum(path: Path) -> None:
    times, poses = read_tum(path)
    finite(times, "times")
    finite(poses, "poses")
    judge_poses(poses)


def picture(path: Path) -> None:
    read_any(path, read_rgb, image_size, exif_time, lambda p: read_header(p).lens.focal_px(WIDTH, HEIGHT))


def maps(path: Path) -> None:
    read_any(path, read_depth_png, read_label_png, read_grey_png)


def read_any(path: Path, *readers: Callable[[Path], Any]) -> None:
    """All of them, whatever the others say; refused when one refuses."""
    refusals = []
    for read in readers:
        try:
            read(path)
        except InputError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]


def source(path: Path) -> None:
    opened = open_recording(path)
    for frame in opened.read(warn=lambda text: None):
        need(frame.rgb.shape == (opened.height, opened.width, 3), "a frame of another size")
        opened.original(frame.source_index)
        need("\n" not in opened.name(0, frame.source_index), "a line break in a name")
    opened.exif_focal()


def times(folder: Path) -> None:
    found = read_image_times(list_images(folder))
    if found is not None:
        finite(found, "times")
        need((np.diff(found) > 0).all(), "times go back")


def intrinsics(path: Path) -> None:
    camera, scale = read_intrinsics_json(path, integer_centres=False)
    judge_camera(camera)
    need(scale is None or (math.isfinite(scale) and scale > 0), "depth scale")


def data_set(format: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        path = next(path.glob("*.sens"), path)
        recognise_source(path)
        recording = open_sequence(path, format)
        judge_camera(recording.camera)
        judge_camera(recording.depth_camera)
        judge_poses(recording.world_from_cam)
        finite(() if recording.timestamps is None else recording.timestamps, "timestamps")
        need(0 < recording.depth_per_metre < math.inf, "depth scale")
        root = (path if path.is_dir() else path.parent).resolve()
        for file in (*recording.image_paths, *recording.depth_paths, *recording.label_paths):
            need(file is None or os.path.islink(file) or file.resolve().is_relative_to(root), f"outside: {file}")
        read_any(path, *(lambda _, i=i: judge_frame(recording, i) for i in range(min(len(recording), 2))))
        source(path)

    return read


def judge_frame(recording: Dataset, index: int) -> None:
    recording.rgb(index)
    depth = recording.depth(index)
    if depth is not None:
        finite(depth, "depth")
    recording.labels(index)


def masks(folder: Path) -> None:
    opened = open_masks(folder / "masks", open_recording(folder / "rgb"))
    for index in range(2):
        opened.left_out(index, WIDTH, HEIGHT)


def video(path: Path) -> None:
    probe_video(path)
    with VideoReader(path) as reader:
        for _ in zip(range(60), reader, strict=False):
            pass
    finite(reader.timestamps, "timestamps")
    need((np.diff(reader.timestamps) > 0).all(), "times go back")


def network(folder: Path) -> None:
    card = read_card(folder / "card.toml")
    finite([card.white, *card.mean, *card.std, card.canonical_focal], "card")
    opened = Network(card, 1, "cpu")
    opened.run(np.zeros((24, 32, 3), np.uint8), opened.box(32, 24))


def head(path: Path) -> None:
    found = load_linear_head(path, 3)
    finite(found.weight, "weight")
    finite(found.bias, "bias")


def words(path: Path) -> None:
    card = Card("segmentation", path, "x", "y", kind="features", text=path, background=())
    finite(load_word_head(with_words(card, "a lamp, sofa"), 1, "cpu").weight, "weight")


def tokens(path: Path) -> None:
    tokenizer = open_tokenizer(path)
    for text in ("a photo of a lamp.", "", "\u00e9\ud7ff sofa"):
        need(all(i >= 0 for i in tokenizer.encode(text).ids), "a token below 0")


def store(folder: Path) -> None:
    opened = ModelStore.open(folder)
    opened.verify()
    opened.first_here("depth")
    for model in opened.models:
        need(opened.path(model).resolve().is_relative_to(folder.resolve()), f"outside: {model.name}")


def kept_result(folder: Path) -> None:
    found = ResultCache(folder, 1).load("k")
    need(found is None or (set(found) == {"depth"} and (found["depth"] == 1).all()), "another result")


# good files -------------------------------------------------------------------------------------------------------


@cache
def _rng() -> np.random.Generator:
    return np.random.default_rng(1)


def _cloud() -> GaussianCloud:
    probs = np.random.default_rng(3).dirichlet(np.ones(3), 20).astype(np.float32)
    return replace(random_cloud(20), class_ids=probs.argmax(1).astype(np.uint8), class_probs=probs)


def _mesh() -> MeshBlocks:
    g = np.random.default_rng(4)
    vertices, faces = g.normal(size=(8, 3)).astype(np.float32), g.integers(0, 8, (12, 3)).astype(np.int32)
    colors = g.integers(0, 255, (8, 3)).astype(np.uint8)
    return MeshBlocks(8, 12, lambda: [(vertices, colors, np.arange(8).astype(np.uint8))], lambda: [faces])


def _rgb(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)


def make_colmap(suffix: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        names, points = [f"im{i}.png" for i in range(FRAMES)], 12
        image, point = np.repeat(np.arange(FRAMES), points), np.tile(np.arange(points), FRAMES)
        xyz, rgb = _rng().normal(size=(points, 3)), _rng().integers(0, 255, (points, 3)).astype(np.uint8)
        xy = _rng().random((FRAMES * points, 2)) * 48
        model = posed_images(names, random_poses(FRAMES, 2), WIDTH, HEIGHT, 50.0, 51.0, 32.0, 24.0)
        seen = {"points": xyz, "colors": rgb, "obs_image": image, "obs_point": point, "obs_xy": xy}
        write_colmap_model(folder, replace(model, **seen))
        for other in (p for p in folder.iterdir() if p.suffix != suffix):
            other.unlink()

    return make


register_heif_opener()  # to write HEIC, which the program only reads


def make_picture(name: str, **options: Any) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        exif = Image.Exif()
        exif[0x0112] = 6
        ifd = exif.get_ifd(0x8769)
        ifd[0xA405], ifd[0x9003], ifd[0x920A] = 28, "2024:01:02 03:04:05", (28, 10)
        Image.fromarray(_rgb(width=32, height=24)).save(folder / name, exif=exif, **options)

    return make


def make_truth(folder: Path) -> None:
    """A plain folder with everything that can lie in one."""
    for i in range(FRAMES):
        write_rgb(folder / "rgb" / f"{i:06d}.png", _rgb(i))
        raw = np.random.default_rng(i).integers(0, 5000, (HEIGHT, WIDTH)).astype(np.uint16)
        write_grey_png(folder / "depth" / f"{i:06d}.png", raw)
        write_grey_png(folder / "labels" / f"{i:06d}.png", (raw % 3).astype(np.uint8))
    write_json(folder / "classes.json", {"classes": [{"id": i, "name": f"c{i}"} for i in range(3)]})
    make_intrinsics(folder)
    write_matrices(folder / "traj.txt", random_poses(FRAMES, 2))
    (folder / "timestamps.txt").write_text("".join(f"{i * 0.1}\n" for i in range(FRAMES)))


def make_intrinsics(folder: Path) -> None:
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 50.5, "fy": 50.0, "cx": 31.5, "cy": 23.5, "k1": 0.1, "depth_scale": 1000.0}
    write_json(folder / "intrinsics.json", {"camera": camera})


def make_layout(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        truth = folder.with_name(folder.name + "_truth")
        make_truth(truth)
        made = folder.with_name(folder.name + "_made")
        written = LAYOUTS[name][0](open_sequence(truth, "folder"), made)
        shutil.rmtree(truth)
        if written.is_file():
            shutil.copy(written, folder / "room.sens")
        else:
            shutil.copytree(written, folder, dirs_exist_ok=True)
        shutil.rmtree(made, ignore_errors=True)
        written.unlink(missing_ok=True) if written.is_file() else None

    return make


def make_images(folder: Path) -> None:
    for i in range(FRAMES):
        write_rgb(folder / f"frame_{i}.{'jpg' if i else 'png'}", _rgb(i))
    (folder / "timestamps.txt").write_text(
        "".join(f"{i * 0.1} frame_{i}.{'jpg' if i else 'png'}\n" for i in range(FRAMES))
    )


def make_masks(folder: Path) -> None:
    for i in range(2):
        write_rgb(folder / "rgb" / f"{i}.jpg", _rgb(i))
        write_grey_png(folder / "masks" / f"{i}.png", np.full((HEIGHT, WIDTH), 255 * i, np.uint8))


def make_video(name: str, codec: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        if codec:
            writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*codec), 10, (WIDTH, HEIGHT))
            for i in range(6):
                writer.write(_rgb(i))
            writer.release()
        else:
            write_video(folder / name, [_rgb(i) for i in range(6)], 10)

    return make


CARD = """task = "{task}"
model = "{model}"
input = "image"
output = "scores"
white = 1.0
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]
size = [24, 32]
{rest}
"""


def make_onnx(folder: Path) -> None:
    ports = "float[1, 3, 24, 32] image", "float[1, 1, 24, 32] scores"
    save_network(folder / "net.onnx", *ports, "scores = Conv (image, w)", w=np.full((1, 3, 1, 1), 0.3))
    rest = "canonical_focal = 1000.0\nvalid = [0.1, 200.0]"
    (folder / "card.toml").write_text(CARD.format(task="depth", model="net.onnx", rest=rest))


def make_tflite(folder: Path) -> None:
    write_tflite(folder / "net.tflite", [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [0.0, 0.1, 0.2])
    rest = 'kind = "logits"\nclasses = ["a", "b", "c"]'
    (folder / "card.toml").write_text(CARD.format(task="segmentation", model="net.tflite", rest=rest))


def make_head(folder: Path) -> None:
    shapes = {"bn.weight": (4,), "bn.bias": (4,), "bn.running_mean": (4,), "bn.running_var": (4,)}
    shapes |= {"conv_seg.weight": (3, 4, 1, 1), "conv_seg.bias": (3,)}
    torch.save({"state_dict": {f"decode_head.{k}": torch.ones(s) for k, s in shapes.items()}}, folder / "h.pth")


def make_tokenizer(folder: Path) -> None:
    """Byte-level BPE with CLIP's normaliser and end of words, which knows a few words."""
    tokenizer = Tokenizer(tokenizer_models.BPE(unk_token="?", end_of_word_suffix="</w>"))
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    trainer = trainers.BpeTrainer(special_tokens=["?"], end_of_word_suffix="</w>", vocab_size=120, show_progress=False)
    tokenizer.train_from_iterator(["a photo of a lamp and a sofa, a lamp"], trainer)
    tokenizer.save(str(folder / "tokenizer.json"))


def make_store(folder: Path) -> None:
    row = {"name": "mine", "family": "moge", "bytes": 3, "sha256": "ab", "licence": "own", "commercial": False}
    write_json(folder / "own.json", {"pinned": {"dinov2-vits14-ade20k": "00"}, "added": [row]})


def text(name: str, content: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(content)


def given_poses(path: Path) -> None:
    found = read_poses(path)
    judge_poses(found.world_from_cam)
    need(len(found.names) in (0, len(found)), "names of other poses")
    if found.times is not None:
        finite(found.times, "times")


def track(path: Path) -> None:
    found = read_track(path)
    finite(found.times, "times")
    need((np.diff(found.times) > 0).all(), "times go back")
    finite(found.degrees, "degrees")
    need((np.abs(found.degrees) <= [90, 180]).all(), "a place outside of the Earth")


HEADINGS = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
ODOMETRY = HEADINGS + "".join(f"{i}, {i:06d}, {i}, 0, 1, 0, 0, 0, 1\n" for i in range(5))
NAMED = "".join(f"IMG {i}.jpg;{i};0;1;0;0;0;1\n" for i in range(5))
IDENTITY = " ".join(map(str, np.eye(4).ravel()))
CAMERAS_XML = (
    "<document><chunk><sensors><sensor><calibration type='frame'><resolution width='640' height='480'/>"
    "<f>500</f><cx>1</cx><k1>-0.1</k1></calibration></sensor></sensors><cameras>"
    + "".join(f"<camera label='{i}'><transform>{IDENTITY}</transform></camera>" for i in range(4))
    + "</cameras></chunk></document>"
)
SHOTS = {f"{i}.jpg": {"rotation": [0, 0.1, i], "translation": [i, 0, 1]} for i in range(4)}
OPENCV_XML = (
    '<?xml version="1.0"?><opencv_storage><image_width>640</image_width><image_height>480</image_height>'
    '<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
    "<data>500 0 320 0 501 240 0 0 1</data></camera_matrix>"
    '<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>'
    "<data>-0.1 0.01 0 0 0</data></distortion_coefficients></opencv_storage>"
)
SUBTITLES = "".join(
    f"{i}\n00:00:0{i},000 --> 00:00:0{i},900\n[latitude: 48.{i}] [longitude: 11.{i}] [rel_alt: 1 abs_alt: 5{i}]\n\n"
    for i in range(5)
)
GEO = "EPSG:4326\n" + "".join(f"{i}.jpg 11.{i} 48.{i} 50{i}\n" for i in range(5))

ARRAYS = {"a": np.arange(20.0), "b": np.ones((3, 4), np.uint8), "s": np.array(["x", ""])}
NYU = "id\traw_category\tnyu40id\tnyu40class\n1\twall\t1\twall\n2\tchair\t5\tchair\n22\tx\t0\tunannotated\n"
CLASS_MAP = 'truth = ["wall", "couch"]\n[classes]\nwall = "wall"\nsofa = ["couch", "wall"]\n'
JSON_HEAD = with_json_head(0)

DOORS: dict[str, Door] = {
    "COLMAP, binary": Door(make_colmap(".bin"), colmap_model, weight=2),
    "COLMAP, text": Door(make_colmap(".txt"), colmap_model, weight=2),
    "class map": Door(text("a.toml", CLASS_MAP), read_class_map, "a.toml"),
    "masks": Door(make_masks, masks, damaged="0.png"),
    "mesh PLY": Door(lambda f: write_mesh_ply(f / "a.ply", _mesh()), mesh(read_mesh_ply), "a.ply", in_ply),
    "npz": Door(lambda f: save_arrays(f / "a.npz", ARRAYS), load_arrays, "a.npz"),
    "safetensors": Door(
        lambda f: save_tensors(f / "a.safetensors", {"a": torch.zeros(3, 4)}),
        load_tensors, "a.safetensors", JSON_HEAD,
    ),
    "TUM trajectory": Door(
        lambda f: write_tum(f / "a.txt", np.arange(float(FRAMES)), random_poses(FRAMES, 2)), tum, "a.txt"
    ),
    "matrices": Door(
        lambda f: write_matrices(f / "a.txt", random_poses(FRAMES, 2)), lambda p: judge_poses(read_matrices(p)), "a.txt"
    ),
    "poses, odometry.csv": Door(text("odometry.csv", ODOMETRY), given_poses, "odometry.csv", in_text),
    "poses, table of names": Door(text("a.csv", "name;x;y;z;qx;qy;qz;qw\n" + NAMED), given_poses, "a.csv", in_text),
    "poses, Metashape": Door(text("a.xml", CAMERAS_XML), given_poses, "a.xml", in_text),
    "poses, OpenDroneMap": Door(lambda f: write_json(f / "a.json", [{"shots": SHOTS}]), given_poses, "a.json", in_json),
    "poses, COLMAP": Door(make_colmap(".txt"), given_poses),
    "track, subtitles": Door(text("a.srt", SUBTITLES), track, "a.srt", in_text),
    "track, geo.txt": Door(text("geo.txt", GEO), track, "geo.txt", in_text),
    "track, table": Door(text("a.csv", "time,lat,lon\n0,1,2\n1,1,2\n2,1,2\n3,1,2\n"), track, "a.csv", in_text),
    **{
        f"picture {name.split('.')[1]}": Door(make_picture(name), picture, name)
        for name in ("a.jpg", "a.png", "a.tif", "a.webp", "a.heic")
    },
    "bmp": Door(lambda f: Image.fromarray(_rgb()).save(f / "a.bmp"), picture, "a.bmp"),
    "16 bit PNG": Door(lambda f: write_grey_png(f / "a.png", np.ones((24, 32), np.uint16)), maps, "a.png"),
    "palette PNG": Door(lambda f: Image.fromarray(_rgb()).quantize(8).save(f / "a.png"), read_label_png, "a.png"),
    "folder of images": Door(make_images, source),
    "times of images": Door(make_images, times, damaged="timestamps.txt"),
    "intrinsics": Door(make_intrinsics, intrinsics, "intrinsics.json", weight=2),
    "--intrinsics JSON": Door(
        make_intrinsics, lambda p: judge_camera(read_intrinsics(str(p), 640, 480)), "intrinsics.json"
    ),
    "--intrinsics text": Door(
        text("cameras.txt", "# camera\n1 OPENCV 640 480 500 501 320 240 .1 .01 0 0\n"),
        lambda p: judge_camera(read_intrinsics(str(p), 640, 480)), "cameras.txt", in_text,
    ),
    "--intrinsics YAML": Door(
        text("ros.yaml", "camera_matrix:\n  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n"),
        lambda p: judge_camera(read_intrinsics(str(p), 640, 480)), "ros.yaml", in_text,
    ),
    "--intrinsics, OpenCV's XML": Door(
        text("a.xml", OPENCV_XML), lambda p: judge_camera(read_intrinsics(str(p), 640, 480)), "a.xml", in_text,
    ),
    "class table, JSON": Door(make_truth, read_class_table, "classes.json", in_json, "classes.json"),
    "class table, text": Door(text("labels.txt", "0 wall x\n1 sofa\n2 floor\n"), read_class_table, "labels.txt"),
    "ScanNet's label table": Door(text("t.tsv", NYU), read_nyu40_classes, "t.tsv"),
    "data set folder": Door(make_truth, data_set("folder"), weight=2),
    **{f"data set {name}": Door(make_layout(name), data_set(row[1]), weight=2) for name, row in LAYOUTS.items()},
    "TOML": Door(text("a.toml", "[run]\nseed = 1\nname = 'x'\n[frames]\nrate = 2.5\n"), read_toml, "a.toml"),
    "card": Door(make_onnx, network, damaged="card.toml", weight=2),
    "ONNX": Door(make_onnx, network, damaged="net.onnx", weight=2),
    "TFLite": Door(make_tflite, network, damaged="net.tflite", weight=2),
    "head": Door(make_head, head, "h.pth"),
    "table of words": Door(
        lambda f: save_arrays(f / "w.npz", {"words": np.array(["sofa", "a lamp"]), "embeddings": np.eye(2)}),
        words,
        "w.npz",
    ),
    "tokenizer": Door(make_tokenizer, tokens, "tokenizer.json"),
    "model store": Door(make_store, store, damaged="own.json"),
    "kept network result": Door(
        lambda f: ResultCache(f, 1).save("k", {"depth": np.ones((6, 8))}), kept_result, mutate=in_zip
    ),
    "depth npy": Door(
        lambda f: np.save(f / "a.npy", np.ones((6, 8), np.float32)), lambda p: read_depth(p, 0.001), "a.npy"
    ),
    "video mp4": Door(make_video("a.mp4", ""), video, "a.mp4"),
    "video avi": Door(make_video("a.avi", "MJPG"), video, "a.avi"),
    "video mkv": Door(make_video("a.mkv", ""), video, "a.mkv"),
    "video as a source": Door(make_video("a.mp4", ""), source, "a.mp4"),
}  # fmt: skip
