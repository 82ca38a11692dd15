"""Learning of the network that completes depth, from made rooms alone: all but one core make rooms, the stereo on them
and its candidates, while the network learns from what there is, best on a card.

Rooms come in the order of their seeds, but how many there are when a step is taken depends on the machine: a second
learning gives a network as good as the first, not the same bytes.
"""

import math
import multiprocessing
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.depth.completion.candidates import KINDS
from msgs_slam.pipelines.depth.completion.evidence import Case
from msgs_slam.pipelines.depth.completion.fill import SURE
from msgs_slam.pipelines.depth.completion.network import CompletionNetwork, Inputs, inputs_of
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth

from .clip import make_clip, worn
from .furniture import furniture

SIZES = ((384, 288), (448, 336), (448, 336), (512, 384), (576, 432), (336, 448))
_LEAST_PIXELS = 200
_BATCH, _RATE, _DECAY = 8, 3e-3, 2e-3
_HIDDEN, _RECOLORED, _COLORLESS = 0.1, 0.15, 0.08
"""Shares of the evidence that are hidden, how far colours are changed, and how often they are taken away: rooms are
seldom like those that were made."""
_RISK, _DOUBT = 4.0, 0.3
"""Weight of the expected error beside the likelihood, and of the spread of what is sure."""
_SPARED_BYTES = 9e9
_SWAPPED = {"left": "right", "right": "left", "left line": "right line", "right line": "left line"}
_MIRRORED = [KINDS.index(_SWAPPED.get(kind, kind)) for kind in KINDS]
_UNKNOWN = 99.0
Array = NDArray[np.float32]


# rooms ----------------------------------------------------------------------------------------------------------


