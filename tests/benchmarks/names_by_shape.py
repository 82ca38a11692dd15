"""Learning of the network that names things by their shape (`pipelines/labels/shape.py`), from made rooms alone.

    python tests/benchmarks/names_by_shape.py make DIR --set learn --rooms 400     # 1.5 CPU seconds a room
    python tests/benchmarks/names_by_shape.py make DIR --set wet --rooms 200       # kitchens and bathrooms
    python tests/benchmarks/names_by_shape.py learn DIR --steps 1700               # on one core, 0.2 s a step
    python tests/benchmarks/names_by_shape.py measure DIR --set judge              # IoU by class, of DIR/shape.npz

Nothing is photographed: the channels are those of the product, out of true depth that is made as wrong as completed
depth is, and every material has a flat colour of its own. `make` and `learn` go on where they were stopped; `learn`
leaves DIR/shape.npz every 200 steps. The rooms of `judge` are not learned from.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.geometry.camera import resample_nearest
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.labels import shape
from msgs_slam.pipelines.labels.segments import Segments
from msgs_slam.pipelines.labels.shape import NAMES, RoomShape, ShapeNetwork
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Calibration, Frame, Intrinsics
from tests.benchmarks.rooms import clip, video
from tests.benchmarks.rooms.furniture import Catalogue, furniture
from tests.benchmarks.rooms.light import LitRoom, _rays
from tests.benchmarks.rooms.room import build_room
from tests.benchmarks.rooms.surfaces import CLASSES
from tests.benchmarks.rooms.textures import Random
from tests.benchmarks.rooms.wet import WET

SETS = {"learn": (50_100, 2000), "judge": (50_000, 40), "wet": (60_100, 1000), "judge-wet": (60_000, 20)}
"""First seed and number of rooms; those from _WET on are kitchens and bathrooms in turn."""
_WET = 60_000
SIZE = 192, 144
_POSES, _EVERY = 14, 3
_BATCH, _RATE, _DECAY, _WARMED = 8, 3e-3, 1e-2, 0.04
_RARE = -0.35
"""Exponent of a class's share in its weight."""
_OF_CLASS = np.array(
    [NAMES.index("other" if c == "thing" else c) for c in CLASSES] + [VOID] * (256 - len(CLASSES)), "u1"
)
Array = NDArray[np.float32]


# rooms ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Views:
    """Depths (N, h, w), classes (N, h, w) as NAMES, colours (N, h, w, 3) and world_from_cam (N, 4, 4) of a walk."""

    depth: Array
    names: NDArray[np.uint8]
    images: NDArray[np.uint8]
    poses: NDArray[np.float64]
    camera: Intrinsics


def see_room(seed: int, catalogue: Catalogue) -> Views | None:
    """Walk through the room of a seed; None where there is no place to."""
    room, r = build_room(seed, catalogue, list(WET)[seed % 2] if seed >= _WET else "")
    unlit, mine = LitRoom(room.surfaces, lit=False), np.random.default_rng(seed + 77)
    walk = video._walk(room, unlit, r) if seed % 3 else None
    poses = clip._walk(room, unlit, clip.KEYFRAMES, r) if walk is None else None
    if walk is not None:
        poses = walk.poses(np.linspace(0, video.SECONDS, _POSES))
    if poses is None:
        return None
    width, height = SIZE if mine.random() < 0.85 else SIZE[::-1]
    focal = float(mine.uniform(0.6, 1.0)) * max(SIZE)
    seen = [unlit.measure(pose, width, height, focal) for pose in poses]
    images = np.stack([_flat_colors(unlit, pose, width, height, focal, mine) for pose in poses])
    depth, classes = (np.stack(column) for column in zip(*seen, strict=True))
    return Views(
        depth, _OF_CLASS[classes], images, poses, Intrinsics(width, height, focal, focal, width / 2, height / 2)
    )


