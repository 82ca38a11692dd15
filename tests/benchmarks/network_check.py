"""Networks against their cards, on a frame of the demo whose depth and classes are known.

    python tests/benchmarks/network_check.py [NAME|CARD.toml] ...     without a name: all in the cache

Files of one network go round with and without normalisation in the graph, in metres and in canonical depth: what
opens, and answers with numbers, may still be read wrongly. Here it is seen by its errors. Exit code 1 where it is.
"""

import argparse
import copy
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.doctor import BAD, GOOD, NOTE, Finding, print_findings
from msgs_slam.pipelines.evaluation.write import unpack_demo_clip
from msgs_slam.pipelines.geometry.voxels import normals_in_cam
from msgs_slam.pipelines.networks.card import Card, read_card
from msgs_slam.pipelines.networks.outputs import network_depth, network_probabilities
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.networks.runtime import is_tflite
from msgs_slam.pipelines.networks.session import Letterbox, Network
from msgs_slam.pipelines.types import Intrinsics

_PLAIN, _IMAGENET, _HALVES = ((0.0,) * 3, (1.0,) * 3), ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)), ((0.5,) * 3,) * 2
_RANGES = {
    "0..255 (white = 255, no mean and std)": (255.0, *_PLAIN),
    "0..1 (white = 1, no mean and std)": (1.0, *_PLAIN),
    "normalised by ImageNet's mean and std (white = 1)": (1.0, *_IMAGENET),
    "-1..1 (white = 1, mean and std 0.5)": (1.0, *_HALVES),
}
"""How networks are fed: name → white, mean, std."""
_BETTER = 0.6
"""Another range is the right one where its error is below so much of the card's. On the demo's frame the real
networks had 0.28 to 0.7 of the error of a wrong range, and never less with a wrong one."""
_GOOD_ERROR, _POOR_ERROR = 0.1, 0.5
_LOG_OFF = np.log(1.3)
_LENGTH_TOLERANCE = 0.05
_TOKENS_BEFORE = {0: "no class token", 1: "a class token", 5: "a class token and 4 registers"}
_PATCHES = (8, 14, 16, 28, 32)
_KNOWN_FRAME = 18
"""Walls, floor, table and shelf, from one to four metres away."""


@dataclass(frozen=True)
class KnownView:
    """image (h, w, 3) uint8; depth (h, w) in metres; the camera; labels (h, w), an index into `names`."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera: Intrinsics
    labels: NDArray[np.uint8]
    names: tuple[str, ...]


def named(name: str, state: str, text: str, fix: str = "") -> Finding:
    return Finding(state, text, fix, name)


def check_network(card: Card, view: KnownView, threads: int = 1) -> list[Finding]:
    """Open the network of a card and compare its input, outputs, sizes, units and ranges with what the card says.

    Never raises InputError: what is refused is a finding.
    """
    try:
        network = Network(card, threads, "cpu")
        found = [_input(network, view), *_range(network, view)]
        # What follows from a wrong range says nothing more.
        if all(f.state != BAD for f in found):
            found += {"depth": _depth, "segmentation": _segmentation, "person": _person}[card.task](network, view)
    except InputError as error:
        return [named("contract", BAD, str(error), "correct the card, or name the family that the file is of")]
    return found


def _input(network: Network, view: KnownView) -> Finding:
    """Whether every pixel of the input counts: a transformer drops what is left over beside its whole patches."""
    box = network.box(view.camera.width, view.camera.height)
    height, width = box.box_height, box.box_width
    text = f"{network.card.input}, {width}x{height}"
    if is_tflite(network.card.model):  # their sides are the file's own, and 8 bits hide a change at the rim
        return named("input", GOOD, text)
    whole = Letterbox(width, height, width, height)
    fitted = Letterbox(view.camera.width, view.camera.height, width, height)
    image = fitted.put(view.image, np.full(3, 127, np.float32)).astype(np.uint8)
    right = network.run(image, whole)["output"]
    for side, rim in (("column", np.s_[:, -1:]), ("row", np.s_[-1:])):
        changed = image.copy()
        changed[rim] = np.where(image[rim] > 127, 0, 255)
        if np.array_equal(network.run(changed, whole)["output"], right, equal_nan=True):
            fix = "give `multiple` in the card: 14 for DINOv2 and MoGe, 28 for Metric3D"
            return named("input", BAD, f"{text}: the last {side} has no influence on the answer", fix)
    short = [f"{g}" for g, w in zip(right.shape[-2:], (height, width), strict=True) if 0 < abs(g - w) < w / 20]
    if network.card.kind in ("", "plane") and short:
        fix = "sides that are multiples of 28 come back whole: `multiple = 28`, or `size`"
        return named("input", NOTE, f"{text}: comes back with {' and '.join(short)} px and is stretched", fix)
    return named("input", GOOD, text)


def _range(network: Network, view: KnownView) -> list[Finding]:
    """Whether the network knows the image better in another range of values than the card's."""
    card = network.card
    if card.task == "person" or (card.kind == "tokens" and network.head is None):
        return []
    plain = card.std == (1.0,) * 3
    given = (card.white if plain else 1.0, card.mean, card.std)
    own = next((name for name, r in _RANGES.items() if r == given), f"white {card.white:g}, mean {list(card.mean)}")
    errors = {own: _error(network, view)}
    for name, (white, mean, std) in _RANGES.items():
        other = copy.copy(network)
        other.card = replace(card, white=white, mean=mean, std=std)
        errors.setdefault(name, _error(other, view))
    best = min(errors, key=lambda name: errors[name])
    what = "error of the shape of depth" if card.task == "depth" else "wrong classes"
    text = f"{own}: {errors[own]:.0%} {what} on the built-in image"
    if errors[own] > _GOOD_ERROR and errors[best] < _BETTER * errors[own]:
        itself = "; the network seems to normalise its input itself" if best.startswith("0..255") else ""
        fix = f"correct `white`, `mean` and `std` in the card{itself}"
        return [named("range", BAD, f"{text}, but {errors[best]:.0%} with {best}", fix)]
    if errors[own] > _POOR_ERROR:
        return [named("range", NOTE, text, "no other range is better: this network does not know such images")]
    return [named("range", GOOD, text)]


