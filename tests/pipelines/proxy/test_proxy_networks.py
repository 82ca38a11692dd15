"""Networks by card: stand-ins with the exact contracts, and what must be refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb
from msgs_slam.pipelines.depth.learned import OnnxDepth
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.networks.card import Card, read_card
from msgs_slam.pipelines.networks.network_pass import ResultCache, Workplace
from msgs_slam.pipelines.networks.outputs import class_token, network_depth, solve_shift, solve_shift_and_focal
from msgs_slam.pipelines.networks.runtime import external_locations, require_own_weights
from msgs_slam.pipelines.networks.session import Network, choose_box
from msgs_slam.pipelines.networks.words import load_linear_head
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Frame, Intrinsics
from tests.network_labels import network_labels
from tests.networks import PICTURE, color_tokens, save_network

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
NEAREST, SPAN = 1.5, 2.0
FAMILIES = {
    # name: (white, normalised in the graph, output name, batch x channel axes, size rule)
    "official": (255.0, True, "pred_depth", 4, "same"),
    "community": (255.0, True, "predicted_depth", 3, "14"),
    "outside": (255.0, False, "pred_depth", 4, "same"),
    "unit range": (1.0, False, "predicted_depth", 3, "same"),
}


def stand_in(path: Path, family: str, canonical_per_metre: float) -> None:
    """A network that reads metres off the red channel (NEAREST + SPAN · red) and answers in its canonical space."""
    white, in_graph, output, axes, rule = FAMILIES[family]
    # Normalised and back: proves that nothing was normalised before.
    nodes = ["unit = Mul (x, scale)"] if in_graph else ["spread = Mul (x, std)", "unit = Add (spread, mean)"]
    nodes += ["one = Gather <axis = 1> (unit, red)", "scaled = Mul (one, span)", "depth3 = Add (scaled, nearest)"]
    nodes += ["depth4 = Unsqueeze (depth3, axis)"]
    if rule == "14":  # 4 · floor(3.5 · floor(H / 14)): 518 gives 516
        nodes += ["shape = Shape (x)", "hw = Slice (shape, start, end)", "p = Div (hw, fourteen)", "q = Mul (p, seven)"]
        nodes += ["r = Div (q, two)", "s = Mul (r, four)", "sizes = Concat <axis = 0> (lead, s)"]
        nodes += ['resized = Resize <mode = "linear"> (depth4, , , sizes)']
    last = "resized" if rule == "14" else "depth4"
    nodes += [f"{output} = {'Squeeze' if axes == 3 else 'Identity'} ({last}{', axis' if axes == 3 else ''})"]
    save_network(
        path, PICTURE, f"float[{', '.join('abcd'[:axes])}] {output}", *nodes,
        red=0, axis=[1], span=SPAN * canonical_per_metre, nearest=NEAREST * canonical_per_metre, scale=1 / white,
        std=np.array(STD).reshape(3, 1, 1), mean=np.array(MEAN).reshape(3, 1, 1),
        start=[2], end=[4], seven=[7], two=[2], four=[4], fourteen=[14], lead=[1, 1],
    )  # fmt: skip


def write_card(path: Path, **values: Any) -> Card:
    path.write_text("".join(f"{k} = {json.dumps(v)}\n" for k, v in values.items()))
    return read_card(path)


def ramp(camera: Intrinsics) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture whose red channel runs over the image, and the metres that it stands for."""
    y, x = np.indices((camera.height, camera.width))
    red = np.round(255 * (0.2 + 0.4 * x / camera.width + 0.3 * y / camera.height))
    picture = np.stack([red, np.full_like(red, 30), np.full_like(red, 200)], -1).astype(np.uint8)
    return picture, NEAREST + SPAN * red / 255


