"""Learning of the choice between candidate depths, from made rooms alone. Needs torch."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from msgs_slam.pipelines.depth.stereo.fill import SURE

from ..clip import Clip, worn
from .completion import Case, Completion

_PIXELS, _EVERY = 600, 2
"""Pixels of a keyframe, and keyframes of a clip, that are learned from."""
_WIDTHS = (64, 32)
_EPOCHS, _BATCH, _RATE = 12, 1024, 3e-3
_HARD, _MISS = 0.03, 0.1
_SHARP = 0.02
"""Log depth: candidates so near to the truth are right."""


def gather(
    folder: Path, seeds: list[int], as_worn: bool = False
) -> tuple[NDArray[np.float16], NDArray[np.float32], NDArray[np.int64]]:
    """Evidence (P, K, F), the error of each candidate in log depth (P, K), at most 1, and the room of each pixel; by a
    worse camera where `as_worn`, then rooms have negative numbers."""
    parts: list[tuple[NDArray, NDArray, NDArray]] = []
    for seed in seeds:
        path = folder / "cases" / f"{seed}{'w' * as_worn}.npz"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            evidence, errors = _of_room(folder, seed, as_worn)
            np.savez(path, evidence=evidence, errors=errors)
        with np.load(path, allow_pickle=False) as held:
            parts.append((held["evidence"], held["errors"], np.full(len(held["errors"]), -seed if as_worn else seed)))
    evidence, errors, rooms = (np.concatenate(c) for c in zip(*parts, strict=True))
    return evidence, errors, rooms


def _of_room(folder: Path, seed: int, as_worn: bool) -> tuple[NDArray[np.float16], NDArray[np.float32]]:
    clip, rng = Clip.load(folder / f"{seed}.npz"), np.random.default_rng(seed)
    clip = worn(clip, seed) if as_worn else clip
    provider, frames = clip.stereo(folder / "stereo" / f"{seed}{'w' * as_worn}")
    completion = Completion(provider)
    evidence, errors = [np.zeros((0, 17, 37), np.float16)], [np.zeros((0, 17), np.float32)]
    for index in range(seed % _EVERY, len(frames), _EVERY):
        case = completion.case(index)
        if case is None:
            continue
        truth = half_truth(clip.truth[index]).ravel()[case.found.pixels]
        known = np.flatnonzero(truth > 0)
        if as_worn:  # one scale for each view, as a run has one
            sure = case.known.confidence >= SURE
            truth = truth / np.median((half_truth(clip.truth[index]) * case.known.inverse)[sure])
        rows = np.sort(rng.choice(known, min(_PIXELS, len(known)), replace=False))
        evidence.append(case.evidence[rows].astype(np.float16))
        errors.append(errors_of(case, truth)[rows])
    return np.concatenate(evidence), np.concatenate(errors)


def half_truth(depth: NDArray) -> NDArray[np.float32]:
    """(H, W) to half the size: the nearest of four pixels, as a choice among surfaces, never a mean across them."""
    height, width = (-(-s // 2) for s in depth.shape)
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = np.pad(depth.astype(np.float32), pad, mode="edge").reshape(height, 2, width, 2)
    middle = np.sort(blocks.transpose(0, 2, 1, 3).reshape(height, width, 4), axis=-1)[..., 1]
    return np.asarray(middle, np.float32)


def errors_of(case: Case, truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(P, K) |log depth ratio| of every candidate, at most 1; 1 for none."""
    inverse = case.found.inverse
    error = np.abs(np.log(np.maximum(inverse, 1e-6) * np.maximum(truth, 1e-3)[:, None]))
    return np.where(inverse > 0, np.minimum(error, 1), 1).astype(np.float32)