def _flat_colors(unlit: LitRoom, pose: NDArray, width: int, height: int, focal: float, r: Random) -> NDArray[np.uint8]:
    """(h, w, 3) a colour for each material, shaded by slope."""
    tones = np.clip(
        unlit.rgb * 0.6 + 0.25 * np.random.default_rng(len(unlit.rgb)).random((len(unlit.rgb), 3)) + 0.1, 0, 1
    )
    ways, origins, _ = _rays(pose, width, height, focal, 1)
    hit = np.maximum(unlit.cast(origins, ways)["primID"], 0)
    light = 0.75 + 0.25 * unlit.flat[hit] @ np.array([0.48, 0.6, 0.64]) + 0.1 * _smooth(r, (height, width), 20).ravel()
    color = 255 * tones[unlit.material[hit]] * light[:, None] + 4 * r.normal(size=(len(hit), 3))
    return np.clip(color, 0, 255).astype(np.uint8).reshape(height, width, 3)


def _smooth(r: Random, size: tuple[int, int], span: float) -> Array:
    """A field (h, w) of about unit variance that changes over so many pixels."""
    few = r.normal(size=[max(2, round(s / span) + 1) for s in size]).astype(np.float32)
    return np.asarray(cv2.resize(few, size[::-1], interpolation=cv2.INTER_CUBIC), np.float32)


def as_completed(depth: Array, r: Random, unsure_share: float) -> DepthEstimate:
    """Depth (h, w) as the product has it: edges displaced, smooth errors, guesses of low confidence in patches."""
    size = depth.shape[0], depth.shape[1]
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    by = r.uniform(0, 1.5)
    x, y = x + by * _smooth(r, size, 8), y + by * _smooth(r, size, 8)
    found = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    field = _smooth(r, size, 35)
    unsure = field > np.quantile(field, 1 - unsure_share)
    error = r.uniform(0.003, 0.02) * _smooth(r, size, 40) + r.uniform(0.002, 0.012) * _smooth(r, size, 8)
    guessed = r.uniform(0.02, 0.1) * _smooth(r, size, 40) + r.uniform(0.01, 0.05) * _smooth(r, size, 12)
    if r.random() < 0.25:  # guessed from around, across edges
        found = np.where(unsure, cv2.GaussianBlur(found, (0, 0), r.uniform(3, 9)), found)
    sure = np.clip(0.75 + 0.15 * _smooth(r, size, 10), 0.3, 1)
    confidence = np.where(unsure, np.clip(0.15 + 0.08 * _smooth(r, size, 12), 0.02, 0.25), sure) * (found > 0)
    return DepthEstimate((found * np.exp(error + unsure * guessed)).astype(np.float32), confidence.astype(np.float32))