def _error(network: Network, view: KnownView) -> float:
    """Depth: mean relative error after the best scale (and shift, where the card leaves it open). Classes: share of
    pixels of a class that the network has, too, and does not find. 1 where it says nothing."""
    try:
        if network.card.task != "depth":
            return _wrong_classes(network, view)
        depth, known = _depth_at_known(network, view)
    except InputError:
        return 1.0
    if known.mean() < 0.1:
        return 1.0
    scale, shift = _fit(network.card, depth[known], view.depth[known])
    fitted = scale * depth[known] + shift
    target = 1 / view.depth[known] if network.card.relative == "inverse" else view.depth[known]
    return min(1.0, float(np.mean(np.abs(fitted / target - 1)))) if scale > 0 else 1.0


def _fit(card: Card, values: NDArray[np.float64], depth: NDArray[np.float32]) -> tuple[float, float]:
    """(scale, shift) from the network's values to depth, or to inverse depth where they are that."""
    if card.relative not in ("depth", "inverse"):
        return float(1 / np.median(values / depth)), 0.0
    target = 1 / depth if card.relative == "inverse" else depth
    rows = np.stack([values, np.ones(len(values))], 1) / target[:, None]
    scale, shift = np.linalg.lstsq(rows, np.ones(len(values)), rcond=None)[0]
    return float(scale), float(shift)


def _depth_at_known(network: Network, view: KnownView) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    depth = network_depth(network, view.image, view.camera).depth.astype(np.float64)
    return depth, (depth > 0) & (view.depth > 0)


def _depth(network: Network, view: KnownView) -> list[Finding]:
    card = network.card
    found = network_depth(network, view.image, view.camera)
    depth, known = _depth_at_known(network, view)
    if not known.any():
        fix = f"correct `valid` (it is {list(card.valid)}) or the range of the input"
        return [named("values", BAD, "no pixel has a valid depth", fix)]
    values = named("values", GOOD, f"{known.mean():.0%} of the pixels have a depth")
    if known.mean() < 0.8 and card.kind != "points":
        fix = f"is `valid` = {list(card.valid)} in the units of the network's own output?"
        values = named("values", NOTE, values.text, fix)
    ratio = float(np.median(depth[known] / view.depth[known]))
    return [values, _units(network, view, ratio, depth[known]), *_normals(network, view, found.normals is not None),
            *_bounded(network, view), *_focal(found.focal, view)]  # fmt: skip


