"""Made rooms that nobody tuned on, for depth and for whole runs: forty to choose on, forty to judge on, and any number
to learn from.

    python -m tests.benchmarks.rooms make DIR --set judge                   rooms of a set and the stereo's first pass
    python -m tests.benchmarks.rooms measure DIR NAME --set judge           the product's depth of them, kept as NAME
    python -m tests.benchmarks.rooms table DIR OLD [NEW] --set judge        one against the other
    python -m tests.benchmarks.rooms video DIR --set judge --rooms 4        videos with their truth, DIR/video/SEED
    python -m tests.benchmarks.rooms walk DIR --set judge --rooms 4         walks through whole homes, DIR/walk/SEED
    python -m tests.benchmarks.rooms learn DIR --seconds 560 --workers 15   the network that completes depth, on a card
    python -m tests.benchmarks.rooms measure DIR NAME --network 6           fused with a network that is off by 6 %

A default about depth is chosen on `choose` and reported on `judge`. A room is a seed: walls, textures, light, furniture
(of Debian's `sweethome3d-furniture`, downloaded by apt-get or given by --package; none of it is in the repository), a
walk of 12 keyframes, a camera; 15 CPU seconds each. Needs `pip install embreex`. Poses are those of the walk up to a
millimetre. "off": wrong by more than 5 %; "unsure": confidence below 0.3 in OLD. `video` takes the kinds of rooms in
turn; each is a walk of twelve seconds at 640x480 (40 CPU seconds), for `reconstruct DIR/video/SEED/video.mp4` and
`evaluate --truth DIR/video/SEED --class-map tests/benchmarks/rooms/classes.toml`. `walk` makes homes of three to six
rooms, most with a corridor and some with a stair, filmed upright or across in 30 to 90 seconds at 12 images a second,
in half of them back to where it began (150 CPU seconds); twenty to choose on, twenty to judge on, for `walks.py`. Both
hold views from half a metre beside the path, for `beside.py`. `learn` leaves DIR/weights.npz; with
--pause it leaves what the same command goes on from, where a machine is not lent for long enough.
"""

import argparse
import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.completion.network import complete
from msgs_slam.pipelines.depth.fused import FusedDepth, measure_scale
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.geometry.camera import resample_nearest
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.providers import DepthEstimate, DepthProvider

from .clip import Clip, make_clip
from .furniture import furniture
from .learning import learn
from .network import NetworkLike
from .room import KINDS, kind_of

SETS = {"choose": (1000, 40), "judge": (2000, 40), "learn": (30_000, 2000), "apart": (7000, 40)}
WALKS = {"choose": (3000, 20), "judge": (4000, 20)}
"""First seed and number of rooms; seeds without a place to walk are passed over."""
SURE, OFF = 0.3, 0.05


def seeds_of(folder: Path, name: str, make: bool = False, package: Path | None = None, most: int = 0) -> list[int]:
    """Seeds of the rooms of a set that are in the folder; `make` makes those that are missing."""
    first, count = SETS[name]
    count = min(most or count, count)
    found: list[int] = []
    for seed in range(first, first + 2 * count):
        if len(found) == count:
            break
        path = folder / f"{seed}.npz"
        if make and not path.exists():
            start = time.process_time()
            clip = make_clip(seed, furniture(str(folder), str(package or "")))
            if clip is None:
                continue
            clip.save(path)
            clip.stereo(folder / "stereo" / str(seed))
            print(f"{seed} {clip.kind}: {time.process_time() - start:.1f} CPU seconds", flush=True)
        if path.exists():
            found.append(seed)
    return found


def make_videos(folder: Path, name: str, package: Path | None, most: int) -> None:
    """Leave videos of rooms of a set: the first home, office, classroom and bare room, then the second of each."""
    from .video import make_video  # imports av

    first, count = SETS[name]
    seeds = {kind: iter([s for s in range(first, first + 2 * count) if kind_of(s) == kind]) for kind in KINDS}
    for kind in itertools.islice(itertools.cycle(seeds), most or len(seeds)):
        next(s for s in seeds[kind] if _made(make_video, s, folder / "video", package))


