"""The network that weighs candidate depths by their evidence and by what lies around, learned on made rooms alone.

Each candidate of a pixel is read by itself, then what all of them say of the pixel goes with colours, sure depths and
their confidence through a U-Net (Ronneberger et al., MICCAI 2015), and comes back as the context in which each
candidate gets its probability, a correction and a spread. So a pixel's depth is a mixture of Laplace distributions, one
around each corrected candidate and one that the context gives by itself.
"""

import itertools
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ....formats.tensors import load_arrays
from .candidates import KINDS, Array
from .evidence import FEATURES, Case

WEIGHTS = Path(__file__).parent / "weights.npz"
_PLANES, _BESIDE = 10, 3
"""Of an image's input, and numbers that a candidate has by its depth beside the evidence."""
_HIDDEN, _CONTEXT, _BROUGHT = 48, 24, 16
_WIDTHS = (30, 45, 60, 90)
_MOST_CORRECTION = 0.2
"""Log depth by which a candidate is moved at most."""
_NEVER = -30.0
_ALIKE = 0.02
_SOFTENED = 2.0
"""Log probabilities are divided by it: a network is surer of made rooms, which it learned, than of others."""
_BLOCK = 2048
"""Pixels whose candidates are read at once."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of one keyframe: planes (10, h, w); of the P pixels that are not sure, flat indices (P,), what is known of
    their candidates (P, K, F), which of them there are (P, K) and log inverse depths (P, K) over the keyframe's median,
    whose logarithm is `reference`."""

    planes: Tensor
    pixels: Tensor
    features: Tensor
    real: Tensor
    logs: Tensor
    reference: float


@dataclass(frozen=True)
class Mixture:
    """Log probabilities, log inverse depths over the reference and log spreads (P, K + 1) of P pixels; and the log
    spread (h, w) of what is sure."""

    log_share: Tensor
    logs: Tensor
    log_spread: Tensor
    log_doubt: Tensor


def inputs_of(case: Case, device: str = "cpu") -> Inputs:
    """Bring a keyframe's case to the network's inputs."""
    own, sure, spoken = case.own, case.sure, case.spoken
    reference = float(np.log(_lower_median(spoken[spoken > 0])))
    colors = own.lab / np.array([50, 30, 30], np.float32) - np.array([1, 0, 0], np.float32)
    relative = (_relative(spoken, reference), _relative(own.inverse, reference))
    planes = np.stack([
        *np.moveaxis(colors, -1, 0), *relative, own.inverse > 0, own.confidence, sure,
        _relative(case.lent, reference), np.log10(own.contrast + 1e-7) / 4 + 1,
    ]).astype(np.float32)  # fmt: skip
    inverse = case.found.inverse
    real = inverse > 0
    logs = np.where(real, np.log(np.maximum(inverse, 1e-9)) - np.float32(reference), np.float32(0))
    count = np.maximum(real.sum(1, keepdims=True), 1)
    alike = np.stack([((np.abs(logs[:, [k]] - logs) < _ALIKE) & real).sum(1) for k in range(len(KINDS))], 1) / count
    apart = np.clip((logs - (logs * real).sum(1, keepdims=True) / count) * 3, -2, 2)
    beside = np.stack([alike, apart, np.clip(logs, -2, 2)], -1) * real[..., None]
    features = np.concatenate([case.evidence, beside], -1, dtype=np.float32)
    arrays = (planes, case.found.pixels, features, real, logs)
    planes_, pixels, known, there, of = (torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays)
    return Inputs(planes_, pixels, known, there, of, reference)


def _relative(inverse: Array, reference: float) -> Array:
    known = np.log(np.maximum(inverse, 1e-9)) - np.float32(reference)
    return np.where(inverse > 0, np.clip(known, -2, 2), np.float32(0))


def _lower_median(values: Array) -> np.float32:
    middle = (len(values) - 1) // 2
    return np.float32(np.partition(values, middle)[middle])


class _Block(nn.Module):
    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.one = nn.Conv2d(before, after, 3, padding=1, bias=False)
        self.two = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.n1, self.n2 = nn.BatchNorm2d(after), nn.BatchNorm2d(after)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.n2(self.two(F.relu(self.n1(self.one(x))))))