class Judge(nn.Module):
    """What `ChoiceModel` evaluates."""

    def __init__(self, features: int, kinds: int) -> None:
        super().__init__()
        one, two = _WIDTHS
        self.kinds = kinds
        self.first, self.around = nn.Linear(features + kinds, one), nn.Linear(one, one)
        self.second, self.context = nn.Linear(one, two), nn.Linear(one, two, bias=False)
        self.last = nn.Linear(two, 2)

    def forward(self, features: torch.Tensor, real: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits and log errors (P, K)."""
        size = features.shape[-1]
        hidden = features @ self.first.weight[:, :size].T + (self.first.weight[:, size:].T + self.first.bias)
        hidden = torch.relu(hidden) * real[..., None]
        mean = hidden.sum(1) / real.sum(1).clamp(min=1)[:, None]
        around = torch.relu(self.around(mean))
        out = self.last(torch.relu(self.second(hidden) + self.context(around)[:, None]))
        return out[..., 0].masked_fill(real == 0, -30.0), out[..., 1].clamp(-8, 0)

    def weights(self) -> dict[str, NDArray[np.float16]]:
        """As `ChoiceModel` takes them."""
        named = {
            "w1": self.first.weight.T, "b1": self.first.bias, "wc": self.around.weight.T, "bc": self.around.bias,
            "w2": self.second.weight.T, "b2": self.second.bias, "w2c": self.context.weight.T,
            "w3": self.last.weight.T, "b3": self.last.bias,
        }  # fmt: skip
        return {k: np.ascontiguousarray(v.detach().numpy()).astype(np.float16) for k, v in named.items()}


def learn(
    evidence: NDArray[np.float16], errors: NDArray[np.float32], rooms: NDArray[np.int64], tested: NDArray[np.bool_]
) -> Judge:
    """Learn from the pixels that are not `tested`; print the error of the fill and of the choice on those that are. A
    room counts more where the fill is good: nothing may be lost there."""
    torch.manual_seed(0)
    model = Judge(evidence.shape[2], evidence.shape[1])
    data, truth = torch.from_numpy(evidence), torch.from_numpy(errors)
    room = np.unique(rooms, return_inverse=True)[1]
    hardness = np.bincount(room, errors[:, 0]) / np.bincount(room)
    counts = 1 / (hardness + _HARD)
    weight = torch.from_numpy((counts / counts.mean()).astype(np.float32)[room])
    train, test = (torch.from_numpy(np.flatnonzero(x)) for x in (~tested, tested))
    optimizer = torch.optim.AdamW(model.parameters(), lr=_RATE, weight_decay=1e-4)
    steps = _EPOCHS * (len(train) // _BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=steps + 1, pct_start=0.1)
    for _ in range(_EPOCHS):
        order = train[torch.randperm(len(train))]
        for first in range(0, len(order) - _BATCH + 1, _BATCH):
            rows = order[first : first + _BATCH]
            optimizer.zero_grad()
            loss = _loss(model, data[rows].float(), truth[rows], weight[rows])
            loss.backward()
            optimizer.step()
            schedule.step()
    print(_tested(model, data, truth, test), flush=True)
    return model


def _loss(model: Judge, features: torch.Tensor, error: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Expected error of the choice, how far it is from the right candidates, and the likelihood of the errors as
    predicted (exponential, so that their mean is learned)."""
    real = (features != 0).any(-1).float()
    logits, predicted = model(features, real)
    share = torch.softmax(logits, 1)
    wanted = torch.softmax((-error / _SHARP).masked_fill(real == 0, -1e4), 1)
    right = -(wanted * torch.log_softmax(logits, 1)).sum(1)
    likelihood = ((error + 1e-3) * torch.exp(-predicted) + predicted) * real
    missed = (share * (error + _MISS * error / (error + _SHARP))).sum(1)
    return (weight * (5 * missed + 0.3 * right)).mean() + 0.1 * likelihood.sum() / real.sum()


def _tested(model: Judge, data: torch.Tensor, truth: torch.Tensor, rows: torch.Tensor) -> str:
    with torch.no_grad():
        parts = [model(f := data[r].float(), (f != 0).any(-1).float())[0].argmax(1) for r in rows.split(8192)]
    error = truth[rows]
    chosen = error.gather(1, torch.cat(parts)[:, None])[:, 0] if parts else error[:, 0]
    cells = (("fill", error[:, 0]), ("chosen", chosen), ("best", error.min(1).values))
    return "  ".join(f"{n} {e.mean():.4f} ({100 * (e > np.log(1.05)).float().mean():.1f} % off)" for n, e in cells)