def make_walks(folder: Path, name: str, package: Path | None, most: int) -> None:
    """Leave walks through the homes of a set."""
    from .stroll import make_stroll  # imports av

    first, count = WALKS[name]
    made = (s for s in itertools.count(first) if _made(make_stroll, s, folder / "walk", package))
    list(itertools.islice(made, min(most or count, count)))


def _made(make: Callable[..., bool], seed: int, folder: Path, package: Path | None) -> bool:
    """Whether the video of a seed is there, or could be made."""
    start, target = time.process_time(), folder / str(seed)
    if target.exists():
        return True
    if made := make(seed, furniture(str(folder.parent), str(package or "")), target):
        print(f"{target}: {time.process_time() - start:.1f} CPU seconds", flush=True)
    return made


def measure(folder: Path, seeds: list[int], name: str, network: float, alone: bool) -> None:
    """Keep depth (0: none) and confidence of every keyframe by the product, or with a network
    (0: without) that is off by `network` per cent, fused as in a run, or that network alone."""
    target = folder / "depth" / name
    target.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        if (target / f"{seed}.npz").exists():
            continue
        clip = Clip.load(folder / f"{seed}.npz")
        sequence = clip.sequence()
        provider, frames = clip.stereo(folder / "stereo" / str(seed))
        learned = NetworkLike(dict(enumerate(clip.truth)), network, seed)
        start = time.process_time()
        if network:
            found = in_unit_of_poses(sequence, learned if alone else FusedDepth(learned, provider, sequence))
        else:
            found = [provider.estimate(f) for f in frames]
        spent = (time.process_time() - start) / len(frames)
        depth, confidence = np.stack([f.depth for f in found]), np.stack([f.confidence for f in found])
        expected = [expected_error(provider, f.id, depth.shape[1:]) for f in frames]
        np.savez_compressed(
            target / f"{seed}.npz",
            depth=depth.astype(np.float16),
            confidence=confidence.astype(np.float16),
            expected=np.stack(expected).astype(np.float16),
            spent=spent,
        )


def expected_error(provider: MultiviewDepth, index: int, size: tuple[int, ...]) -> NDArray[np.float32]:
    """(h, w) what the stereo expects of the error of a keyframe's log depth; 1 where it completes nothing."""
    case = provider.inputs(index)
    return resample_nearest(complete(case, "cpu")[1], *size) if case is not None else np.ones(size, np.float32)


def in_unit_of_poses(sequence: Sequence, provider: DepthProvider) -> list[DepthEstimate]:
    """The depths of all frames, after one scale by the sparse points."""
    provider.fit(sequence.frames)
    found = {f.id: provider.estimate(f) for f in sequence.frames}
    scale = measure_scale(sequence, sequence.frames, lambda f: found[f.id])
    return [scale.in_backbone_unit(estimate) for estimate in found.values()]


def table(folder: Path, seeds: list[int], names: list[str]) -> None:
    """A row a kind of room, then all, then the worst room; figures of each name beside each other."""
    rows: dict[int, dict[str, NDArray]] = {}
    kinds = {}
    for seed in seeds:
        clip = Clip.load(folder / f"{seed}.npz")
        truth, unsure = clip.truth.astype(np.float32), None
        kinds[seed], rows[seed] = clip.kind, {}
        for name in names:
            with np.load(folder / "depth" / name / f"{seed}.npz", allow_pickle=False) as held:
                depth, confidence = held["depth"].astype(np.float32), held["confidence"].astype(np.float32)
                expected, spent = held["expected"] if "expected" in held else 1 - confidence, float(held["spent"])
            unsure = confidence < SURE if unsure is None else unsure
            rows[seed][name] = np.array([*figures(depth, expected, truth, unsure), spent])
    for kind in sorted(set(kinds.values())):
        _print(f"{kind} ({list(kinds.values()).count(kind)})", [rows[s] for s in seeds if kinds[s] == kind], np.mean)
    _print(f"all ({len(seeds)})", list(rows.values()), np.mean)
    _print("worst", list(rows.values()), np.max)
    if len(names) > 1:
        old, new = (np.stack([r[n] for r in rows.values()]) for n in names)
        better = [(new[:, k] <= old[:, k] * 1.001).sum() for k in (1, 4)]
        print(f"rooms not worse: L1 {better[0]}, unsure pixels {better[1]} of {len(seeds)}")
        ratio = new.mean(0) / old.mean(0)
        print(f"new / old: L1 {ratio[1]:.3f}, error of unsure pixels {ratio[4]:.3f}, sure pixels off {ratio[3]:.3f}")


