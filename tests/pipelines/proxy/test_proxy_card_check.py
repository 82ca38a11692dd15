"""`models check`: networks of the known graphs with made weights, under right cards and under each usual mistake."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from test_proxy_networks import linear_head, stand_in, write_card

from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.evaluation.demo import known_view
from msgs_slam.pipelines.networks.check import KnownView, check_network
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.system.wording import BAD, GOOD, NOTE
from tests.networks import PICTURE, save_network

IMAGENET = {"white": 1.0, "mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
RAW: dict[str, Any] = {"white": 255.0}
UNIT: dict[str, Any] = {"white": 1.0}
SIGNED = {"white": 1.0, "mean": [0.5] * 3, "std": [0.5] * 3}


@pytest.fixture(scope="module")
def view() -> KnownView:
    return known_view()


def states(card: Any, view: KnownView) -> dict[str, tuple[str, str]]:
    """Finding → (state, text and fix)."""
    return {f.name: (f.state, f"{f.text} -> {f.fix}") for f in check_network(card, view)}


def remembering(
    path: Path, view: KnownView, answer: NDArray[np.float64], wants: dict[str, Any], fill: float = 9.0, **more: NDArray
) -> None:
    """A network that knows the built-in image by heart: where the values that it is fed are those of `wants`, it gives
    `answer` (channels, h, w), and what lies off that by how far they are off."""
    std = np.array(wants.get("std", [1.0] * 3), np.float32).reshape(3, 1, 1)
    mean = np.array(wants.get("mean", [0.0] * 3), np.float32).reshape(3, 1, 1)
    seen = (view.image.transpose(2, 0, 1) / 255 * wants["white"] - mean) / std
    size = ", ".join(map(str, view.depth.shape))
    extra = [f"float[{str(v.shape)[1:-1]}] {k}_out" for k, v in more.items()]
    save_network(
        path, f"float[1, 3, {size}] x",
        ", ".join([f"float[1, {len(answer)}, {size}] y", *extra]),
        "apart = Sub (x, seen)",
        "off = Abs (apart)",
        "share = Div (off, unit)",
        "how = ReduceMean <axes = [1]> (share)",
        "wrong = Mul (how, fill)",
        "y = Add (answer, wrong)",
        *(f"{name}_out = Identity ({name})" for name in more),
        seen=seen[None], unit=255.0 if wants["white"] == 255 else 1.0, answer=answer[None], fill=fill, **more,
    )  # fmt: skip


def depth_card(folder: Path, view: KnownView, answer: NDArray, wants: dict[str, Any], **card: Any) -> Any:
    remembering(folder / "net.onnx", view, answer[None], wants, **card.pop("more", {}))
    keys = {"task": "depth", "model": "net.onnx", "input": "x", "output": "y", "size": list(view.depth.shape)}
    return write_card(folder / "card.toml", **keys, **card)


def canonical(view: KnownView) -> NDArray[np.float64]:
    return view.depth * 1000 / view.camera.fx


def test_the_built_in_image_is_a_room_with_depth_and_names(view: KnownView) -> None:
    assert view.image.shape == (*view.depth.shape, 3)
    assert 0.5 < view.depth.min() < view.depth.max() < 10
    assert {"wall", "floor"} <= {view.names[i] for i in np.unique(view.labels)}


@pytest.mark.parametrize("wants", [RAW, UNIT, IMAGENET, SIGNED], ids=["raw", "unit", "imagenet", "signed"])
@pytest.mark.parametrize("given", [RAW, UNIT, IMAGENET, SIGNED], ids=["raw", "unit", "imagenet", "signed"])
def test_another_range_than_the_network_wants_is_said(
    tmp_path: Path, view: KnownView, wants: dict[str, Any], given: dict[str, Any]
) -> None:
    """Among them the trap of normalised values for a network that normalises in its graph, which fails in silence."""
    found = states(depth_card(tmp_path, view, canonical(view), wants, canonical_focal=1000.0, **given), view)
    if wants == given:
        assert {state for state, _ in found.values()} == {GOOD}, found
        assert "units" in found
        return
    state, text = found["range"]
    assert state == BAD
    assert text.count("0..255") == (RAW in (wants, given))
    assert ("normalise its input itself" in text) == (wants is RAW)
    assert "units" not in found, "follows from the range"


@pytest.mark.parametrize(
    ("factor", "card", "said"),
    [
        (1.0, {"canonical_focal": 0.0}, "say `canonical_focal = 1000`"),
        (0.272, {"canonical_focal": 1000.0}, "say `canonical_focal = 0`"),
        (272.0, {"canonical_focal": 0.0}, "millimetres"),
        (0.272 * 2.1, {"canonical_focal": 0.0}, ""),
    ],
    ids=["canonical", "metres", "millimetres", "merely bad"],
)
def test_depth_in_another_unit_is_said(
    tmp_path: Path, view: KnownView, factor: float, card: dict[str, Any], said: str
) -> None:
    answer = canonical(view) * factor
    state, text = states(depth_card(tmp_path, view, answer, RAW, more={"fill": 9 * factor}, **card), view)["units"]
    assert said in text
    assert state == (BAD if said else NOTE)


def test_relative_depth_is_told_from_inverse(tmp_path: Path, view: KnownView) -> None:
    inverse = 3 / view.depth + 0.4
    assert states(depth_card(tmp_path, view, inverse, RAW, relative="inverse"), view)["units"][0] == GOOD
    wrong = states(depth_card(tmp_path, view, inverse, RAW), view)["units"]
    assert wrong[0] == BAD
    assert 'relative = "inverse"' in wrong[1]
    turned = check_network(depth_card(tmp_path, view, view.depth, RAW, relative="inverse"), view)
    assert any(f.state == BAD and "larger values" in f.text for f in turned)


def test_values_and_extra_outputs_out_of_their_range_are_said(tmp_path: Path, view: KnownView) -> None:
    shape = view.depth.shape
    normals = np.zeros((1, 3, *shape))
    normals[:, 2] = -2
    more = {"more": {"normal": normals, "conf": np.full((1, *shape), 3.0)}}
    found = states(depth_card(tmp_path, view, canonical(view), RAW, canonical_focal=1000.0, normals="normal_out",
                              confidence="conf_out", **more), view)  # fmt: skip
    assert found["normals"][0] == NOTE
    assert "2.00 long" in found["normals"][1]
    assert found["confidence"][0] == BAD
    assert "3 to 3" in found["confidence"][1]
    stops = states(depth_card(tmp_path, view, canonical(view), RAW, valid=[50.0, 100.0]), view)
    assert stops["values"] == (BAD, stops["values"][1])
    assert "`valid`" in stops["values"][1]
    missing = states(depth_card(tmp_path, view, canonical(view), RAW, confidence="sure"), view)
    assert missing.keys() == {"contract"}
    assert "no output 'sure'" in missing["contract"][1]


def transformer(path: Path, before: int, width: int = 8) -> None:
    """A DINOv2-like graph: patches of 14 by one convolution, `before` tokens in front of them, and tokens that know
    of each other."""
    rng = np.random.default_rng(0)
    save_network(
        path, PICTURE, f"float[1, N, {width}] y",
        "maps = Conv <strides = [14, 14]> (x, kernel)",
        "flat = Reshape (maps, shape)",
        "patches = Transpose <perm = [0, 2, 1]> (flat)",
        "mean = ReduceMean <axes = [1]> (patches)",
        "told = Add (patches, mean)",
        "y = Concat <axis = 1> (first, told)",
        kernel=rng.normal(size=(width, 3, 14, 14)), shape=[1, width, -1], first=rng.normal(size=(1, before, width)),
    )  # fmt: skip


def token_card(folder: Path, before: int, head: bool = False, **card: Any) -> Any:
    transformer(folder / "net.onnx", before)
    keys: dict[str, Any] = {"task": "segmentation", "model": "net.onnx", "input": "x", "output": "y", "kind": "tokens"}
    if head:
        linear_head(folder / "head.pth", 3, 8)
        keys |= {"head": "head.pth", "classes": ["wall", "floor", "table"]}
    return write_card(folder / "card.toml", **keys, **({"multiple": 14, "pixels": 40_000} | IMAGENET | card))


def test_tokens_are_those_of_the_patches(tmp_path: Path, view: KnownView) -> None:
    assert "a class token" in states(token_card(tmp_path, 1), view)["tokens"][1]
    registers = states(token_card(tmp_path, 5), view)["tokens"]
    assert registers[0] == GOOD
    assert "4 registers" in registers[1]
    assert states(token_card(tmp_path, 1, head=True), view)["tokens"][0] == GOOD
    other = states(token_card(tmp_path, 5, head=True), view)["tokens"]
    assert other[0] == BAD
    assert "without registers" in other[1]
    wrong = states(token_card(tmp_path, 1, multiple=28), view)["tokens"]
    assert wrong[0] == BAD
    assert "`multiple = 14`" in wrong[1]


def test_sides_that_are_no_multiple_of_the_patch_are_said(tmp_path: Path, view: KnownView) -> None:
    lost = states(token_card(tmp_path, 1, multiple=1, size=[230, 308]), view)["input"]
    assert lost[0] == BAD
    assert "last row has no influence" in lost[1]
    assert "`multiple`" in lost[1]
    assert states(token_card(tmp_path, 1), view)["input"][0] == GOOD
    stand_in(tmp_path / "net.onnx", "community", 1.0)
    keys = {"task": "depth", "model": "net.onnx", "input": "x", "output": "predicted_depth", "white": 255.0}
    short = states(write_card(tmp_path / "card.toml", **keys, size=[518, 518]), view)["input"]
    assert short[0] == NOTE
    assert "516 and 516" in short[1]
    assert "28" in short[1]
    assert states(write_card(tmp_path / "card.toml", **keys, multiple=28), view)["input"][0] == GOOD


def classes_card(folder: Path, view: KnownView, answer: NDArray, names: list[str], **card: Any) -> Any:
    remembering(folder / "net.onnx", view, answer, RAW)
    keys = {"task": "segmentation", "model": "net.onnx", "input": "x", "output": "y", "classes": names}
    return write_card(folder / "card.toml", **keys, **card)


def test_scores_of_classes_are_what_the_card_calls_them(tmp_path: Path, view: KnownView) -> None:
    names = list(view.names)
    shares = (view.labels == np.arange(len(names))[:, None, None]) * 1.0
    right = states(classes_card(tmp_path, view, 5 * shares, names, kind="logits"), view)
    assert right["values"][0] == right["range"][0] == GOOD
    for answer, said, seen in ((5 * shares, "probabilities", "logits"), (shares, "logits", "probabilities")):
        found = states(classes_card(tmp_path, view, answer, names, kind=said), view)["values"]
        assert found[0] == BAD
        assert f'kind = "{seen}"' in found[1]
    ids = states(classes_card(tmp_path, view, view.labels[None] * 1.0, names[:5], kind="argmax"), view)["values"]
    assert ids[0] == BAD
    assert "the card has 5 classes" in ids[1]
    turned = states(classes_card(tmp_path, view, 5 * shares[::-1], names, kind="logits"), view)["range"]
    assert turned[0] == NOTE, "names in another order"


def test_a_person_is_a_probability(tmp_path: Path, view: KnownView) -> None:
    remembering(tmp_path / "net.onnx", view, np.full((1, *view.depth.shape), -4.0), UNIT)
    card = write_card(tmp_path / "card.toml", task="person", model="net.onnx", input="x", output="y", white=1.0)
    assert "sigmoid" in states(card, view)["values"][1]


def check(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["models", "check", *map(str, words)])
    return done.exit_code, done.stdout + done.stderr


def test_the_command_checks_cards_and_what_is_installed(
    tmp_path: Path, view: KnownView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    assert check() == (1, f"Error: no network with a card is in {tmp_path / 'cache'}; run: msgs-slam models pull\n")
    depth_card(tmp_path, view, canonical(view), RAW, canonical_focal=1000.0)
    assert check(tmp_path / "card.toml")[0] == 0
    depth_card(tmp_path, view, canonical(view), RAW)
    code, text = check(tmp_path / "card.toml")
    assert code == 1
    assert "fix: its depth is canonical and not scaled" in text


def test_the_real_small_networks_fit_their_cards(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path))
    store = ModelStore.open()
    store.take(shared_data / "models", store.with_needed([]))
    code, text = check()
    assert code == 0, text
    assert [name in text for name in ("ade20k-small", "fast-depth", "person")] == [True] * 3
    assert "BAD" not in text