def half_truth(depth: NDArray) -> Array:
    """(H, W) to half the size: the nearest of four pixels, as a choice among surfaces, never a mean across them."""
    height, width = (-(-s // 2) for s in depth.shape)
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = np.pad(depth.astype(np.float32), pad, mode="edge").reshape(height, 2, width, 2)
    middle = np.sort(blocks.transpose(0, 2, 1, 3).reshape(height, width, 4), axis=-1)[..., 1]
    return np.asarray(middle, np.float32)


def room_cases(seed: int, folder: Path) -> list[tuple[Case, Array]]:
    """Film the room of a seed, three of five by a worse camera, and gather the cases of its keyframes with the true
    depth (h, w) at half the size; none where there is no place to walk."""
    rng, as_worn = np.random.default_rng(seed + 5), seed % 5 in (1, 2, 3)
    clip = make_clip(seed, furniture(str(folder)), SIZES[int(rng.integers(len(SIZES)))])
    if clip is None:
        return []
    clip = worn(clip, seed, shaken=0.5) if as_worn else clip
    maps = folder / "stereo" / str(seed)
    try:
        provider, frames = clip.stereo(maps)
        if (as_worn or seed % 5 == 4) and rng.random() < 0.75:
            _match_falsely(provider, seed)
        found = [(provider.first_case(k), half_truth(clip.truth[k])) for k in range(len(frames))]
    finally:
        shutil.rmtree(maps, ignore_errors=True)
    return [
        (case, _scaled(case, truth) if as_worn else truth)
        for case, truth in found
        if case is not None and len(case.found.pixels) >= _LEAST_PIXELS
    ]


def _scaled(case: Case, truth: Array) -> Array:
    """The truth in the unit of the stereo: one scale for each view, as a run has one."""
    sure = (case.own.confidence >= SURE) & (truth > 0)
    return np.asarray(truth / np.median((truth * case.own.inverse)[sure]), np.float32) if sure.any() else truth * 0


def _match_falsely(provider: MultiviewDepth, seed: int) -> None:
    """Put what a real camera's matches are wrong in into the fused depths: patches of what is unsure, and small ones of
    what is sure."""
    plain, known = provider._fused, dict[int, tuple[Array, Array]]()
    unsure_share = np.random.default_rng(seed).uniform(0, 0.5)
    sure_share = np.random.default_rng(seed + 1).choice([0, 0.02, 0.04, 0.07])

    def fused(index: int) -> tuple[Array, Array]:
        if index not in known:
            depth, confidence = plain(index)
            depth, r = depth.copy(), np.random.default_rng([seed, index])
            unsure = (confidence < SURE) & (depth > 0)
            for size in (40, 12):
                patch, shape = _patches(r, depth.shape, size, min(0.95, unsure_share * r.uniform(0.5, 1.5) / 2))
                patch &= unsure
                depth[patch] *= np.exp(r.uniform(0.1, 0.8) * shape[patch] + r.normal() * 0.15)
            for size in (24, 8) if sure_share else ():
                patch, shape = _patches(r, depth.shape, size, sure_share / 2 * r.uniform(0.3, 1.7))
                patch &= ~unsure
                depth[patch] *= np.exp(r.uniform(0.06, 0.4) * np.sign(shape[patch]) * (0.3 + np.abs(shape[patch])))
            known[index] = depth, confidence
        return known[index]

    provider._fused = fused  # type: ignore[assignment]


def _patches(
    r: np.random.Generator, shape: tuple[int, ...], size: float, share: float
) -> tuple[NDArray[np.bool_], Array]:
    """Smooth patches over a share of an image (h, w), and a smooth field within ±1."""
    height, width = shape

    def noise() -> Array:
        few = r.normal(size=(max(2, int(height / size)), max(2, int(width / size)))).astype(np.float32)
        return np.asarray(cv2.resize(few, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)

    field = noise()
    return field > np.quantile(field, 1 - share), np.tanh(noise())


# examples -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Example:
    """A keyframe to learn from: the network's inputs; error (P, K) of each candidate's log inverse depth, where it is
    `known` (P,); and error (h, w) of what is sure, 99 where there is none. Where candidates are good it counts more."""

    given: Inputs
    error: Tensor
    known: Tensor
    sure_error: Tensor
    weight: float

    @classmethod
    def of(cls, arrays: dict[str, NDArray], device: str) -> "Example":
        """Load what `example_arrays` gave."""
        of = {name: torch.from_numpy(values).to(device) for name, values in arrays.items()}
        given = Inputs(*(of[n] for n in ("planes", "pixels", "features", "real", "logs")), 0.0)
        fill = of["error"][:, 0].abs().clamp(max=1)[of["known"]].float().mean()
        return cls(given, of["error"], of["known"], of["sure_error"], 1 / (float(fill) + 0.08))

    def mirrored(self) -> "Example":
        """Return it with left and right exchanged."""
        width = self.given.planes.shape[2]
        row, column = self.given.pixels // width, self.given.pixels % width
        by_kind = (self.given.features, self.given.real, self.given.logs, self.error)
        features, real, logs, error = (x[:, _MIRRORED] for x in by_kind)
        given = Inputs(self.given.planes.flip(2), row * width + width - 1 - column, features, real, logs, 0.0)
        return replace(self, given=given, error=error, sure_error=self.sure_error.flip(1))


def example_arrays(case: Case, truth: Array) -> dict[str, NDArray]:
    """Return what is kept of a case and its true depth (h, w)."""
    given = inputs_of(case)
    known = truth > 0
    wanted = np.where(known, -np.log(np.maximum(truth, 1e-6)) - np.float32(given.reference), np.float32(0))
    at, spoken = case.found.pixels, case.spoken
    relative = np.log(np.maximum(spoken, 1e-9)) - np.float32(given.reference)
    return {
        "planes": given.planes.numpy().astype(np.float16),
        "pixels": at.astype(np.int32),
        "features": given.features.numpy().astype(np.float16),
        "real": given.real.numpy(),
        "logs": given.logs.numpy().clip(-6, 6),
        "error": (given.logs.numpy() - wanted.ravel()[at][:, None]).clip(-6, 6),
        "known": known.ravel()[at],
        "sure_error": np.where(known & (spoken > 0), relative - wanted, _UNKNOWN).astype(np.float16),
    }


def _leave_examples(job: tuple[int, Path, float]) -> None:
    """Leave a file of each keyframe of a room, unless the time is over."""
    seed, folder, deadline = job
    if time.time() > deadline:
        return
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for k, (case, truth) in enumerate(room_cases(seed, folder)):
        arrays = example_arrays(case, truth)
        if arrays["known"].sum() >= _LEAST_PIXELS // 2:
            save_arrays(folder / "examples" / f"{seed}_{k}.npz", arrays, compress=False)


class _Examples:
    """The examples that are there, by size of their images; files are taken away once they are in memory."""

    def __init__(self, folder: Path, device: str) -> None:
        self._folder, self._device = folder, device
        self.of_size: dict[tuple[int, ...], list[Example]] = {}

    def take(self, most: int) -> None:
        """Take up to so many more."""
        for path in sorted(self._folder.glob("[0-9]*.npz"))[:most]:
            if self._device == "cuda" and torch.cuda.mem_get_info()[0] < _SPARED_BYTES:
                return
            example = Example.of(load_arrays(path), self._device)
            path.unlink()
            self.of_size.setdefault(tuple(example.given.planes.shape[1:]), []).append(example)

    def batch(self, rng: np.random.Generator) -> list[Example]:
        """Draw examples of one size, every second one mirrored; none while there are too few."""
        groups = [g for g in self.of_size.values() if len(g) >= _BATCH]
        if not groups:
            return []
        counts = np.array([len(g) for g in groups], float)
        group = groups[rng.choice(len(groups), p=counts / counts.sum())]
        drawn = [group[k] for k in rng.choice(len(group), _BATCH, replace=False)]
        return [e.mirrored() if rng.random() < 0.5 else e for e in drawn]


# learning -------------------------------------------------------------------------------------------------------


def learn(folder: Path, seeds: range, seconds: float, workers: int, start: Path | None) -> Path:
    """Learn for so many seconds while rooms are made for the first three quarters of them; return the file of the
    weights, as it comes with the program. From the weights of `start`, if given, by a third of the rate."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    begun, target = time.time(), folder / "weights.npz"
    (folder / "examples").mkdir(parents=True, exist_ok=True)
    deadline = begun + 0.75 * seconds
    _leave_examples((seeds[0], folder, deadline))  # furniture and kernels are ready before there are processes
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        made = pool.imap_unordered(_leave_examples, [(s, folder, deadline) for s in seeds[1:]])
        network = CompletionNetwork()
        if start is not None:
            network.load_state_dict(_tensors(start), strict=False)
        _fit(network.to(device), _Examples(folder / "examples", device), begun, seconds, 1 / 3 if start else 1.0)
        for _ in made:
            pass
    states = {k: v.cpu().numpy() for k, v in network.state_dict().items() if not k.endswith("num_batches_tracked")}
    save_arrays(target, {k: v if "running" in k else v.astype(np.float16) for k, v in states.items()})
    return target


def _tensors(weights: Path) -> dict[str, Tensor]:
    return {k: torch.from_numpy(v.astype(np.float32)) for k, v in load_arrays(weights).items()}


def _fit(network: CompletionNetwork, examples: _Examples, begun: float, seconds: float, slower: float) -> None:
    optimizer = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_DECAY)
    rng, steps, told, losses = np.random.default_rng(0), 0, begun, list[float]()
    device = next(network.parameters()).device.type
    while (done := (time.time() - begun) / seconds) < 1:
        examples.take(4)
        batch = examples.batch(rng)
        if not batch:
            time.sleep(0.5)
            continue
        rate = done / 0.04 if done < 0.04 else 0.5 * (1 + math.cos(math.pi * (done - 0.04) / 0.96))
        for group in optimizer.param_groups:
            group["lr"] = max(_RATE * slower * rate, 1e-6)
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast(device, dtype=torch.bfloat16, enabled=device == "cuda"):
            loss = _loss(network, batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        steps += 1
        losses += [float(loss.detach())] if steps % 10 == 1 else []
        if time.time() - told > 30:
            told, count = time.time(), sum(map(len, examples.of_size.values()))
            recent = np.mean(losses[-30:]) if losses else math.nan
            print(f"{told - begun:.0f} s, {steps} steps, {count} keyframes, loss {recent:.3f}", flush=True)


def _loss(network: CompletionNetwork, batch: list[Example]) -> Tensor:
    """Negative log likelihood of the truth and expected error, and likelihood of the error of what is sure."""
    real = torch.cat([e.given.real for e in batch])
    features = _partly_hidden(torch.cat([e.given.features for e in batch]).float(), [len(e.known) for e in batch])
    hidden = network.read(features, real)
    gathered = network.gather(hidden, real)
    counts, pixels = [len(e.known) for e in batch], [e.given.pixels.long() for e in batch]
    planes = torch.stack([_recolored(e.given.planes.float()) for e in batch])
    around = network.look_around(planes, pixels, list(gathered.split(counts)))
    context = torch.cat([a[:-1].flatten(1)[:, at].T for a, at in zip(around, pixels, strict=True)])
    share, moved, log_spread = network.weigh(hidden, real, gathered, context)
    error = torch.cat([e.error for e in batch]).float()
    apart = (torch.cat([error, error[:, :1]], 1) + moved).abs()
    counted = torch.tensor([e.weight for e in batch])
    counted = (counted / counted.mean()).clamp(max=3).repeat_interleave(torch.tensor(counts)).to(apart.device)
    counted = counted * torch.cat([e.known for e in batch])
    unlikely = -torch.logsumexp(share - apart.clamp(max=2) / log_spread.exp() - log_spread, 1)
    expected = (share.exp() * apart.clamp(max=1)).sum(1)
    total = (counted * (unlikely + _RISK * expected)).sum() / counted.sum().clamp(min=1)
    off, log_doubt = torch.stack([e.sure_error for e in batch]).float(), around[:, -1].float().clamp(-5.8, 0)
    there = off < _UNKNOWN / 2
    return total + _DOUBT * (off.abs().clamp(max=0.5) / log_doubt.exp() + log_doubt)[there].mean()


def _partly_hidden(features: Tensor, counts: list[int]) -> Tensor:
    """Take kinds of evidence away, at random from a keyframe as a whole and from single pixels."""
    device, kinds, half = features.device, features.shape[-1], _HIDDEN / 2
    of_frame = (torch.rand(len(counts), kinds, device=device) > half).float()
    of_frame = of_frame.repeat_interleave(torch.tensor(counts, device=device), 0)
    return features * of_frame[:, None] * (torch.rand(len(features), 1, kinds, device=device) > half)


def _recolored(planes: Tensor) -> Tensor:
    """Change lightness, colour, noise and contrast of an image's planes (10, h, w)."""
    device, by = planes.device, _RECOLORED
    lightness = planes[:1] * (1 + by * torch.randn(1, device=device)) + 0.5 * by * torch.randn(1, device=device)
    gain = (1 + 2 * by * torch.randn(2, 1, 1, device=device)).clamp(min=0)
    colors = torch.cat([lightness, planes[1:3] * gain + 0.5 * by * torch.randn(2, 1, 1, device=device)])
    colors = colors + 0.15 * by * torch.rand(1, device=device) * torch.randn_like(colors)
    contrast = planes[9:] + 0.3 * by * torch.randn(1, device=device)
    return torch.cat([colors * (torch.rand(1, device=device) >= _COLORLESS), planes[3:9], contrast])