COLUMNS = (
    "unsure %",
    "L1 cm",
    "off %",
    "sure off %",
    "unsure error %",
    "unsure off %",
    "<2% off %",
    "<2% %",
    "L1 %",
    "CPU s",
)


def figures(depth: NDArray, expected: NDArray, truth: NDArray, unsure: NDArray) -> tuple[float, ...]:
    """Of a room, as COLUMNS; "unsure error" is the mean of |log depth ratio|, at most 1; "<2% off": of the pixels
    whose expected error is below 2 % those that are off, "<2%": how many they are; "L1 %": of the median depth."""
    known = truth > 0
    unsure = unsure & known
    shown = np.where(depth > 0, depth, 1e-3)
    error = np.minimum(np.abs(np.log(shown[known] / truth[known])), 1)
    metres, off, guess = np.abs(depth - truth)[known], error > np.log(1 + OFF), unsure[known]
    sure, to_confidence = ~guess, expected[known] < 0.02
    shares = [100 * guess.mean(), 100 * metres.mean(), 100 * off.mean(), 100 * off[sure].mean()]
    guesses, of_median = [100 * error[guess].mean(), 100 * off[guess].mean()], metres.mean() / np.median(truth[known])
    return (*shares, *guesses, 100 * off[to_confidence].mean(), 100 * to_confidence.mean(), 100 * of_median)


def _print(title: str, rows: list[dict[str, NDArray]], summary: object) -> None:
    print(title)
    for name in rows[0]:
        values = summary(np.stack([r[name] for r in rows]), axis=0)  # type: ignore[operator]
        print(f"  {name:12s}", "  ".join(f"{c} {v:.2f}" for c, v in zip(COLUMNS, values, strict=True)), flush=True)


def main() -> None:
    """Parse, do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "measure", "table", "video", "walk", "learn"))
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--set", choices=SETS, default="choose")
    parser.add_argument("--network", type=float, default=0, metavar="PERCENT", help="measure it fused with a network")
    parser.add_argument("--alone", action="store_true", help="that network without the stereo")
    parser.add_argument("--rooms", type=int, default=0, help="only the first so many of the set")
    parser.add_argument("--package", type=Path, help="the .deb file of the furniture")
    parser.add_argument("--seconds", type=float, default=560, help="of learning, the making of rooms included")
    parser.add_argument("--workers", type=int, default=1, help="processes that make rooms to learn from")
    parser.add_argument("--pause", type=float, default=0, help="seconds until a pause; the next call goes on")
    parser.add_argument("--start", type=Path, metavar="NPZ", help="weights to learn on from")
    parser.add_argument("--skip", type=int, default=0, help="rooms of the set `learn` that are left out")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    if given.what == "learn":
        first, count = SETS["learn"]
        furniture(str(given.folder), str(given.package or ""))
        seeds = range(first + given.skip, first + count)
        return print(learn(given.folder, seeds, given.seconds, given.workers, given.start, given.pause))
    if given.what == "video":
        return make_videos(given.folder, given.set, given.package, given.rooms)
    if given.what == "walk":
        return make_walks(given.folder, given.set, given.package, given.rooms)
    seeds = seeds_of(given.folder, given.set, given.what == "make", given.package, given.rooms)
    if given.what == "measure":
        measure(given.folder, seeds, *given.names, given.network, given.alone)
    elif given.what == "table":
        table(given.folder, seeds, given.names)


if __name__ == "__main__":
    main()