def labels_of(network: Network, picture: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    height, width = picture.shape[:2]
    return network_labels(network, network.run(picture, network.box(width, height))["output"], width, height)


CAMERAS = {
    "landscape": Intrinsics(640, 480, 525, 515, 320, 240),
    "portrait": Intrinsics(360, 640, 500, 500, 180, 320),
    "replica": Intrinsics(600, 340, 300, 300, 300, 170),
}
SIZES: dict[str, dict[str, Any]] = {
    "28": {"multiple": 28, "pixels": 100_000},
    "518": {"size": [518, 518]},
    "616": {"size": [308, 532]},
}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_perfect_network_comes_back_as_metres(tmp_path: Path, family: str, size: str, camera: Intrinsics) -> None:
    white, in_graph, output, _, _ = FAMILIES[family]
    box = choose_box(
        camera.width, camera.height, SIZES[size].get("size", (0, 0)), SIZES[size].get("multiple", 1), 100_000
    )
    scale = min(box.box_width / camera.width, box.box_height / camera.height)
    stand_in(tmp_path / "net.onnx", family, 1000 / ((camera.fx + camera.fy) / 2 * scale))
    norm = {} if in_graph else {"mean": list(MEAN), "std": list(STD)}
    keys: dict[str, Any] = {"task": "depth", "model": "net.onnx", "input": "x", "output": output, "white": white}
    card = write_card(tmp_path / "c.toml", **keys, **norm, **SIZES[size], canonical_focal=1000.0, valid=[0.1, 200.0])
    picture, truth = ramp(camera)
    found = network_depth(Network(card, 1, "cpu"), picture, camera)
    depth = found.depth
    inner = (slice(12, -12), slice(12, -12))
    error = np.abs(depth / truth - 1)[inner]
    assert np.median(error) <= 1e-3
    assert abs((depth / truth)[inner].mean() - 1) <= 2e-3
    assert set(np.unique(found.confidence)) == {0.5}
    assert found.invalid == 0
    assert found.normals is found.focal is None


@pytest.mark.parametrize("mistake", ["normalised twice", "no focal length", "wrong range"])
def test_a_mistaken_card_is_far_off(tmp_path: Path, mistake: str) -> None:
    camera = CAMERAS["landscape"]
    box = choose_box(640, 480, (0, 0), 28, 100_000)
    stand_in(tmp_path / "net.onnx", "community", 1000 / (520 * box.box_width / 640))
    keys: dict[str, Any] = {"task": "depth", "model": "net.onnx", "input": "x", "output": "predicted_depth"}
    keys |= {"multiple": 28, "pixels": 100_000, "canonical_focal": 1000.0}
    if mistake == "normalised twice":
        keys |= {"mean": list(MEAN), "std": list(STD)}
    if mistake == "no focal length":
        keys["canonical_focal"] = 0.0
    if mistake == "wrong range":
        keys["white"] = 1.0
    picture, truth = ramp(camera)
    depth = network_depth(Network(write_card(tmp_path / "c.toml", **keys), 1, "cpu"), picture, camera).depth
    assert np.median(np.abs(depth / truth - 1)) > 0.05


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640), (600, 340), (1920, 1080), (333, 517)])
def test_the_box_is_a_multiple_keeps_the_aspect_and_the_budget(width: int, height: int) -> None:
    box = choose_box(width, height, (0, 0), 28, 448 * 588)
    assert box.box_width % 28 == box.box_height % 28 == 0
    assert 0.8 < box.box_width * box.box_height / (448 * 588) < 1.25
    inner = box.inner
    assert inner[0] * inner[1] > 0.9 * box.box_width * box.box_height
    assert min(box.box_width - inner[0], box.box_height - inner[1]) == 0


DEPTH: dict[str, Any] = {"task": "depth", "model": "net.onnx", "input": "x", "output": "y"}


def depth_card(folder: Path, output: str, *nodes: str, valid: list[float] = (), **weights: Any) -> Card:
    save_network(folder / "net.onnx", PICTURE, output, *nodes, **weights)
    return write_card(folder / "c.toml", **DEPTH, size=[32, 32], **({"valid": valid} if valid else {}))


def test_stops_nan_and_negative_values_are_unknown_and_counted(tmp_path: Path) -> None:
    plane = np.full((1, 32, 32), 2.0, np.float32)
    plane[0, 0, 0], plane[0, 8, 8], plane[0, 16, 16], plane[0, 24, 24] = np.nan, -1, 200, 0.1
    nodes = "s = ReduceSum <keepdims = 0> (x)", "z = Mul (s, none)", "y = Add (plane, z)"
    card = depth_card(tmp_path, "float[1, 32, 32] y", *nodes, none=0.0, plane=plane, valid=[0.1, 200.0])
    camera = Intrinsics(32, 32, 30, 30, 16, 16)
    found = network_depth(Network(card, 1, "cpu"), np.zeros((32, 32, 3), np.uint8), camera)
    depth = found.depth
    assert found.invalid == 2
    assert (found.confidence[depth == 0] == 0).all()
    assert all(depth[i, i] == 0 for i in (0, 8, 16, 24))
    assert (depth == 2).sum() == 32 * 32 - 4