def _units(network: Network, view: KnownView, ratio: float, depth: NDArray[np.float64]) -> Finding:
    """Metres against the truth; what is wrong by the factor of another convention is said to be of that."""
    card = network.card
    known = _depth_at_known(network, view)[1]
    slope = np.polyfit(view.depth[known], depth, 1)[0]
    if slope < 0 and card.relative != "inverse":
        return named("units", BAD, "far things have smaller values than near ones", 'say `relative = "inverse"`')
    if slope > 0 and card.relative == "inverse":
        return named("units", BAD, "far things have larger values than near ones", 'say `relative = "depth"`')
    if card.relative in ("depth", "inverse"):
        return named("units", GOOD, f"relative ({card.relative}): brought to the unit of the run's points")
    off = abs(np.log(ratio))
    text = f"{ratio:.2f} of the known metres"
    scale_x, scale_y = network.box(view.camera.width, view.camera.height).scale
    focal = (view.camera.fx * scale_x + view.camera.fy * scale_y) / 2
    guesses = {0.001: "these are millimetres: no card says that. Divide in the graph by 1000"}
    if card.canonical_focal:
        guesses[card.canonical_focal / focal] = "it answers in metres as they are: say `canonical_focal = 0`"
    else:
        guesses[focal / 1000] = "its depth is canonical and not scaled: say `canonical_focal = 1000`"
    factor = min(guesses, key=lambda f: abs(np.log(ratio * f)))
    if off > _LOG_OFF and abs(np.log(ratio * factor)) < off / 2:
        return named("units", BAD, f"{text}, {ratio * factor:.2f} by another convention", guesses[factor])
    if off > np.log(2) and not card.relative:
        fix = "compare it with a recording whose size you know before you rely on its metres"
        return named("units", NOTE, text, fix)
    return named("units", GOOD, text)


def _normals(network: Network, view: KnownView, used: bool) -> list[Finding]:
    outputs = network.run(view.image, network.box(view.camera.width, view.camera.height))
    if (given := outputs.get("normals")) is None:
        return []
    vectors = given if given.shape[-1] == 3 else given.transpose(1, 2, 0)
    length = float(np.median(np.linalg.norm(np.nan_to_num(vectors.astype(np.float32)), axis=-1)))
    if abs(length - 1) > _LENGTH_TOLERANCE:
        return [named("normals", NOTE, f"are {length:.2f} long where 1 is expected", "they are scaled to 1")]
    if not used:
        return [named("normals", NOTE, "do not fit the network's own depth: other axes", "they are not used")]
    truth = normals_in_cam(view.depth, view.camera)
    ours = network_depth(network, view.image, view.camera).normals
    cosine = (truth * ours / 127).sum(-1)[np.abs(truth).sum(-1) > 0] if ours is not None else np.zeros(1)
    angle = float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))
    return [named("normals", GOOD if angle < 30 else NOTE, f"median angle to the known ones {angle:.0f} degrees")]


def _bounded(network: Network, view: KnownView) -> list[Finding]:
    """Outputs that are shares: confidence and mask."""
    outputs = network.run(view.image, network.box(view.camera.width, view.camera.height))
    found = []
    for role in ("confidence", "mask"):
        if role in outputs and (np.nan_to_num(outputs[role], nan=-1.0) < 0).mean() + (outputs[role] > 1).mean() > 0.01:
            low, high = float(np.nanmin(outputs[role])), float(np.nanmax(outputs[role]))
            fix = f"leave `{role}` out of the card, or end the graph with a sigmoid"
            found.append(named(role, BAD, f"runs from {low:.2g} to {high:.2g} where 0..1 is expected", fix))
    return found


def _focal(focal: float | None, view: KnownView) -> list[Finding]:
    if focal is None:
        return []
    off = focal / view.camera.fx - 1
    return [named("focal length", GOOD if abs(off) < 0.25 else NOTE, f"its points imply {off:+.0%} of the known one")]


