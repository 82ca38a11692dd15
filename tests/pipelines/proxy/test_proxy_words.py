"""Classes as words: stand-ins of a picture's and a text's encoder whose embeddings are known."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from proxy_room import Room, write_source
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import noting_files
from msgs_slam.formats.tensors import save_arrays
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.evaluation.labels import count_labels, score
from msgs_slam.pipelines.networks.card import read_card
from msgs_slam.pipelines.networks.outputs import network_probabilities
from msgs_slam.pipelines.networks.session import Network
from msgs_slam.pipelines.networks.words import MAX_WORDS, with_words
from msgs_slam.pipelines.proxy.selection import check_proxy
from msgs_slam.pipelines.proxy.stage import run
from msgs_slam.pipelines.run.files import CLASSES, PROXY_MAPS
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.types import VOID
from tests.networks import PICTURE, save_network
from tests.world.room import CLASSES as ROOM_CLASSES

WORDS = ("wall", "floor", "side table")
COLOURS = {"wall": (1, -1, -1), "floor": (-1, 1, -1), "side": (-1, -1, 1), "table": (-1, -1, 1)}
BACKGROUND = {"object": (1, 1, 1), "things": (1, 1, 0.8), "stuff": (0.8, 1, 1), "texture": (1, 0.8, 1)}
LENGTH = 8
SPACE = np.linalg.qr(np.random.default_rng(0).normal(size=(LENGTH, 3)))[0].astype(np.float32)
"""(LENGTH, 3) the shared space: a colour -1..1 times it, in any length, is the feature of a picture and of a text."""


def write_pictures_encoder(path: Path, space: NDArray, kind: str = "features") -> None:
    """The mean colour of every 8 x 8 pixels, in the shared space and seven times as long."""
    mean = "fine = Conv (x, space)", "y = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (fine)"
    weights = {"space": 7 * space[:, :, None, None], "flat": [1, len(space), -1]}
    if kind == "tokens":
        turned = "z = Reshape (y, flat)", "t = Transpose <perm = [0, 2, 1]> (z)"
        save_network(path, PICTURE, "float[1, n, f] t", *mean, *turned, **weights)
    else:
        save_network(path, PICTURE, "float[1, f, h, w] y", *mean, **weights)


def write_text_encoder(folder: Path, tokens: int | None = None) -> None:
    """The sum over the tokens of a text, each times its place's share: other words for "a photo of a" say nothing."""
    vocabulary = ["[UNK]", "a", "photo", "of", ".", *COLOURS, *BACKGROUND]
    rows = [np.zeros(3)] * 5 + [3.0 * np.array(c) for c in (COLOURS | BACKGROUND).values()]
    length = tokens or "sequence"
    save_network(
        folder / "text.onnx",
        f"int64[batch, {length}] input_ids, int64[batch, {length}] attention_mask",
        f"float[batch, {LENGTH}] text_embeds",
        "each = Gather (table, input_ids)",
        "use = Cast <to = 1> (attention_mask)",
        "column = Unsqueeze (use, last)",
        "said = Mul (each, column)",
        "text_embeds = ReduceSum <keepdims = 0> (said, middle)",
        table=np.array(rows) @ SPACE.T, last=[2], middle=[1],
    )  # fmt: skip
    tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(vocabulary)}, "[UNK]"))
    tokenizer.normalizer, tokenizer.pre_tokenizer = normalizers.Lowercase(), pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))


def write_table(path: Path) -> None:
    colours = {"Wall": COLOURS["wall"], "floor": COLOURS["floor"], "side table": COLOURS["table"], **BACKGROUND}
    rows = 0.2 * np.array(list(colours.values())) @ SPACE.T
    save_arrays(path, {"words": np.array(list(colours)), "embeddings": rows.astype(np.float16)})


def write_card(folder: Path, **more: Any) -> Path:
    keys = {
        "task": "segmentation", "model": "net.onnx", "input": "x", "output": "y", "mean": [0.5] * 3, "std": [0.5] * 3,
        "white": 1.0, "multiple": 8, "pixels": 49_152, "kind": "features", "text": "text.onnx",
        "tokenizer": "tokenizer.json", "temperature": 0.1, **more,
    }  # fmt: skip
    path = folder / "card.toml"
    path.write_text("".join(f"{k} = {json.dumps(v)}\n" for k, v in keys.items() if v is not None))
    return path


@pytest.fixture
def card(tmp_path: Path) -> Path:
    folder = tmp_path / "network"
    folder.mkdir()
    write_pictures_encoder(folder / "net.onnx", SPACE)
    write_text_encoder(folder)
    write_table(folder / "words.npz")
    return write_card(folder)


