"""A network in, names in the world out: a stand-in of the contract in the made room, the real file in a real one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from proxy_room import Room
from skimage.color import deltaE_ciede2000, rgb2lab
from test_proxy_names import depth_of
from tiny_tflite import write_tflite

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.images import read_depth_png, read_rgb
from msgs_slam.pipelines.evaluation.labels import count_labels, match_classes, score
from msgs_slam.pipelines.geometry.camera import resample_nearest
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.labels.learned import OnnxLabels
from msgs_slam.pipelines.networks.card import Card
from msgs_slam.pipelines.networks.network_pass import ResultCache, Workplace
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.networks.session import Network
from msgs_slam.pipelines.providers import _COMMON, DepthEstimate, class_colors
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Calibration, Frame, Intrinsics
from tests.network_labels import network_labels
from tests.world.room import CLASSES

KINDS = ("wall", "floor", "furniture")
COLOURS = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255)], np.uint8)


CONES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
)
"""Linear RGB as seen with all cones, and without the long, middle and short ones (Machado et al. 2009)."""


def provider(card: Card, sequence: Sequence, folder: Path, no_people: bool = False) -> OnnxLabels:
    folder.mkdir()
    cache = ResultCache(folder / "cache", 0)
    return OnnxLabels(card, Workplace(sequence, lambda: folder, 1, "cpu", SilentProgress(), cache), 16, no_people)


def alone(card: Card, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    network = Network(card, 1, "cpu")
    height, width = image.shape[:2]
    output = network.run(image, network.box(width, height))["output"]
    ids = network_labels(network, output, width, height)[0]
    return np.where(ids < 0, VOID, ids).astype(np.uint8)


def in_order_of(names: tuple[str, ...], provider: OnnxLabels, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The provider's labels as indices into `names`."""
    places = [names.index(n) if n in names else VOID for n in provider.classes().names]
    return np.array(places + [VOID] * (256 - len(places)), np.uint8)[labels]


def painted(room: Room, kinds: NDArray[np.uint8], seed: int) -> dict[int, NDArray[np.uint8]]:
    """The frames in the colours that the stand-in knows, with forty mistakes that are others in every frame."""
    out = {}
    for frame in room.frames:
        image = COLOURS[kinds[room.views[frame.id].labels]]
        rng = np.random.default_rng([seed, frame.id])
        for x, y, kind in zip(*(rng.integers(0, n, 40) for n in (240, 180, 3)), strict=True):
            image[y : y + 16, x : x + 16] = COLOURS[kind]
        out[frame.id] = image
    return out


def test_frames_of_a_stand_in_name_the_made_room_together(room: Room, tmp_path: Path) -> None:
    kinds = np.array([KINDS.index(n) if n in KINDS else 2 for n, _ in CLASSES] + [2] * 256, np.uint8)[:256]
    pictures = painted(room, kinds, 0)
    weight = [[8.0, -4.0, -4.0], [-4.0, 8.0, -4.0], [-4.0, -4.0, 8.0]]
    file = write_tflite(tmp_path / "net.tflite", weight, [0, 0, 0], "argmax", (96, 128))
    card = Card("segmentation", file, "image", "scores", 1.0, (0.5,) * 3, (0.5,) * 3, kind="logits", classes=KINDS)
    sequence = replace(room.sequence(), read_image=lambda frame: pictures[frame.id])
    found = provider(card, sequence, tmp_path / "work")
    found.fit(room.frames, lambda f: depth_of(room, f))
    confusion = np.zeros((2, 3, 4), np.int64)
    for frame in room.frames:
        shown = in_order_of(KINDS, found, found.estimate(frame, depth_of(room, frame)).labels)
        for total, labels in zip(confusion, (alone(card, pictures[frame.id]), shown), strict=True):
            total += count_labels(labels, kinds[room.views[frame.id].labels], 3, 3)
    single, together = (score(c) for c in confusion)
    assert single is not None
    assert together is not None
    assert 0.5 < single.mean_iou + 0.1 < together.mean_iou < 0.999