def _segmentation(network: Network, view: KnownView) -> list[Finding]:
    card = network.card
    output = network.run(view.image, network.box(view.camera.width, view.camera.height))["output"].astype(np.float32)
    if card.kind == "tokens":
        return _tokens(network, view, output)
    found = []
    if card.kind == "argmax" and (output.min() < 0 or output.max() >= len(card.classes)):
        text = f"ids from {output.min():g} to {output.max():g}, the card has {len(card.classes)} classes"
        found.append(named("values", BAD, text, "correct `classes`, or `kind`"))
    if card.kind in ("logits", "probabilities", ""):
        sums = output.sum(0)
        are_shares = output.min() > -1e-3 and np.abs(sums - 1).max() < 0.02
        if are_shares != (card.kind == "probabilities"):
            seen = "probabilities" if are_shares else "logits"
            text = f"{output.min():.3g} to {output.max():.3g}, sums {sums.min():.3g} to {sums.max():.3g}"
            found.append(named("values", BAD, f"{text}: these are {seen}", f'say `kind = "{seen}"`'))
    return found or [named("values", GOOD, f"{output.shape[0]} planes of {output.shape[-1]}x{output.shape[-2]}")]


def _tokens(network: Network, view: KnownView, output: NDArray[np.float32]) -> list[Finding]:
    card, box = network.card, network.box(view.camera.width, view.camera.height)
    patches = (box.box_height // card.multiple) * (box.box_width // card.multiple)
    extra = output.shape[0] - patches
    text = f"{output.shape[0]} tokens for {patches} patches of {card.multiple} px"
    if extra not in _TOKENS_BEFORE:
        sides = (box.box_height, box.box_width)
        fitting = (p for p in _PATCHES if output.shape[0] - (sides[0] // p) * (sides[1] // p) in _TOKENS_BEFORE)
        patch = next(fitting, None)
        fix = f"say `multiple = {patch}`" if patch else "this network's tokens are not those of its patches"
        return [named("tokens", BAD, text, fix)]
    text = f"{text}: {_TOKENS_BEFORE[extra]}"
    if extra > 1 and network.head is not None:
        fix = "take the head that was trained for it, or the network without registers"
        return [named("tokens", BAD, f"{text}; the head is that of a network without registers", fix)]
    return [named("tokens", GOOD, text)]


def _wrong_classes(network: Network, view: KnownView) -> float:
    names = [network.card.labels.index(name) if name in network.card.labels else -1 for name in view.names]
    wanted = np.asarray(names)[view.labels]
    output = network.run(view.image, network.box(view.camera.width, view.camera.height))["output"]
    found = network_probabilities(network, output, view.camera.width, view.camera.height).argmax(-1)
    return float((found != wanted)[wanted >= 0].mean()) if (wanted >= 0).any() else 1.0


def _person(network: Network, view: KnownView) -> list[Finding]:
    output = network.run(view.image, network.box(view.camera.width, view.camera.height))["output"]
    if output.min() < -1e-3 or output.max() > 1.001:
        text = f"{output.min():.2g} to {output.max():.2g} where a probability is expected"
        return [named("values", BAD, text, "end the graph with a sigmoid")]
    share = float((output > 0.5).mean())
    state = GOOD if share < 0.1 else NOTE
    return [named("values", state, f"{share:.1%} of an image without people is taken for one")]


def known_view() -> KnownView:
    """Read a frame of the demo, with what is known of it."""
    with tempfile.TemporaryDirectory() as folder:
        sequence = open_sequence(unpack_demo_clip(Path(folder))[1])
        camera, depth, labels = sequence.camera, sequence.depth(_KNOWN_FRAME), sequence.labels(_KNOWN_FRAME)
        assert camera is not None
        assert depth is not None
        assert labels is not None
        intrinsics = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return KnownView(sequence.rgb(_KNOWN_FRAME), depth, intrinsics, labels, sequence.class_names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME|CARD.toml")
    names = parser.parse_args().names
    store, view, bad = ModelStore.open(), known_view(), False
    installed = [m for m in store.models if "input" in store.families[m.family] and store.is_here(m)]
    is_file = {name: Path(name).suffix.lower() in (".toml", ".json") for name in names}
    cards = {n: read_card(Path(n)) if is_file[n] else store.card(store.get(n)) for n in names}
    for name, card in (cards or {m.name: store.card(m) for m in installed}).items():
        found = check_network(card, view)
        print(f"{name}: {card.model}")
        print_findings(found)
        bad |= any(f.state == BAD for f in found)
    sys.exit(bad)


if __name__ == "__main__":
    main()