def test_wrong_outputs_and_inputs_are_refused_when_opened(tmp_path: Path) -> None:
    mean = "y = ReduceMean <axes = [1], keepdims = 0> (x)"
    card = depth_card(tmp_path, "float[1, h, w] y", mean)
    Network(card, 1, "cpu")
    keys = {**DEPTH, "size": [32, 32]}
    for change, said in (({"output": "z"}, "no output 'z'"), ({"input": "pixels"}, "inputs are x")):
        with pytest.raises(InputError, match=said):
            Network(write_card(tmp_path / "d.toml", **{**keys, **change}), 1, "cpu")
    with pytest.raises(InputError, match="sha256"):
        Network(write_card(tmp_path / "d.toml", **keys, sha256="0" * 64), 1, "cpu")
    save_network(tmp_path / "net.onnx", PICTURE, "float[1, 100000, 100000] y", mean)
    with pytest.raises(InputError, match="too large"):
        Network(card, 1, "cpu")
    (tmp_path / "net.onnx").write_bytes(b"this is no protobuf at all, but text")
    with pytest.raises(InputError, match="no ONNX network"):
        Network(card, 1, "cpu")


def test_an_output_that_is_no_image_is_refused(tmp_path: Path) -> None:
    card = depth_card(tmp_path, "float[1, 3] y", "y = ReduceMean <axes = [2, 3], keepdims = 0> (x)")
    camera = Intrinsics(32, 32, 30, 30, 16, 16)
    with pytest.raises(InputError, match="image of depth"):
        network_depth(Network(card, 1, "cpu"), np.zeros((32, 32, 3), np.uint8), camera)


@pytest.mark.parametrize("side", [15_000, 3_000_000])
def test_an_output_without_end_is_refused_when_it_comes(tmp_path: Path, side: int) -> None:
    # The size depends on the input, so that nobody can tell it from the graph.
    card = depth_card(
        tmp_path, "float[1, h, w] y",
        "sum = ReduceSum <keepdims = 0> (x)",
        "zero = Mul (sum, none)",
        "length = Add (zero, side)",
        "edge = Cast <to = 7> (length)",
        "sizes = Concat <axis = 0> (one, edge, edge)",
        "y = Expand (zero, sizes)",
        side=[float(side)], none=0.0, one=[1],
    )  # fmt: skip
    with pytest.raises(InputError, match="Correct the card"):
        network_depth(Network(card, 1, "cpu"), np.zeros((32, 32, 3), np.uint8), Intrinsics(32, 32, 30, 30, 16, 16))


def external(path: Path, location: str) -> None:
    """A network that keeps a weight in another file."""
    model = onnx.load(save_network(path, PICTURE, "float[1, 3, h, w] y", "y = Add (x, w)", w=[1.0]))
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value=location)
    onnx.save(model, path)


@pytest.mark.parametrize("location", ["../secret.bin", "/etc/passwd", "a/../../secret.bin"])
def test_weights_outside_the_folder_are_refused_before_anything_is_loaded(
    tmp_path: Path, location: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda *a, **k: pytest.fail("it was loaded"))
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(b"1234")
    external(folder / "net.onnx", location)
    with pytest.raises(InputError, match="outside its own folder"):
        Network(write_card(folder / "c.toml", **DEPTH, size=[32, 32]), 1, "cpu")