class CompletionNetwork(nn.Module):
    """The network; 439,022 weights."""

    def __init__(self) -> None:
        super().__init__()
        kinds, w = len(KINDS), _WIDTHS
        self.first = nn.Linear(FEATURES + _BESIDE + kinds, _HIDDEN)
        self.around, self.bring = nn.Linear(2 * _HIDDEN, _HIDDEN), nn.Linear(_HIDDEN, _BROUGHT)
        self.pixel = nn.Linear(_HIDDEN, _CONTEXT, bias=False)
        self.second, self.last = nn.Linear(_HIDDEN, _CONTEXT), nn.Linear(_CONTEXT, 3)
        self.alone = nn.Linear(_CONTEXT, 3)
        self.down = nn.ModuleList(_Block(a, b) for a, b in zip((_PLANES + _BROUGHT + 1, *w), w, strict=False))
        self.up = nn.ModuleList(_Block(b + a, a) for a, b in itertools.pairwise(w))
        self.out = nn.Conv2d(w[0], 2 * _CONTEXT + 1, 1)

    def read(self, features: Tensor, real: Tensor) -> Tensor:
        """Read candidates by their features (P, K, F): (P, K, hidden), 0 where there is none."""
        weight, size = self.first.weight, features.shape[-1]
        # The last columns are of the kinds: no ones and zeros are made for them.
        hidden = features @ weight[:, :size].T + (weight[:, size:].T + self.first.bias)
        return F.relu(hidden) * real[..., None]

    def gather(self, hidden: Tensor, real: Tensor) -> Tensor:
        """Gather what all candidates of a pixel say of it: (P, hidden)."""
        mean = hidden.sum(1) / real.sum(1, keepdim=True).clamp(min=1)
        return F.relu(self.around(torch.cat([mean, hidden.max(1).values], -1)))

    def look_around(self, planes: Tensor, pixels: list[Tensor], gathered: list[Tensor]) -> Tensor:
        """Return (B, 2 C + 1, h, w): context for candidates and for the image's own depth, log spread of what is sure;
        of B keyframes' planes and what was gathered at their pixels."""
        height, width = planes.shape[2:]
        brought = []
        for at, values in zip(pixels, gathered, strict=True):
            image = planes.new_zeros(height * width, _BROUGHT + 1)
            image[at, :-1] = F.relu(self.bring(values)).to(image.dtype)
            image[at, -1] = 1
            brought.append(image.T.reshape(-1, height, width))
        x = torch.cat([planes, torch.stack(brought)], 1)
        x = F.pad(x, (0, -width % 8, 0, -height % 8), mode="replicate")
        stack = []
        for level, down in enumerate(self.down):
            x = down(x if level == 0 else F.avg_pool2d(x, 2))
            stack.append(x)
        stack.pop()
        for up in reversed(self.up):
            x = up(torch.cat([F.interpolate(x, scale_factor=2, mode="nearest"), stack.pop()], 1))
        return self.out(x)[:, :, :height, :width]

    def weigh(self, hidden: Tensor, real: Tensor, gathered: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log probability, correction of the log inverse depth and log spread (P, K + 1) of the candidates and
        of the image's own depth, which starts from the first candidate; context (P, 2 C) as of `look_around`."""
        mine = context[:, :_CONTEXT] + self.pixel(gathered)
        each = self.last(F.relu(self.second(hidden) + mine[:, None])).float()
        alone = self.alone(F.relu(context[:, _CONTEXT:] + mine)).float()
        share = torch.cat([each[..., 0].masked_fill(~real, _NEVER), alone[:, :1]], 1)
        moved = torch.cat([_MOST_CORRECTION * torch.tanh(each[..., 1]), alone[:, 1:2].clamp(-3, 3)], 1)
        spread = torch.cat([each[..., 2], alone[:, 2:]], 1).clamp(-4.8, -0.3)
        return torch.log_softmax(share, 1), moved, spread

    @torch.no_grad()
    def evaluate(self, given: Inputs) -> Mixture:
        """Weigh the candidates of one keyframe."""
        starts = range(0, max(len(given.pixels), 1), _BLOCK)  # one block, empty, where every pixel is sure
        blocks = [slice(first, first + _BLOCK) for first in starts]
        read = [self.read(given.features[b], given.real[b]) for b in blocks]
        gathered = [self.gather(h, given.real[b]) for h, b in zip(read, blocks, strict=True)]
        planes = given.planes[None].contiguous(memory_format=torch.channels_last)
        around = self.look_around(planes, [given.pixels], [torch.cat(gathered)])[0]
        context = around[:-1].flatten(1)[:, given.pixels].T
        parts = [self.weigh(h, given.real[b], g, context[b]) for h, g, b in zip(read, gathered, blocks, strict=True)]
        share, moved, spread = (torch.cat(column) for column in zip(*parts, strict=True))
        logs = torch.cat([given.logs, given.logs[:, :1]], 1) + moved
        return Mixture(torch.log_softmax(share / _SOFTENED, 1), logs, spread, around[-1].float().clamp(-5.8, 0))


@torch.no_grad()
def middle_of(found: Mixture) -> tuple[Tensor, Tensor]:
    """Return the weighted median (P,) of each pixel's log inverse depth, which has the least expected error, and that
    error (P,), at most 1."""
    share = found.log_share.exp()
    logs, order = found.logs.sort(1)
    before = (share.gather(1, order).cumsum(1) < 0.5).sum(1, keepdim=True)
    middle = logs.gather(1, before.clamp(max=logs.shape[1] - 1))
    apart, spread = (found.logs - middle).abs(), found.log_spread.exp()
    return middle[:, 0], (share * (apart + spread * torch.exp(-apart / spread)).clamp(max=1)).sum(1)


_ONE_AT_A_TIME = Lock()
"""Held while the network runs: it has threads of its own, and those of two callers can wait for each other."""


@torch.no_grad()
def weigh_candidates(given: Inputs, device: str) -> Mixture:
    """Weigh the candidates of one keyframe by the network that comes with the program."""
    with _ONE_AT_A_TIME:
        return load_network(device).evaluate(given)


@cache
def load_network(device: str = "cpu") -> CompletionNetwork:
    """Load the network that comes with the program."""
    network = CompletionNetwork()
    weights = {k: torch.from_numpy(v.astype(np.float32)) for k, v in load_arrays(WEIGHTS).items()}
    network.load_state_dict(weights, strict=False)  # how many batches were seen is not kept
    # Convolutions take two thirds of the time with the channels last.
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network.eval().to(device)
