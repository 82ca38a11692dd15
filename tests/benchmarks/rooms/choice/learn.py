"""Learning of the choice between candidate depths, from made rooms alone. Needs torch."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from msgs_slam.pipelines.depth.stereo.fill import SURE

from ..clip import Clip, worn
from .candidates import KINDS
from .completion import Completion
from .evidence import FEATURES

_PIXELS, _EVERY = 700, 2
"""Pixels of a keyframe, and keyframes of a clip, that are learned from."""
_WIDTHS = (48, 24)
_EPOCHS, _BATCH, _RATE = 10, 1024, 3e-3
_HIDDEN = 0.1
_HARD = 0.03
_SHARP = 0.04
"""Log depth: candidates so near to the truth are right."""


def gather(
    folder: Path, seeds: list[int], worse: bool
) -> tuple[NDArray[np.float16], NDArray[np.float16], NDArray[np.int64]]:
    """Evidence (P, K, F), the error of each candidate in log depth (P, K), and the room of each pixel; every second
    room by a worse camera where that is wanted."""
    parts: list[tuple[NDArray, NDArray, NDArray]] = []
    for seed in seeds:
        path = folder / "cases" / f"{seed}.npz"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            evidence, errors = _of_room(folder, seed, worse and seed % 2 == 1)
            np.savez(path, evidence=evidence, errors=errors)
        with np.load(path, allow_pickle=False) as held:
            parts.append((held["evidence"], held["errors"], np.full(len(held["errors"]), seed)))
    evidence, errors, rooms = (np.concatenate(c) for c in zip(*parts, strict=True))
    return evidence, errors, rooms


def _of_room(folder: Path, seed: int, as_worn: bool) -> tuple[NDArray[np.float16], NDArray[np.float16]]:
    clip, rng = Clip.load(folder / f"{seed}.npz"), np.random.default_rng(seed)
    clip = worn(clip, seed) if as_worn else clip
    provider, frames = clip.stereo(folder / "stereo" / f"{seed}{'w' * as_worn}")
    completion = Completion(provider)
    evidence, errors = [np.zeros((0, len(KINDS), FEATURES), np.float16)], [np.zeros((0, len(KINDS)), np.float16)]
    for index in range(seed // 2 % _EVERY, len(frames), _EVERY):
        case = completion.case(index)
        if case is None:
            continue
        truth = half_truth(clip.truth[index])
        if as_worn:  # one scale for each view, as a run has one
            sure = case.own.confidence >= SURE
            truth = truth / np.median((truth * case.own.inverse)[sure])
        truth = truth.ravel()[case.found.pixels]
        known = np.flatnonzero(truth > 0)
        rows = np.sort(rng.choice(known, min(_PIXELS, len(known)), replace=False))
        evidence.append(case.evidence[rows].astype(np.float16))
        inverse = np.maximum(case.found.inverse[rows], 1e-9)
        errors.append(np.clip(-np.log(inverse * truth[rows, None]), -4, 4).astype(np.float16))
    return np.concatenate(evidence), np.concatenate(errors)


def half_truth(depth: NDArray) -> NDArray[np.float32]:
    """(H, W) to half the size: the nearest of four pixels, as a choice among surfaces, never a mean across them."""
    height, width = (-(-s // 2) for s in depth.shape)
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = np.pad(depth.astype(np.float32), pad, mode="edge").reshape(height, 2, width, 2)
    middle = np.sort(blocks.transpose(0, 2, 1, 3).reshape(height, width, 4), axis=-1)[..., 1]
    return np.asarray(middle, np.float32)


class Judge(nn.Module):
    """What `ChoiceModel` evaluates."""

    def __init__(self, features: int, kinds: int) -> None:
        super().__init__()
        one, two = _WIDTHS
        self.first, self.around = nn.Linear(features + kinds, one), nn.Linear(one, one)
        self.second, self.context = nn.Linear(one, two), nn.Linear(one, two, bias=False)
        self.last = nn.Linear(two, 1)

    def forward(self, features: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
        """Logits (P, K) of candidates (P, K, F), of which some are `real` (P, K)."""
        size = features.shape[-1]
        hidden = features @ self.first.weight[:, :size].T + (self.first.weight[:, size:].T + self.first.bias)
        hidden = torch.relu(hidden) * real[..., None]
        mean = hidden.sum(1) / real.sum(1).clamp(min=1)[:, None]
        around = self.context(torch.relu(self.around(mean)))
        return self.last(torch.relu(self.second(hidden) + around[:, None]))[..., 0].masked_fill(real == 0, -30.0)

    def weights(self) -> dict[str, NDArray[np.float16]]:
        """As `ChoiceModel` takes them."""
        named = {
            "w1": self.first.weight.T, "b1": self.first.bias, "wc": self.around.weight.T, "bc": self.around.bias,
            "w2": self.second.weight.T, "b2": self.second.bias, "w2c": self.context.weight.T,
            "w3": self.last.weight.T, "b3": self.last.bias,
        }  # fmt: skip
        return {k: np.ascontiguousarray(v.detach().numpy()).astype(np.float16) for k, v in named.items()}


def learn(
    evidence: NDArray[np.float16], errors: NDArray[np.float16], rooms: NDArray[np.int64], tested: NDArray[np.bool_]
) -> Judge:
    """Learn from the pixels that are not `tested`; print the error of the fill and of the choice on those that are. A
    room counts more where the fill is good: nothing may be lost there."""
    torch.manual_seed(0)
    model = Judge(evidence.shape[2], evidence.shape[1])
    data, truth = torch.from_numpy(evidence), torch.from_numpy(errors)
    room = np.unique(rooms, return_inverse=True)[1]
    hardness = np.bincount(room, np.minimum(np.abs(errors[:, 0].astype(np.float64)), 1)) / np.bincount(room)
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
            loss = (weight[rows] * _loss(model, data[rows].float(), truth[rows].float())).mean()
            loss.backward()
            optimizer.step()
            schedule.step()
    print(_tested(model, data, truth, test), flush=True)
    return model


def _loss(model: Judge, features: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """How far what is likely is from the right candidates (cross-entropy). A part of the evidence is hidden at random:
    rooms are seldom like those that were made."""
    real = (features != 0).any(-1).float()
    logits = model(features * (torch.rand(len(features), 1, features.shape[2]) > _HIDDEN), real)
    wanted = torch.softmax((-error.abs() / _SHARP).masked_fill(real == 0, -1e4), 1)
    return -(wanted * torch.log_softmax(logits, 1)).sum(1)


def _tested(model: Judge, data: torch.Tensor, truth: torch.Tensor, rows: torch.Tensor) -> str:
    """Errors of the fill, of the candidate of the least expected error, and of the best."""
    chosen = []
    for part in rows.split(8192):
        with torch.no_grad():
            features, error = data[part].float(), truth[part].float()
            real = (features != 0).any(-1).float()
            share = torch.softmax(model(features, real), 1)
            risk = ((error[:, :, None] - error[:, None]).abs().clamp(max=1) * share[:, None]).sum(2) + 9 * (1 - real)
            chosen.append(error.abs().gather(1, risk.argmin(1)[:, None])[:, 0])
    off = truth[rows].float().abs().clamp(max=1)
    cells = (("fill", off[:, 0]), ("chosen", torch.cat(chosen).clamp(max=1)), ("best", off.min(1).values))
    return "  ".join(f"{n} {e.mean():.4f} ({100 * (e > np.log(1.05)).float().mean():.1f} % off)" for n, e in cells)