def test_weights_beside_the_network_are_found_also_in_subgraphs(tmp_path: Path) -> None:
    external(tmp_path / "net.onnx", "weights.bin")
    assert external_locations(tmp_path / "net.onnx") == ["weights.bin"]
    with pytest.raises(InputError, match="not beside it"):
        require_own_weights(tmp_path / "net.onnx")
    (tmp_path / "weights.bin").write_bytes(np.float32(1).tobytes())
    require_own_weights(tmp_path / "net.onnx")
    inner = onnx.load(tmp_path / "net.onnx", load_external_data=False).graph
    outer = helper.make_node("If", ["c"], ["y"], then_branch=inner, else_branch=inner)
    onnx.save(helper.make_model(helper.make_graph([outer], "outer", [], [])), tmp_path / "outer.onnx")
    assert external_locations(tmp_path / "outer.onnx") == ["weights.bin"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"outputs": "y"}, "no key 'outputs'"),
        ({"task": "flow"}, "task is"),
        ({"model": "../net.onnx"}, "outside the card's folder"),
        ({"model": "gone.onnx"}, "no gone.onnx"),
        ({"white": 0.0}, "white"),
        ({"valid": [5.0, 1.0]}, "valid"),
        ({"mean": [1.0]}, "three numbers"),
        ({"size": [100_000, 8]}, "size"),
        ({"multiple": "x"}, "expected int"),
        ({"task": "segmentation"}, "needs classes"),
    ],
)
def test_cards_that_make_no_sense_are_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    (tmp_path / "net.onnx").write_bytes(b"")
    with pytest.raises(InputError, match=said):
        write_card(tmp_path / "c.toml", **{**DEPTH, **change})


def segmentation(folder: Path, scores: NDArray[np.float32], **more: Any) -> Network:
    nodes = "s = ReduceSum <keepdims = 0> (x)", "z = Mul (s, none)", "y = Add (scores, z)"
    output = f"float[{', '.join(map(str, scores.shape))}] y"
    save_network(folder / "net.onnx", PICTURE, output, *nodes, none=0.0, scores=scores)
    keys = {"task": "segmentation", "model": "net.onnx", "input": "x", "output": "y", "size": [64, 64]}
    return Network(write_card(folder / "c.toml", **{**keys, "classes": ["a", "b", "c"], **more}), 1, "cpu")


def test_logits_are_read_where_the_picture_lies_in_the_box(tmp_path: Path) -> None:
    scores = np.zeros((1, 3, 16, 16), np.float32)
    scores[0, 1, :, :8] = 4
    scores[0, 2, :, 8:] = 4
    picture = np.zeros((60, 120, 3), np.uint8)
    ids, probability = labels_of(segmentation(tmp_path, scores), picture)
    assert (ids[:, :59] == 1).all()
    assert (ids[:, 61:] == 2).all()
    assert probability[30, 5] == pytest.approx(np.exp(4) / (np.exp(4) + 2), rel=1e-5)
    ids, _ = labels_of(segmentation(tmp_path, scores, void=[2]), picture)
    assert set(np.unique(ids)) == {-1, 1}
    ids, _ = labels_of(segmentation(tmp_path, scores.argmax(1).astype(np.float32)[:, None], kind="argmax"), picture)
    assert (ids[:, :59] == 1).all()
    assert (ids[:, 61:] == 2).all()


def test_nan_scores_and_a_wrong_number_of_classes_are_refused(tmp_path: Path) -> None:
    picture = np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(InputError, match="NaN"):
        labels_of(segmentation(tmp_path, np.full((1, 3, 8, 8), np.nan, np.float32)), picture)
    with pytest.raises(InputError, match="4 channels, the card is for 3 classes"):
        segmentation(tmp_path, np.zeros((1, 4, 8, 8), np.float32))


def test_the_real_network_sees_chair_and_table(shared_data: Path, tmp_path: Path) -> None:
    for name in ("deeplabv3_mnv2_voc.onnx", "coral_pascal_voc_segmentation_labels.txt"):
        (tmp_path / name).symlink_to(shared_data / "models" / name)
    with pytest.raises(InputError, match="outside the card's folder"):
        real_card(tmp_path)  # a link that leads out of the folder is not followed
    for name in ("deeplabv3_mnv2_voc.onnx", "coral_pascal_voc_segmentation_labels.txt"):
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes((shared_data / "models" / name).read_bytes())
    card = real_card(tmp_path)
    assert len(card.classes) == 21
    picture = read_rgb(shared_data / "kitchen" / "frame-000000.color.jpg")
    ids, probability = labels_of(Network(card, 2, "cpu"), picture)
    table, chair = card.classes.index("diningtable"), card.classes.index("chair")
    # In the first frame the table fills the lower right, a chair stands left of its middle, the floor is lower left.
    assert (ids[250:330, 420:600] == table).mean() > 0.9
    assert (ids[170:230, 190:270] == chair).mean() > 0.5
    assert (ids[330:, :120] == 0).mean() > 0.8
    assert 0.5 < probability.mean() <= 1


