"""TensorFlow Lite networks behind the same card as ONNX: stand-ins of their contract, and the real files."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_tflite import write_tflite

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb
from msgs_slam.pipelines.config import ProxyConfig
from msgs_slam.pipelines.masks.people import person_probability
from msgs_slam.pipelines.networks.card import Card, read_card
from msgs_slam.pipelines.networks.outputs import network_depth
from msgs_slam.pipelines.networks.registry import ModelStore, missing_networks
from msgs_slam.pipelines.networks.session import Network, card_identity
from msgs_slam.pipelines.proxy.selection import choose_depth, choose_semantics
from msgs_slam.pipelines.types import Intrinsics
from tests.network_labels import network_labels

COLOURS = [[8.0, -4.0, -4.0], [-4.0, 8.0, -4.0], [-4.0, -4.0, 8.0]]
CARD = Card(
    "segmentation", Path(), "image", "scores", 1.0, (0.5,) * 3, (0.5,) * 3, kind="logits",
    classes=("red", "green", "blue"),
)  # fmt: skip


def picture(height: int = 48, width: int = 64) -> np.ndarray:
    """Red on the left, green right of it, blue below."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = image[:, width // 2 :, 1] = 255
    image[height // 2 :] = (0, 0, 255)
    return image


def seen(card: Card, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
    network, image = Network(card, threads, "cpu"), picture()
    output = network.run(image, network.box(64, 48))["output"]
    return network_labels(network, output, 64, 48)


def test_scores_before_the_argmax_are_the_probabilities(tmp_path: Path) -> None:
    file = write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax")
    for output in ("scores", "uint8"):
        ids, probability = seen(replace(CARD, model=file, output=output))
        assert (ids[4:20, 4:28] == 0).all()
        assert (ids[4:20, 36:60] == 1).all()
        assert (ids[30:44, 4:60] == 2).all()
        # Red is (1, -1, -1): scores 16, -8, -7.5; quantised to 1/16 they saturate at 127/16.
        best = 16 if output == "scores" else 127 / 16
        rest = np.exp(-8 - best) + np.exp(-7.5 - best)
        assert probability[10, 10] == pytest.approx(1 / (1 + rest), abs=1e-4)
    best_only, sure = seen(replace(CARD, model=file, output="argmax", kind="argmax"))
    np.testing.assert_array_equal(best_only[4:20, 4:28], 0)
    assert (sure == 1).all()


def test_depth_and_people_come_back_dequantised(tmp_path: Path) -> None:
    depth = write_tflite(tmp_path / "depth.tflite", [[1.0, 0, 0]], [3.0], "uint8")
    card = Card("depth", depth, "image", "uint8", 1.0, (0.5,) * 3, (0.5,) * 3, valid=(0.05, 7.5))
    found = network_depth(Network(card, 1, "cpu"), picture(), Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0))
    assert found.depth[10, 10] == pytest.approx(4.0, abs=1 / 16)  # red 1
    assert found.depth[10, 50] == pytest.approx(2.0, abs=1 / 16)
    person = write_tflite(tmp_path / "person.tflite", [[0, 0, 6.0]], [0.0], "logistic")
    card = Card("person", person, "image", "logistic", 1.0, (0.5,) * 3, (0.5,) * 3)
    likely = person_probability(Network(card, 1, "cpu"), picture())
    assert likely.shape == (48, 64)
    assert likely[40, 10] == pytest.approx(1 / (1 + np.exp(-6)), abs=1e-3)
    assert likely[10, 10] == pytest.approx(1 / (1 + np.exp(6)), abs=1e-3)


def test_litert_says_nothing_and_others_still_can(tmp_path: Path) -> None:
    """LiteRT tells on the process's stderr which delegate it makes, the first time that it does."""
    file = write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax")
    by_itself = (
        f"from ai_edge_litert.interpreter import Interpreter\nInterpreter(model_path={str(file)!r}).allocate_tensors()"
    )
    here = (
        "import os, pathlib\nfrom msgs_slam.pipelines.networks.runtime import TfliteRuntime\n"
        f"TfliteRuntime(pathlib.Path({str(file)!r}), ['scores'], 1)\nos.write(2, b'heard')"
    )
    said = [subprocess.run([sys.executable, "-c", c], capture_output=True, text=True).stderr for c in (by_itself, here)]
    assert "XNNPACK" in said[0], "there is nothing to be silenced any more"
    assert said[1] == "heard"


def test_the_same_bytes_whatever_the_threads(tmp_path: Path) -> None:
    card = replace(CARD, model=write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax"))
    assert seen(card)[1].tobytes() == seen(card, 2)[1].tobytes()
    assert card_identity(card) != card_identity(replace(card, output="uint8"))


def test_a_network_is_read_once_for_its_identity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = replace(CARD, model=write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax"))
    first = card_identity(card)
    with monkeypatch.context() as patch:
        patch.setattr("msgs_slam.pipelines.networks.session.files_sha256", lambda _: pytest.fail("read again"))
        assert card_identity(card) == first
    write_tflite(card.model, COLOURS, [0.5, 0, 0, 0.5], "argmax")
    assert card_identity(card) != first


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"output": "probabilities"}, "no output 'probabilities', only argmax"),
        ({"input": "x"}, "its inputs are image; the card says x"),
        ({"classes": ("red", "green")}, "has 3 channels, the card is for 2 classes"),
        ({"task": "person", "kind": "", "classes": ()}, "has 3 channels, the card is for one plane"),
        ({"size": (512, 512)}, r"takes 24x32, the card says \(512, 512\)"),
        ({"sha256": "0" * 64}, "its sha256 is"),
    ],
)
def test_a_file_that_does_not_fit_its_card_is_refused_when_opened(tmp_path: Path, change: dict, said: str) -> None:
    file = write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax")
    with pytest.raises(InputError, match=said):
        Network(replace(CARD, model=file, **change), 1, "cpu")