def painted(room: Room) -> Room:
    """The room in the words' colours, what has no word white, with forty mistakes that are others in every frame."""
    kinds = np.array([{"wall": 0, "floor": 1, "table": 2}.get(name, 3) for name, _ in ROOM_CLASSES] + [3] * 256)
    palette = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)], np.uint8)
    views = []
    for number, view in enumerate(room.views):
        rng = np.random.default_rng(number)
        picture = palette[kinds[view.labels]]
        for x, y, kind in zip(*(rng.integers(0, n, 40) for n in (240, 180, 4)), strict=True):
            picture[y : y + 12, x : x + 12] = palette[kind]
        views.append(replace(view, rgb=picture))
    return replace(room, views=views)


def test_words_name_the_places_of_the_room(room: Room, make_context: Callable[..., StageContext], card: Path) -> None:
    words = "proxy.classes=Floor, wall,, side  table"
    context = make_context("proxy.depth=files", f"proxy.semantics=onnx:{card}", words, room=painted(room))
    check_proxy(context.source, context.config)
    report = run(context)
    names = context.run.load(CLASSES).names
    assert names[:3] == ("Floor", "wall", "side table")
    assert len(names) > 3
    assert all(name.startswith("object ") for name in names[3:])
    assert report["vocabulary"] == ["Floor", "wall", "side table"]
    index = np.array([names.index(n) for n in ("wall", "Floor", "side table")])
    truth_of = {"wall": 0, "floor": 1, "table": 2}
    truth = np.array([truth_of.get(name, 3) for name, _ in ROOM_CLASSES] + [VOID] * 256)[:256].astype(np.uint8)
    place = np.full(256, 3, np.uint8)
    place[index] = range(3)
    total = np.zeros((4, 5), np.int64)
    for frame in room.frames:
        total += count_labels(
            place[context.run.load(PROXY_MAPS, of=frame.id).labels], truth[room.views[frame.id].labels], 4, 4
        )
    found = score(total)
    assert found is not None
    assert 0.85 < found.mean_iou < 0.999


def test_probabilities_are_the_softmax_of_cosines_over_the_temperature(card: Path) -> None:
    colours = np.array([COLOURS["floor"], COLOURS["table"], *BACKGROUND.values()], float)
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, :32] = (40, 200, 90)
    picture[:, 32:] = (200, 180, 255)
    seen = picture[32, [8, 56]] / 127.5 - 1
    unit = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (seen, colours)]
    raised = np.exp(unit[0] @ unit[1].T / 0.1)
    expected = raised / raised.sum(1, keepdims=True)
    for kind, output in (("features", "y"), ("tokens", "t")):
        write_pictures_encoder(card.parent / "net.onnx", SPACE, kind)
        words = with_words(read_card(write_card(card.parent, kind=kind, output=output)), "floor, side table")
        assert words.labels == ("floor", "side table", "other")
        assert words.void == (2,)
        network = Network(words, 1, "cpu")
        given = network.run(picture, network.box(64, 64))["output"]
        found = network_probabilities(network, given, 64, 64)[32, [8, 56]]
        np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=2e-5)
        np.testing.assert_allclose(found[:, 2], expected[:, 2:].sum(1), atol=2e-5)


def test_prompts_are_averaged_and_texts_filled_up_to_a_fixed_length(card: Path) -> None:
    plain = Network(with_words(read_card(card), "wall, table"), 1, "cpu").head
    write_text_encoder(card.parent, 9)
    filled = Network(with_words(read_card(card), "wall, table"), 1, "cpu").head
    both = Network(with_words(read_card(write_card(card.parent, prompts=["{}", "{} floor"])), "wall"), 1, "cpu").head
    assert plain is not None
    assert filled is not None
    assert both is not None
    np.testing.assert_array_equal(plain.weight, filled.weight)
    mean = SPACE @ (np.array([1, -1, -1]) / np.sqrt(3) + np.array([0, 0, -1]))
    np.testing.assert_allclose(both.weight[0], mean / np.linalg.norm(mean), atol=1e-6)
    with pytest.raises(InputError, match="has 10 tokens; it takes 1 to 9"):
        Network(with_words(read_card(card), "wall " * 10), 1, "cpu")