def real_card(folder: Path) -> Card:
    return write_card(
        folder / "deeplab.toml", task="segmentation", model="deeplabv3_mnv2_voc.onnx", input="pixel_values",
        size=[513, 513], output="logits", align_corners=True, classes="coral_pascal_voc_segmentation_labels.txt",
    )  # fmt: skip


def test_the_toy_network_has_the_516_rule(shared_data: Path, tmp_path: Path) -> None:
    (tmp_path / "toy_metric3d.onnx").write_bytes((shared_data / "models" / "toy_metric3d.onnx").read_bytes())
    card = write_card(
        tmp_path / "toy.toml", task="depth", model="toy_metric3d.onnx", input="pixel_values", size=[518, 518],
        output="predicted_depth", canonical_focal=1000.0,
    )  # fmt: skip
    camera = CAMERAS["landscape"]
    network = Network(card, 1, "cpu")
    picture, _ = ramp(camera)
    assert network.run(picture, network.box(640, 480))["output"].shape == (516, 516)
    depth = network_depth(network, picture, camera).depth
    assert depth.shape == (480, 640)
    assert np.isfinite(depth).all()


def test_a_point_map_finds_its_shift_and_its_focal_length() -> None:
    rng = np.random.default_rng(5)
    camera = CAMERAS["landscape"]
    rays = rng.uniform(-0.5, 0.5, (500, 2))
    z = rng.uniform(1, 4, 500)
    points = np.column_stack([rays * z[:, None], z - 0.7])
    points[:25] += rng.normal(0, 1, (25, 3))
    assert solve_shift(points, rays) == pytest.approx(0.7, abs=0.003)
    shift, focal = solve_shift_and_focal(points, rays * camera.fx)
    assert shift == pytest.approx(0.7, abs=0.02)
    assert focal == pytest.approx(camera.fx, rel=0.01)


def test_the_point_map_family_comes_back_as_metres(tmp_path: Path) -> None:
    camera = CAMERAS["landscape"]
    box = choose_box(640, 480, (0, 0), 14, 100_000)
    y, x = np.indices((box.box_height, box.box_width)) + 0.5
    rays_x = ((x - box.offset[0]) / box.scale[0] - camera.cx) / camera.fx
    rays_y = ((y - box.offset[1]) / box.scale[1] - camera.cy) / camera.fy
    metres = 2 + 0.5 * rays_x - 0.8 * rays_y
    points = np.stack([rays_x * metres, rays_y * metres, metres], -1) / 2.5 - [0, 0, 0.3]
    mask = np.ones(metres.shape)
    mask[:, :40] = 0
    save_network(
        tmp_path / "net.onnx", f"{PICTURE}, int64 num_tokens",
        "float[b, h, w, c] points, float[b, h, w] mask, float[k] s",
        "sum = ReduceSum <keepdims = 0> (x)",
        "t = Cast <to = 1> (num_tokens)",
        "u = Add (sum, t)",
        "zero = Mul (u, none)",
        *(f"{name} = Add ({name}_value, zero)" for name in ("points", "mask", "s")),
        none=0.0, points_value=points[None], mask_value=mask[None], s_value=[2.5],
    )  # fmt: skip
    card = write_card(
        tmp_path / "c.toml", task="depth", model="net.onnx", input="x", white=1.0, multiple=14, pixels=100_000,
        output="points", kind="points", tokens="num_tokens", mask="mask", metric_scale="s",
    )  # fmt: skip
    found = network_depth(Network(card, 1, "cpu"), np.zeros((480, 640, 3), np.uint8), camera)
    depth = found.depth
    assert found.focal == pytest.approx(camera.fx, rel=0.01)
    v, u = np.indices((480, 640)) + 0.5
    truth = 2 + 0.5 * (u - camera.cx) / camera.fx - 0.8 * (v - camera.cy) / camera.fy
    known = depth > 0
    assert 0.85 < known.mean() < 0.95
    assert np.abs(depth / truth - 1)[known].max() < 1e-3
    frames, calibration = [Frame(0, "a.png", 0.0, 0, 1.0)], Calibration(camera, "given", 0.0, (0.0,) * 4)
    sequence = Sequence(frames, calibration, camera, None, lambda f: np.zeros((480, 640, 3), np.uint8))
    place = Workplace(sequence, lambda: tmp_path, 1, "cpu", SilentProgress(), ResultCache(tmp_path, 0))
    for _ in range(2):  # the second finds what the first, or a worker, has left
        provider = OnnxDepth(card, place)
        provider.fit(frames)
        assert provider.figures()["network_focal_px"] == round(found.focal, 1)