def test_what_is_no_tflite_is_refused(tmp_path: Path) -> None:
    whole = write_tflite(tmp_path / "net.tflite", COLOURS, [0, 0, 0.5], "argmax").read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", b"PK\x03\x04 a zip", whole[:40], whole[: len(whole) // 2], b"\0\0\0\0TFL3" + bytes(64)]
    for _ in range(8):
        noisy = bytearray(whole)
        noisy[8:72] = rng.bytes(64)
        damaged.append(bytes(noisy))
    for content in damaged:
        (tmp_path / "bad.tflite").write_bytes(content)
        with pytest.raises(InputError, match=r"[Dd]ownload it again|is empty"):
            Network(replace(CARD, model=tmp_path / "bad.tflite"), 1, "cpu")
    with pytest.raises(InputError, match="no such file"):
        Network(replace(CARD, model=tmp_path / "none.tflite"), 1, "cpu")


def test_auto_takes_the_named_classes_but_never_the_depth_that_is_good_for_metres_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    said = missing_networks()
    assert said is not None
    assert "class names, metric scale, person masks" in said
    assert "msgs-slam models pull" in said
    assert "4 MB)" in said
    assert choose_semantics(ProxyConfig()).kind == "segments"
    store = ModelStore.open()
    metres, names = ("serving_default_input_1:0", "StatefulPartitionedCall:0"), (
        "MobilenetV2/MobilenetV2/input", "logits/semantic/BiasAdd",
    )  # fmt: skip
    depth = write_tflite(tmp_path / "depth.tflite", [[1.0, 0, 0]], [3.0], size=(224, 224), called=metres)
    store.add(depth, "fast-depth", "my-metres")
    labels = write_tflite(tmp_path / "names.tflite", [[0.1, 0, 0]] * 32, [0.0] * 32, "argmax", (512, 512), names)
    store.add(labels, "deeplab-ade20k", "my-names")
    card = choose_semantics(ProxyConfig()).card
    assert card is not None
    assert card.name == "tflite:my-names"
    assert choose_depth(ProxyConfig()).kind == "multiview"
    added = ModelStore.open()
    assert added.first_here("depth") is None
    assert added.first_here("depth", metres_only=True) == added.get("my-metres")
    assert "not installed (person masks;" in str(missing_networks())


# the real files ---------------------------------------------------------------------------------------------------


@pytest.fixture
def store(shared_data: Path, tmp_path: Path) -> ModelStore:
    store = ModelStore.open(tmp_path / "cache")
    assert len(store.take(shared_data / "models", store.with_needed([]))) == 3
    return store


def test_the_real_classes_are_those_of_the_dequantised_copy(shared_data: Path, store: ModelStore) -> None:
    small = Network(store.card(store.get("ade20k-small")), 1, "cpu")
    single = replace(small.card, groups=())
    copy = Network(read_card(shared_data / "models" / "ade20k32.toml"), 1, "cpu")
    agree = []
    for number in (60, 240):
        image = read_rgb(shared_data / "whiteroom" / "rgb" / f"{number:06d}.jpg")
        height, width = image.shape[:2]
        box = small.box(width, height)
        small.card = single
        ours, sure = network_labels(small, small.run(image, box)["output"], width, height)
        theirs, _ = network_labels(copy, copy.run(image, box)["output"], width, height)
        agree.append(float((ours == theirs).mean()))
        assert 0.3 < float(sure[ours >= 0].mean()) < 1
    assert min(agree) > 0.93
    assert single.classes[:5] == ("other", "wall", "building", "sky", "floor")
    assert store.card(store.get("ade20k-small")).labels[:4] == ("other", "wall", "outdoors", "floor")


def test_the_real_metres_are_those_of_the_dequantised_copy(shared_data: Path, store: ModelStore) -> None:
    image = read_rgb(shared_data / "whiteroom" / "rgb" / "000060.jpg")
    camera = Intrinsics(image.shape[1], image.shape[0], 500.0, 500.0, image.shape[1] / 2, image.shape[0] / 2)
    small = network_depth(Network(store.card(store.get("fast-depth")), 1, "cpu"), image, camera).depth
    card = replace(
        read_card(shared_data / "models" / "fastdepth.toml"), white=1.0
    )  # 255 there is a slip: it wants 0..1
    copy = network_depth(Network(card, 1, "cpu"), image, camera).depth
    both = (small > 0) & (copy > 0)
    assert both.mean() > 0.95
    assert np.median(np.abs(small / np.maximum(copy, 1e-6) - 1)[both]) < 0.05
    assert 1 < np.median(small[both]) < 6


def test_the_real_network_sees_the_woman_and_nobody_in_an_empty_room(shared_data: Path, store: ModelStore) -> None:
    network = Network(store.card(store.get("person")), 1, "cpu")
    street = person_probability(network, read_rgb(shared_data / "people" / "0040.jpg")) > 0.5
    room = person_probability(network, read_rgb(shared_data / "whiteroom" / "rgb" / "000060.jpg")) > 0.5
    assert 0.03 < street.mean() < 0.6
    assert room.mean() < 0.01