def test_nothing_is_called_a_person_where_people_are_left_out(room: Room, tmp_path: Path) -> None:
    weight = [[8.0, -4.0, -4.0], [-4.0, 8.0, -4.0], [-4.0, -4.0, 8.0]]
    file = write_tflite(tmp_path / "net.tflite", weight, [0, 0, 0], "argmax", (96, 128))
    card = Card(
        "segmentation", file, "image", "scores", 1.0, (0.5,) * 3, (0.5,) * 3, kind="logits",
        classes=("wall", "floor", "person"),
    )  # fmt: skip
    picture = np.full((192, 256, 3), COLOURS[2], np.uint8)
    picture[:64] = COLOURS[0]
    sequence = replace(room.sequence(), read_image=lambda frame: picture)
    for no_people in (False, True):
        found = provider(card, sequence, tmp_path / f"work {no_people}", no_people)
        found.fit(room.frames, lambda f: depth_of(room, f))
        assert "person" in found.figures()["vocabulary"]
        assert len(found.classes()) > 1
        assert ("person" in found.classes().names) != no_people


def test_a_name_has_one_colour_that_all_eyes_tell_apart() -> None:
    common = tuple(alike.split()[0] for alike in _COMMON.values())
    colors = np.array(class_colors((*common, "object 1", "object 2", "other")), float) / 255
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    for eye in CONES:
        seen = (linear @ np.array(eye).T).clip(0, 1)
        lab = rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))
        apart = deltaE_ciede2000(lab[:, None], lab[None])[: len(common)]
        assert apart[apart > 1e-9].min() > 10
    # By the name alone, whatever stands beside it; what has none is grey, and numbered classes are not
    assert class_colors(["Coffee_table ", "wall"])[0] == class_colors(["coffee table"])[0]
    assert all(len(set(color)) == 1 for color in class_colors(["object 1", "object 14", "other", "unknown"]))
    many = class_colors(alike for line in _COMMON.values() for alike in line.split())
    assert len(set(many)) == len(many)
    assert all(len(set(color)) > 1 for color in (*many, *class_colors(["class 3", "cluster 1", "zebra crossing"])))


def test_frames_of_the_real_network_name_a_room_better_together(shared_data: Path, tmp_path: Path) -> None:
    """Ten views of a rendered room, half a second apart, at their true poses and depths."""
    room, numbers = shared_data / "whiteroom", list(range(0, 150, 15))
    store = ModelStore.open(tmp_path / "cache")
    store.take(shared_data / "models", [store.get("ade20k-small")])
    card = store.card(store.get("ade20k-small"))
    camera = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0)
    frames = [Frame(i, f"{n:06d}.jpg", n / 30, n, 1.0) for i, n in enumerate(numbers)]
    poses = np.linalg.inv(np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)[numbers])
    nothing = np.zeros(0, np.int64)
    model = SparseModel(
        np.arange(len(frames)), poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), nothing, nothing, np.zeros((0, 2))
    )
    sequence = Sequence(
        frames, Calibration(camera, "given", 0.0, (0.0,) * 4), camera.at_most(320), model,
        lambda f: read_rgb(room / "rgb" / f.name),
    )  # fmt: skip

    def depth(frame: Frame) -> DepthEstimate:
        metres = read_depth_png(room / "depth" / f"{frame.source_index:06d}.png").astype(np.float32) / 1000
        small = resample_nearest(metres, 240, 320)
        return DepthEstimate(small, (small > 0).astype(np.float32) * 0.8)

    found = provider(card, sequence, tmp_path / "work")
    found.fit(frames, depth)
    truth = open_sequence(room)
    names = tuple(dict.fromkeys((*card.labels, *found.classes().names)))
    matching = match_classes(names, card.labels, truth.class_names, None)
    assert matching is not None
    confusion = np.zeros((2, len(truth.class_names), len(names) + 1), np.int64)
    by_number = {int(Path(name).stem): i for i, name in enumerate(truth.names)}
    for frame in frames:
        labels = truth.labels(by_number[frame.source_index])
        if labels is None:
            continue
        shown = in_order_of(names, found, found.estimate(frame, depth(frame)).labels)
        single = alone(card, sequence.image(frame))
        for total, seen in zip(confusion, (single, shown), strict=True):
            total += count_labels(seen, resample_nearest(labels, 240, 320), len(names), len(truth.class_names))
    scores = [score(matching.joined(c)) for c in confusion]
    assert all(s is not None for s in scores)
    assert scores[0].mean_iou + 0.05 < scores[1].mean_iou < 0.99