def examples(views: Views, seed: int) -> dict[str, NDArray]:
    """Channels (K, CHANNELS, h, w) and names (K, h, w) of some of the views, in a world of any unit and axes."""
    r = np.random.default_rng(seed + 78)
    unsure, unit, count = r.uniform(0, 0.5), math.exp(0.5 * r.normal()), len(views.poses)
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(r.normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.sign(np.linalg.det(turn))
    cam_from_world = np.linalg.inv(views.poses)
    cam_from_world[:, :3, 3] *= unit
    none = np.zeros(0, np.int64)
    model = SparseModel(
        np.arange(count), cam_from_world @ turn, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none,
        np.zeros((0, 2)),
    )  # fmt: skip
    frames = [Frame(i, str(i), float(i), i, 1.0) for i in range(count)]
    calibration = Calibration(views.camera, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    sequence = Sequence(frames, calibration, views.camera, model, lambda f: views.images[f.id])
    found = [as_completed(depth, r, unsure) for depth in views.depth]
    found = [DepthEstimate(d.depth * np.float32(unit), d.confidence) for d in found]
    voxels, gravity, kind = Segments(sequence, SilentProgress()).structure(frames, lambda f: found[f.id])
    room = RoomShape.of(voxels, gravity, kind, np.linalg.inv(model.cam_from_world)[:, :3, 3])
    some = frames[::_EVERY]
    channels = np.stack([room.channels(sequence, f, found[f.id]) for f in some]).astype(np.float16)
    names = np.stack([resample_nearest(views.names[f.id], *channels.shape[2:]) for f in some])
    return {"channels": channels, "names": names}


def make(folder: Path, seeds: range) -> None:
    """Leave the examples of rooms, unless they are there."""
    for seed in seeds:
        path = folder / "shapes" / f"{seed}.npz"
        if not path.exists() and (views := see_room(seed, furniture(str(folder)))) is not None:
            save_arrays(path, examples(views, seed), compress=False)


# learning -------------------------------------------------------------------------------------------------------


def load(folder: Path, seeds: Iterable[int]) -> list[tuple[Array, NDArray[np.uint8]]]:
    """Channels and names of each keyframe of the rooms that are there."""
    paths = [p for s in seeds if (p := folder / "shapes" / f"{s}.npz").exists()]
    of_room = (load_arrays(path) for path in paths)
    return [pair for arrays in of_room for pair in zip(arrays["channels"], arrays["names"], strict=True)]


def learn(folder: Path, seeds: list[int], steps: int, seconds: float, start: Path | None) -> None:
    """Learn for so many steps, from the weights of `start`, if given, by a third of the rate; stops after some seconds,
    and the next call goes on."""
    torch.manual_seed(0)
    known = load(folder, seeds)
    groups = [[e for e in known if e[0].shape == size] for size in sorted({e[0].shape for e in known})]
    share = np.bincount(np.concatenate([n[n < len(NAMES)] for _, n in known]), minlength=len(NAMES)).astype(float)
    share = share / share.sum() + 1e-4
    weight = torch.from_numpy(np.clip(share**_RARE / (share**_RARE * share).sum(), 0.3, 4).astype(np.float32))
    network, target, state = ShapeNetwork(), folder / "shape.npz", folder / "shape_paused.pt"
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer, first, most = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_DECAY), 0, _RATE
    if start is not None:
        arrays = {k: torch.from_numpy(v.astype(np.float32)) for k, v in load_arrays(start).items()}
        network.load_state_dict(arrays, strict=False)
        most = _RATE / 3
    if state.exists():
        held = torch.load(state, weights_only=True)
        network.load_state_dict(held["network"])
        optimizer.load_state_dict(held["optimizer"])
        first = held["step"]
    begun, losses = time.time(), list[float]()
    for step in range(first, steps):
        rng, part = np.random.default_rng(step), step / steps
        rate = part / _WARMED if part < _WARMED else 0.5 * (1 + math.cos(math.pi * (part - _WARMED) / (1 - _WARMED)))
        for group in optimizer.param_groups:
            group["lr"] = max(most * rate, 1e-5)
        members = groups[rng.choice(len(groups), p=[len(g) / len(known) for g in groups])]
        drawn = [members[i] for i in rng.choice(len(members), min(_BATCH, len(members)), replace=False)]
        channels = torch.from_numpy(np.stack([c for c, _ in drawn]).astype(np.float32))
        names = torch.from_numpy(np.stack([n for _, n in drawn]).astype(np.int64))
        channels, names = _varied(channels, names, rng)
        logits = network(channels.contiguous(memory_format=torch.channels_last))
        loss = F.cross_entropy(logits, names, weight, ignore_index=VOID, label_smoothing=0.02)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        losses.append(float(loss.detach()))
        if step % 50 == 49:
            print(step + 1, round(float(np.mean(losses[-100:])), 3), round(time.time() - begun), "s", flush=True)
        if step % 200 == 199 or step == steps - 1 or time.time() - begun > seconds:
            held = {"network": network.state_dict(), "optimizer": optimizer.state_dict(), "step": step + 1}
            torch.save(held, state)
            save_weights(network, target)
        if time.time() - begun > seconds:
            return
    state.unlink(missing_ok=True)


def save_weights(network: ShapeNetwork, path: Path) -> None:
    """Write weights as they come with the program."""
    arrays = {k: v.numpy() for k, v in network.state_dict().items() if not k.endswith("num_batches_tracked")}
    save_arrays(path, {k: v if "running" in k else v.astype(np.float16) for k, v in arrays.items()})


def _varied(channels: Tensor, names: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Mirror, change lengths by 8 %, confidence by 20 % and colours by more, or take colours away."""
    if rng.random() < 0.5:
        channels, names = channels.flip(3), names.flip(2)
    x, count = channels.clone(), len(channels)

    def draw(size: int = 1) -> Tensor:
        return torch.from_numpy(rng.normal(size=(count, size, 1, 1)).astype(np.float32))

    known, longer = x[:, :1], 1 + 0.08 * draw()
    x[:, 2:3] += 0.08 * draw() * known
    x[:, 3:4] *= 1 + 0.2 * draw()
    x[:, 4:5] = ((x[:, 4:5] + 1) * longer - 1) * known
    x[:, 5:6] = ((x[:, 5:6] - 1) * longer + 1) * known
    x[:, 8:10] *= longer
    x[:, 14:15] = x[:, 14:15] * (1 + 0.15 * draw()) + 0.15 * draw()
    x[:, 15:] = x[:, 15:] * (1 + 0.4 * draw(2)) + 0.1 * draw(2)
    few = rng.normal(size=(count, 3, 12, 12)) * rng.choice([0, 0.2, 0.6], (count, 1, 1, 1))  # patterns on everything
    x[:, 14:] += F.interpolate(torch.from_numpy(few.astype(np.float32)), x.shape[2:], mode="bicubic")
    x[:, 14:] *= torch.from_numpy(rng.random((count, 1, 1, 1)) > 0.4).float()
    return x, names


def measure(folder: Path, seeds: range) -> None:
    """Print IoU by class."""
    shape.WEIGHTS = folder / "shape.npz"
    count = len(NAMES)
    confusion = np.zeros((count, count))
    for channels, names in load(folder, seeds):
        with torch.no_grad():
            logits = shape.load_shape_network()(torch.from_numpy(channels.astype(np.float32))[None])[0]
        both = names[names < count].astype(np.int64) * count + logits.argmax(0).numpy()[names < count]
        confusion += np.bincount(both, minlength=count**2).reshape(count, count)
    hit = np.diag(confusion)
    iou = 100 * hit / np.maximum(confusion.sum(0) + confusion.sum(1) - hit, 1)
    print(
        " ".join(f"{n} {v:.0f}" for n, v in zip(NAMES, iou, strict=True)),
        f"mean {iou[confusion.sum(1) > 0].mean():.1f}",
    )


def main() -> None:
    """Parse, do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "learn", "measure"))
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--set", choices=SETS, default="learn")
    parser.add_argument("--rooms", type=int, default=0, help="only the first so many of the set")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seconds", type=float, default=math.inf, help="of one call; the next goes on")
    parser.add_argument("--start", type=Path, metavar="NPZ", help="weights to learn on from")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    first, count = SETS[given.set]
    seeds = range(first, first + (given.rooms or count))
    known = [seed for name in ("learn", "wet") for seed in range(SETS[name][0], sum(SETS[name]))]
    does: dict[str, Callable[[], None]] = {
        "make": lambda: make(given.folder, seeds),
        "learn": lambda: learn(given.folder, known, given.steps, given.seconds, given.start),
        "measure": lambda: measure(given.folder, seeds),
    }
    (given.folder / "shapes").mkdir(parents=True, exist_ok=True)
    does[given.what]()


if __name__ == "__main__":
    main()