@pytest.fixture(scope="module")
def source(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_source(room, tmp_path_factory.mktemp("source"))


def refused(card: Path, source: Path, words: str, said: str) -> None:
    """Before anything slow, by what looks at the input first."""
    settings = [f'proxy.semantics="onnx:{card}"', f'proxy.classes="{words}"', "run.device=cpu"]
    with pytest.raises(InputError, match=said):
        check_proxy(source, load_config(overrides=settings))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "finds what it is asked for: --classes"),
        (" , ,", "finds what it is asked for: --classes"),
        ("wall, floor, Wall", "'Wall' is there twice"),
        (", ".join(f"thing {i}" for i in range(MAX_WORDS + 1)), "201 words, at most 200"),
    ],
)
def test_words_that_cannot_be_classes_are_refused(source: Path, card: Path, words: str, said: str) -> None:
    refused(card, source, words, said)


def of_another_length(folder: Path) -> None:
    write_pictures_encoder(folder / "net.onnx", SPACE[:6])


def no_text(folder: Path) -> None:
    (folder / "text.onnx").write_bytes(b"\x08\x08 this is text, but no network")


def no_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").write_text('{"version": "1.0"}')


def table_without(folder: Path) -> None:
    write_card(folder, text="words.npz", tokenizer=None)
    save_arrays(folder / "words.npz", {"words": np.array(["floor", "object"]), "embeddings": np.eye(2, LENGTH)})


def crooked_table(folder: Path) -> None:
    write_card(folder, text="words.npz", tokenizer=None)
    save_arrays(folder / "words.npz", {"words": np.array(["floor", "object"]), "embeddings": np.eye(3, LENGTH)})


def table_of_numbers(folder: Path) -> None:
    write_card(folder, text="words.npz", tokenizer=None)
    save_arrays(folder / "words.npz", {"words": np.arange(3), "embeddings": np.eye(3, LENGTH)})


def empty_embedding(folder: Path) -> None:
    write_card(folder, prompts=["a photo of {}"], background=["of"])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (of_another_length, r"gave \(6, \d+, \d+\); 8 features"),
        (no_text, "no ONNX network"),
        (no_tokenizer, "no tokenizer.json"),
        (table_without, "no embedding of wall, things, stuff, texture; it knows floor, object"),
        (crooked_table, "2 words and 3 embeddings"),
        (table_of_numbers, "no table of words"),
        (empty_embedding, r"has shape \(8,\), length 0"),
        (lambda folder: write_card(folder, text_output="pooled"), "gives text_embeds; the card says text_input"),
        (lambda folder: write_card(folder, tokenizer=None), "a text encoder needs a tokenizer"),
        (lambda folder: write_card(folder, text=None), "features need text"),
        (lambda folder: write_card(folder, classes=["a", "b"]), "without classes or a head"),
        (lambda folder: write_card(folder, prompts=["a photo"]), "with {} for the word"),
        (lambda folder: write_card(folder, temperature=0.0), "temperature is positive"),
        (lambda folder: write_card(folder, text=3), "text is the name of a file, got 3"),
    ],
)
def test_cards_and_files_that_do_not_fit_are_refused(
    source: Path, card: Path, spoil: Callable[[Path], object], said: str
) -> None:
    spoil(card.parent)
    refused(card, source, "wall, floor", said)


def test_the_package_is_asked_for_where_it_is_missing(card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    with pytest.raises(InputError, match=r"-m pip install 'tokenizers>="):
        Network(with_words(read_card(card), "wall"), 1, "cpu")


def test_a_table_of_embeddings_says_the_same_as_the_encoder(card: Path) -> None:
    encoded = Network(with_words(read_card(card), "wall, FLOOR, side table"), 1, "cpu").head
    table = read_card(write_card(card.parent, text="words.npz", tokenizer=None))
    stored = Network(with_words(table, "wall, FLOOR, side table"), 1, "cpu").head
    assert encoded is not None
    assert stored is not None
    np.testing.assert_allclose(stored.weight, encoded.weight, atol=1e-3)


def test_all_that_a_network_loads_is_noted(card: Path) -> None:
    with noting_files() as files:
        Network(with_words(read_card(card), "wall"), 1, "cpu")
    assert {*files} == {card, *(card.parent / name for name in ("net.onnx", "text.onnx", "tokenizer.json"))}


def test_the_option_needs_a_network_that_knows_words(source: Path, tmp_path: Path) -> None:
    arguments = ["reconstruct", str(source), "--out", str(tmp_path / "run.msgs"), "--classes", "radiator, lamp"]
    found = CliRunner().invoke(main, arguments)
    assert found.exit_code == 1
    assert "proxy.classes: words of your own need a network" in found.stderr
    assert "segments does not" in found.stderr
    assert not (tmp_path / "run.msgs" / "frames").exists()
