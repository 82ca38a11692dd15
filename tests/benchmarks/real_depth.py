"""The completion network before real cameras: how good it is there, and learning on from recordings with true depth.

    python tests/benchmarks/real_depth.py cases DIR RUN=TRUTH ...        runs of `shape.py --recordings`, to DIR/NAME
    python tests/benchmarks/real_depth.py hidden DIR RUN ...             cases of what a run itself is sure of, no truth
    python tests/benchmarks/real_depth.py judge DIR [NAME ...] [--weights NPZ] [--temperature 2]
    python tests/benchmarks/real_depth.py learn DIR NAME ... --made ROOMS --out NPZ [--steps 300]

A case is a keyframe's evidence and true depth, in the unit of the stereo by one scale for each keyframe. `judge` says
of the pixels without a sure match: mean |log depth ratio| (at most 1), share off by more than 5 %, true over expected
error where less than 4 % is expected. `learn` starts from the weights that come with the program, with their
statistics of batches; every third step is of a recording, the others of the rooms of `rooms learn`. With one thread
the same files give the same bytes. What ships may learn only from recordings whose licence allows it; the others
judge. `hidden` takes balls in space out of all keyframes, as large as what is unsure and where there is least contrast
among what is sure, and asks for their depth back.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from shape import true_depths

from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.depth.completion import network as completion
from msgs_slam.pipelines.depth.completion.fill import SURE
from msgs_slam.pipelines.depth.completion.network import CompletionNetwork, mixture_median
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import resample_nearest, unproject, unproject_depth
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.proxy.selection import STEREO_PLANES
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.benchmarks.rooms.learning import (
    Example,
    example_arrays,
    half_truth,
    load_weights,
    loss_of,
    rate_at,
    save_weights,
    scaled,
)

_MOST, _LEAST_PIXELS = 28, 200
"""Keyframes of a recording, and pixels of one whose truth is known."""
_BATCH, _RATE, _WARMED = 2, 3e-4, 0.05
_SURE, _OFF = 0.04, math.log(1.05)
_CENTRES = 60
"""Places of a keyframe that a ball may be around; one is drawn."""
_CHANCE, _CHANCE_PX = 0.15, 12
"""Of a chance match: sd in log depth, and the pixels over which it is alike."""


def leave_cases(run: RunFolder, truth: Path | None, target: Path) -> None:
    """Leave a file for each of at most `_MOST` keyframes with truth, as of both rounds of the completion; without a
    file of the truth, it is what was hidden."""
    calibration, config = run.load(CALIBRATION), load_config().proxy
    camera = calibration.intrinsics.at_most(config.max_side)
    sequence = Sequence(run.load(FRAMES), calibration, camera, run.load(BACKBONE), run.image)
    matches = target / "stereo"
    matches.mkdir(parents=True, exist_ok=True)
    stereo = MultiviewDepth(sequence, config.stereo_side, STEREO_PLANES, lambda: matches, 1, SilentProgress())
    stereo.precompute(sequence.frames)
    stereo.all_speak = True
    index = {int(f): k for k, f in enumerate(run.load(BACKBONE).frame_ids)}
    truths = hide_balls(stereo, run.load(BACKBONE)) if truth is None else true_depths(run, truth)
    known = [i for i in index if i in truths]
    for i in known[:: -(-len(known) // _MOST)]:
        full = resample_nearest(truths[i].astype(np.float32), stereo.camera.height, stereo.camera.width)
        for round_, inputs in enumerate((stereo.first_inputs(index[i]), stereo.inputs(index[i]))):
            if inputs is not None:
                small = half_truth(full)
                arrays = example_arrays(inputs, small if truth is None else scaled(inputs, small))
                save_arrays(target / f"{i:06d}_{round_}.npz", arrays, compress=False)


def hide_balls(stereo: MultiviewDepth, model: SparseModel) -> dict[int, NDArray]:
    """Make the stereo unsure of all that lies in balls in space, in every keyframe, its depth there a chance match's;
    return the hidden depths (H, W), 0 elsewhere, by frame id."""
    rng, camera = np.random.default_rng(0), stereo.camera
    places, radii, fused = list[NDArray](), list[NDArray](), {}
    for k in range(len(model.frame_ids)):
        depth, confidence = fused[k] = stereo._fused(k)
        sure = (confidence >= SURE) & (depth > 0)
        if sure.sum() < _LEAST_PIXELS or sure.all():
            continue
        # A disk is on average a third of its radius deep.
        deep = cv2.distanceTransform((~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)[~sure]
        contrast = stereo._contrast(k)
        plain = np.flatnonzero(sure & (contrast <= np.median(contrast[sure])))
        at = rng.choice(plain, _CENTRES)
        xy, z = np.stack([at % camera.width, at // camera.width], 1) + 0.5, depth.ravel()[at].astype(np.float64)
        places.append(se3.transform(se3.inverse(model.cam_from_world[k]), unproject(xy, z, camera)))
        radii.append(3 * rng.choice(deep, _CENTRES) * z / camera.fx)
    centres, radius = np.concatenate(places), np.concatenate(radii)
    kept = rng.permutation(len(centres))[: -(-len(centres) // _CENTRES)]
    tree, reach = cKDTree(centres[kept]), radius[kept]
    hidden, known = {}, {}
    for k, (depth, confidence) in fused.items():
        seen = unproject_depth(depth, camera).reshape(-1, 3)
        apart, ball = tree.query(se3.transform(se3.inverse(model.cam_from_world[k]), seen), 4)
        inside = (apart < reach[ball]).any(1).reshape(depth.shape) & (depth > 0)
        few = rng.normal(size=(camera.height // _CHANCE_PX + 2, camera.width // _CHANCE_PX + 2)).astype(np.float32)
        chance = depth * np.exp(_CHANCE * cv2.resize(few, depth.shape[::-1], interpolation=cv2.INTER_CUBIC))
        doubt = rng.choice(confidence[confidence < SURE], depth.shape) if (confidence < SURE).any() else 0 * depth
        hidden[int(model.frame_ids[k])] = np.where(inside & (confidence >= SURE), depth, np.float32(0))
        known[k] = np.where(inside, chance, depth), np.where(inside, np.minimum(doubt, confidence), confidence)
    stereo._fused = known.__getitem__  # type: ignore[assignment]
    return hidden


def load_cases(folder: Path, pattern: str) -> list[Example]:
    """Load those of a recording, in the order of their names; each counts alike."""
    return [case for _, case in _known(folder, pattern)]


def _known(folder: Path, pattern: str) -> Iterator[tuple[Path, Example]]:
    """Read the cases of whose unsure pixels enough are known, in the order of their names."""
    for path in sorted(folder.glob(pattern)):
        case = _read(path)
        if (~case.wanted.isnan()).sum() >= _LEAST_PIXELS:
            yield path, case


def _read(path: Path) -> Example:
    e = Example.of(load_arrays(path), "cpu")
    given = replace(e.given, planes=e.given.planes.float(), logs=e.given.logs.float(), pixels=e.given.pixels.long())
    return replace(e, given=given, weight=1.0)


def network_of(weights: Path | None) -> CompletionNetwork:
    """Load weights, those of the program by default, with layers as they learn."""
    network = CompletionNetwork()
    load_weights(network, weights or completion.WEIGHTS)
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def judge(network: CompletionNetwork, cases: list[Example]) -> tuple[float, float, float]:
    """Return error and share off of unsure pixels, and true over expected error of those expected to be good."""
    errors, expected = [], []
    for case in cases:
        logs, risk = mixture_median(network.evaluate(case.given))
        known = ~case.wanted.isnan()
        errors.append((logs - case.wanted).abs()[known].clamp(max=1).numpy())
        expected.append(risk[known].numpy())
    error, risk = np.concatenate(errors), np.concatenate(expected)
    sure = risk < _SURE
    return float(error.mean()), float((error > _OFF).mean()), float(error[sure].mean() / max(risk[sure].mean(), 1e-9))


def by_size(folder: Path, pattern: str = "*_[01].npz") -> list[list[Path]]:
    """List the cases that can make a batch: more than fit into memory together, so that they are read when drawn."""
    groups: dict[tuple[int, ...], list[Path]] = {}
    for path, case in _known(folder, pattern):
        groups.setdefault(tuple(case.given.planes.shape), []).append(path)
    return [g for g in groups.values() if len(g) >= _BATCH]


def learn(real: list[list[Path]], made: list[list[Path]], steps: int) -> CompletionNetwork:
    """Learn on from cases by size, `real` ones a recording each; see the top of this file."""
    torch.manual_seed(0)
    rng, network = np.random.default_rng(0), network_of(None)
    optimizer = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=2e-3)
    for step in range(steps):
        groups = made if made and step % 3 else real
        share = np.array([len(g) if groups is made else 1.0 for g in groups])
        group = groups[rng.choice(len(groups), p=share / share.sum())]
        batch = [_read(group[i]) for i in rng.choice(len(group), _BATCH, replace=False)]
        batch = [e.mirrored() if rng.random() < 0.5 else e for e in batch]
        for values in optimizer.param_groups:
            values["lr"] = max(_RATE * rate_at(step / steps, _WARMED), 1e-6)
        optimizer.zero_grad(set_to_none=True)
        loss = loss_of(network, batch)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        if step % 50 == 49:
            print(f"{step + 1} steps", flush=True)
    return network


def table(folder: Path, names: list[str], weights: Path | None, temperature: float) -> None:
    """Print a row a recording, by the second round."""
    completion._TEMPERATURE = temperature
    network, errors = network_of(weights), []
    for name in names or sorted(p.name for p in folder.iterdir() if p.is_dir()):
        error, off, ratio = judge(network, load_cases(folder / name, "*_1.npz"))
        errors.append(error)
        print(f"{name:24} error {error:.4f}  off {100 * off:.0f} %  true / expected {ratio:.2f}", flush=True)
    print(f"{'mean':24} error {np.mean(errors):.4f}")


def main() -> None:
    """Parse, do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("cases", "hidden", "judge", "learn"))
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--weights", type=Path, metavar="NPZ")
    parser.add_argument("--temperature", type=float, default=completion._TEMPERATURE)
    parser.add_argument("--made", type=Path, metavar="ROOMS", help="folder of `rooms learn`")
    parser.add_argument("--out", type=Path, metavar="NPZ")
    parser.add_argument("--steps", type=int, default=300)
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if given.what == "cases":
        for run, truth in (pair.split("=") for pair in given.names):
            leave_cases(RunFolder(Path(run)), Path(truth), given.folder / Path(run).stem)
    elif given.what == "hidden":
        for run in given.names:
            leave_cases(RunFolder(Path(run)), None, given.folder / Path(run).stem)
    elif given.what == "judge":
        table(given.folder, given.names, given.weights, given.temperature)
    else:
        real = [g for name in given.names for g in by_size(given.folder / name)]
        made = by_size(given.made / "examples", "[0-9]*.npz") if given.made else []
        save_weights(learn(real, made, given.steps), given.out)


if __name__ == "__main__":
    main()