def linear_head(path: Path, classes: int, features: int) -> torch.nn.Sequential:
    """A head with random statistics, saved under the names of DINOv2's segmenters; returned unfolded."""
    torch.manual_seed(0)
    norm, conv = torch.nn.BatchNorm2d(features), torch.nn.Conv2d(features, classes, 1)
    with torch.no_grad():
        for tensor in (norm.weight, norm.bias, norm.running_mean):
            tensor.copy_(torch.randn(features))
        norm.running_var.copy_(torch.rand(features) + 0.1)
    state = {f"decode_head.bn.{k}": v for k, v in norm.state_dict().items()}
    state |= {f"decode_head.conv_seg.{k}": v for k, v in conv.state_dict().items()}
    torch.save({"state_dict": state}, path)
    return torch.nn.Sequential(norm, conv).eval()


def test_the_folded_head_is_the_head(tmp_path: Path) -> None:
    reference = linear_head(tmp_path / "head.pth", 7, 12)
    head = load_linear_head(tmp_path / "head.pth", 7)
    features = np.random.default_rng(0).normal(size=(3, 5, 12)).astype(np.float32)
    with torch.no_grad():
        expected = reference(torch.tensor(features).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(head.scores(features), expected, rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="names 8"):
        load_linear_head(tmp_path / "head.pth", 8)


class Evil:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return Path.touch, (Path("evil-was-here"),)  # type: ignore[return-value]


def test_a_head_with_code_in_it_is_refused_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Evil()}, tmp_path / "head.pth")
    for content in (None, b"text", b""):
        if content is not None:
            (tmp_path / "head.pth").write_bytes(content)
        with pytest.raises(InputError, match=r"linear segmentation head|is empty"):
            load_linear_head(tmp_path / "head.pth", 3)
    assert not (tmp_path / "evil-was-here").exists()


def test_tokens_go_through_the_head_into_groups(tmp_path: Path) -> None:
    """A transformer's stand-in: a class token, then one token a patch that holds the mean colour of the patch."""
    color_tokens(tmp_path / "net.onnx")
    state = {f"decode_head.bn.{k}": v for k, v in torch.nn.BatchNorm2d(3).state_dict().items()}
    state |= {"decode_head.conv_seg.weight": 30 * torch.eye(3)[..., None, None]}
    state |= {"decode_head.conv_seg.bias": torch.zeros(3)}
    torch.save({"state_dict": state}, tmp_path / "head.pth")
    card = write_card(
        tmp_path / "c.toml", task="segmentation", model="net.onnx", input="x", white=1.0, multiple=14, pixels=50_000,
        output="tokens", kind="tokens", head="head.pth", classes=["red", "green", "blue"],
        groups=["warm", "cold", "cold"],
    )  # fmt: skip
    picture = np.zeros((240, 320, 3), np.uint8)
    picture[:, :160, 0] = 255
    picture[:120, 160:, 1] = 255
    picture[120:, 160:, 2] = 255
    network = Network(card, 1, "cpu")
    ids, probability = labels_of(network, picture)
    output = network.run(picture, network.box(320, 240))["output"]
    token = class_token(network, output, 320, 240)
    assert token is not None
    assert token == pytest.approx(np.full(3, 3**-0.5), rel=1e-5)
    assert class_token(network, output[1:], 320, 240) is None
    assert card.labels == ("warm", "cold")
    assert (ids[:, :145] == 0).all()
    assert (ids[:, 175:] == 1).all()
    assert probability[:, :140].min() > 0.99


def plane_network(folder: Path, camera: Intrinsics, flip: NDArray[np.float64], layout: str, **more: Any) -> Network:
    """A network that answers with a slanted plane, its normals with the axes `flip`, and how sure it is of them."""
    y, x = np.indices((camera.height, camera.width)) + 0.5
    slope = np.array([0.3, -0.2, 1.0])
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(x.shape)], -1)
    depth = 2.0 / (rays @ slope)
    normals = np.tile(flip * slope / np.linalg.norm(slope), (*x.shape, 1))
    normals[:, : camera.width // 4] = flip * [0, 1, 0]  # there the two answers contradict each other
    kappa = np.where(y < camera.height / 2, 30.0, 1.0)
    values = {"depth": depth, "n": normals.transpose(2, 0, 1) if layout == "first" else normals, "k": kappa}
    save_network(
        folder / "net.onnx", f"float[1, 3, {camera.height}, {camera.width}] x",
        "float[a, b, c] depth, float[d, e, f, g] n, float[h, i, j] k",
        "sum = ReduceSum <keepdims = 0> (x)",
        "zero = Mul (sum, none)",
        *(f"{k} = Add ({k}_value, zero)" for k in values),
        none=0.0, **{f"{k}_value": v[None] for k, v in values.items()},
    )  # fmt: skip
    keys = {"task": "depth", "model": "net.onnx", "input": "x", "output": "depth", "normals": "n"}
    return Network(write_card(folder / "c.toml", **keys, **more), 1, "cpu")


@pytest.mark.parametrize("layout", ["first", "last"])
@pytest.mark.parametrize("sign", [1, -1])
def test_normals_are_kept_and_tell_where_the_depth_is_doubtful(tmp_path: Path, layout: str, sign: int) -> None:
    camera = Intrinsics(64, 48, 60, 60, 32, 24)
    picture = np.zeros((48, 64, 3), np.uint8)
    network = plane_network(tmp_path, camera, sign * np.ones(3), layout, normal_confidence="k")
    found = network_depth(network, picture, camera)
    assert found.normals is not None
    wanted = -np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    assert found.normals[24, 40] / 127 == pytest.approx(wanted, abs=0.01)
    right, left = found.confidence[4:20, 24:60], found.confidence[4:20, 4:12]
    assert right.min() > 1.5 * left.max()
    assert right.mean() > 1.1 * found.confidence[28:44, 24:60].mean()
    assert 0 < found.confidence.min() <= found.confidence.max() <= 1


def test_normals_with_other_axes_are_not_believed(tmp_path: Path) -> None:
    camera = Intrinsics(64, 48, 60, 60, 32, 24)
    network = plane_network(tmp_path, camera, np.array([1.0, 1.0, 0.0]), "first")
    found = network_depth(network, np.zeros((48, 64, 3), np.uint8), camera)
    assert found.normals is None
    assert set(np.unique(found.confidence)) == {0.5}


def test_mean_and_std_of_the_file_win_where_the_card_says_so(tmp_path: Path) -> None:
    camera = CAMERAS["landscape"]
    box = choose_box(640, 480, (0, 0), 28, 100_000)
    stand_in(tmp_path / "net.onnx", "outside", 1000 / (520 * box.box_width / 640))
    model = onnx.load(tmp_path / "net.onnx")
    for key, values in (("image_mean", MEAN), ("image_std", STD)):
        model.metadata_props.add(key=key, value=str([255 * v for v in values]))
    onnx.save(model, tmp_path / "net.onnx")
    keys: dict[str, Any] = {"task": "depth", "model": "net.onnx", "input": "x", "output": "pred_depth"}
    keys |= {"multiple": 28, "pixels": 100_000, "canonical_focal": 1000.0, "mean": [0.5] * 3, "std": [0.5] * 3}
    picture, truth = ramp(camera)
    errors = []
    for metadata in (True, False):
        card = write_card(tmp_path / "c.toml", **keys, metadata=metadata)
        depth = network_depth(Network(card, 1, "cpu"), picture, camera).depth
        errors.append(float(np.median(np.abs(depth / truth - 1))))
    assert errors[0] <= 1e-3
    assert errors[1] > 0.02
