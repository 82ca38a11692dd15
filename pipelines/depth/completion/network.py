"""The network that weighs candidate depths by their evidence and by what lies around.

It learned on made rooms, then on these and on real recordings with measured depth (`docs/method.md`).

Each candidate of a pixel is read by itself, then what all of them say of the pixel goes with colours, sure depths and
their confidence through a U-Net (Ronneberger et al., MICCAI 2015), and comes back as the context in which each
candidate gets its probability, a correction and a spread. So a pixel's depth is a mixture of Laplace distributions, one
around each corrected candidate and one that the context gives by itself.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from ....formats.tensors import load_arrays
from ...geometry.voxels import to_lab
from ...system.jit import kernel
from ...system.unet import UNet
from .evidence import (
    FEATURES,
    KINDS,
    LEAST_NUMBER,
    OF_CANDIDATE,
    STEP_OF_NUMBERS,
    Array,
    CompletionInputs,
    HalfResKeyframe,
    invert,
)
from .fill import SURE

WEIGHTS = Path(__file__).parent / "weights.npz"
_PLANES, _BESIDE = 10, 3
"""Of an image's input, and numbers that a candidate has by its depth beside the evidence."""
_COLUMNS = (OF_CANDIDATE, FEATURES - OF_CANDIDATE, _BESIDE, len(KINDS))
_HIDDEN, _CONTEXT, _BROUGHT = 48, 24, 16
_WIDTHS = (30, 45, 60, 90)
_MOST_CORRECTION = 0.2
"""Log depth by which a candidate is moved at most."""
_NEVER = -30.0
_ALIKE = 0.02
_TEMPERATURE = 2.0
"""Log probabilities are divided by it: a network is surer of what it learned on than of others."""
_BLOCK = 1024
"""Pixels whose candidates are read at once."""


@dataclass(frozen=True)
class Inputs:
    """What the network reads of one keyframe: planes (10, h, w); of the P unsure pixels flat indices (P,), evidence of
    their candidates (P, K, OF_CANDIDATE) and places (P, OF_PLACE) as of `CompletionInputs`, which candidates there are
    (P, K) and their log inverse depths (P, K) over the keyframe's median, whose logarithm is `reference`; flat indices
    of all unsure pixels (U,) and who speaks for each, None where these are the P."""

    planes: Tensor
    pixels: Tensor
    evidence: Tensor
    place: Tensor
    real: Tensor
    logs: Tensor
    reference: float
    unsure: Tensor | None = None
    speaker: Tensor | None = None


@dataclass(frozen=True)
class Mixture:
    """Log probabilities, log inverse depths over the reference and log spreads (P, K + 1) of P pixels; and the log
    spread (h, w) of what is sure."""

    log_share: Tensor
    logs: Tensor
    log_spread: Tensor
    log_scale_known: Tensor


def inputs_of(inputs: CompletionInputs, device: str = "cpu") -> Inputs:
    """Bring a keyframe's inputs to the network's form."""
    own, sure, known_inverse_depth = inputs.own, inputs.sure, inputs.known_inverse_depth
    reference = float(np.log(_lower_median(known_inverse_depth[known_inverse_depth > 0])))
    colors = own.lab / np.array([50, 30, 30], np.float32) - np.array([1, 0, 0], np.float32)
    relative = (_relative(known_inverse_depth, reference), _relative(own.inverse, reference))
    planes = np.stack([
        *np.moveaxis(colors, -1, 0), *relative, own.inverse > 0, own.confidence, sure,
        _relative(inputs.lent, reference), np.log10(own.contrast + 1e-7) / 4 + 1,
    ]).astype(np.float32)  # fmt: skip
    inverse = inputs.inverse
    real = inverse > 0
    logs = np.where(real, np.log(np.maximum(inverse, 1e-9)) - np.float32(reference), np.float32(0))
    arrays = (planes, inputs.pixels, inputs.evidence, inputs.place, real, logs, inputs.unsure, inputs.speaker)
    tensors = [torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays]
    planes_, pixels, evidence, place, there, of, unsure, speaker = tensors
    return Inputs(planes_, pixels, evidence, place, there, of, reference, unsure, speaker)


def numbers_of(kept: Tensor) -> Tensor:
    """Bring evidence from bytes back to numbers."""
    return kept.float() * STEP_OF_NUMBERS + LEAST_NUMBER


def compare(logs: Tensor, real: Tensor) -> Tensor:
    """Return (P, K, 3) of log inverse depths (P, K): share of the candidates that are as good as it, difference to
    their mean, and depth."""
    count = real.sum(1, keepdim=True).clamp(min=1)
    alike = (((logs[:, :, None] - logs[:, None]).abs() < _ALIKE) & real[:, None]).sum(2) / count
    apart = ((logs - (logs * real).sum(1, keepdim=True) / count) * 3).clamp(-2, 2)
    return torch.stack([alike, apart, logs.clamp(-2, 2)], -1) * real[..., None]


def _relative(inverse: Array, reference: float) -> Array:
    known = np.log(np.maximum(inverse, 1e-9)) - np.float32(reference)
    return np.where(inverse > 0, np.clip(known, -2, 2), np.float32(0))


def _lower_median(values: Array) -> np.float32:
    middle = (len(values) - 1) // 2
    return np.float32(np.partition(values, middle)[middle])


class CompletionNetwork(UNet):
    """The network; 439,022 weights."""

    def __init__(self) -> None:
        super().__init__(_PLANES + _BROUGHT + 1, _WIDTHS, 2 * _CONTEXT + 1)
        self.first = nn.Linear(FEATURES + _BESIDE + len(KINDS), _HIDDEN)
        self.around, self.bring = nn.Linear(2 * _HIDDEN, _HIDDEN), nn.Linear(_HIDDEN, _BROUGHT)
        self.pixel = nn.Linear(_HIDDEN, _CONTEXT, bias=False)
        self.second, self.last = nn.Linear(_HIDDEN, _CONTEXT), nn.Linear(_CONTEXT, 3)
        self.alone = nn.Linear(_CONTEXT, 3)

    def read(self, evidence: Tensor, place: Tensor, by_depth: Tensor, real: Tensor) -> Tensor:
        """Read candidates by numbers (P, K, OF_CANDIDATE), (P, OF_PLACE) and (P, K, 3): (P, K, hidden), 0 where there
        is none."""
        of_candidate, of_place, of_depth, of_kind = self.first.weight.split(_COLUMNS, 1)
        hidden = torch.cat([evidence, by_depth], -1) @ torch.cat([of_candidate, of_depth], 1).T
        # No ones and zeros are made for the kinds, and the place is read once.
        hidden = hidden.add_(of_kind.T).add_(F.linear(place, of_place, self.first.bias)[:, None])
        return hidden.relu_() * real[..., None]

    def gather(self, hidden: Tensor, real: Tensor) -> Tensor:
        """Gather what all candidates of a pixel say of it: (P, hidden)."""
        mean = hidden.sum(1) / real.sum(1, keepdim=True).clamp(min=1)
        return self.around(torch.cat([mean, hidden.amax(1)], -1)).relu_()

    def find_context(self, planes: Tensor, pixels: Tensor, gathered: Tensor) -> Tensor:
        """Return (B, h, w, 2 C + 1): context for candidates and for the image's own depth, log spread of what is sure;
        of B keyframes' planes (B, 10, h, w) and what was gathered at pixels (P,) of all of them, one after another."""
        batch, _, height, width = planes.shape
        brought = planes.new_zeros(batch * height * width, _BROUGHT + 1)
        values = F.relu(self.bring(gathered)).to(planes.dtype)
        brought[pixels] = torch.cat([values, torch.ones_like(values[:, :1])], 1)
        x = torch.cat([planes, brought.reshape(batch, height, width, -1).permute(0, 3, 1, 2)], 1)
        return self(x).permute(0, 2, 3, 1)

    def weigh(self, hidden: Tensor, real: Tensor, gathered: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log probability, correction of the log inverse depth and log spread (P, K + 1) of the candidates and
        of the image's own depth, which starts from the first candidate; context (P, 2 C) as of `find_context`."""
        mine = context[:, :_CONTEXT] + self.pixel(gathered)
        each = self.last(self.second(hidden).add_(mine[:, None]).relu_()).float()
        whole = self.alone((context[:, _CONTEXT:] + mine).relu_()).float()
        share = torch.cat([each[..., 0].masked_fill(~real, _NEVER), whole[:, :1]], 1)
        moved = torch.cat([_MOST_CORRECTION * torch.tanh(each[..., 1]), whole[:, 1:2].clamp(-3, 3)], 1)
        spread = torch.cat([each[..., 2], whole[:, 2:]], 1).clamp(-4.8, -0.3)
        return torch.log_softmax(share, 1), moved, spread

    @staticmethod
    def _numbers(given: Inputs, block: slice) -> tuple[Tensor, Tensor, Tensor]:
        by_depth = compare(given.logs[block], given.real[block])
        return numbers_of(given.evidence[block]), numbers_of(given.place[block]), by_depth

    @torch.no_grad()
    def evaluate(self, given: Inputs) -> Mixture:
        """Weigh the candidates of one keyframe."""
        starts = range(0, max(len(given.pixels), 1), _BLOCK)  # one block, empty, where every pixel is sure
        blocks = [slice(first, first + _BLOCK) for first in starts]
        read = [self.read(*self._numbers(given, b), given.real[b]) for b in blocks]
        gathered = [self.gather(h, given.real[b]) for h, b in zip(read, blocks, strict=True)]
        planes = given.planes[None].contiguous(memory_format=torch.channels_last)
        features, at = torch.cat(gathered), given.pixels
        if given.unsure is not None and given.speaker is not None:
            features, at = features[given.speaker], given.unsure
        around = self.find_context(planes, at, features)[0]
        context = around[..., :-1].flatten(0, 1)[given.pixels]
        parts = [self.weigh(h, given.real[b], g, context[b]) for h, g, b in zip(read, gathered, blocks, strict=True)]
        share, moved, spread = (torch.cat(column) for column in zip(*parts, strict=True))
        logs = torch.cat([given.logs, given.logs[:, :1]], 1) + moved
        return Mixture(torch.log_softmax(share / _TEMPERATURE, 1), logs, spread, around[..., -1].float().clamp(-5.8, 0))


@torch.no_grad()
def mixture_median(found: Mixture) -> tuple[Tensor, Tensor]:
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
    network.eval()
    network.fuse()
    # Convolutions take two thirds of the time with the channels last.
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if device == "cpu":
        network.lighten()
    return network.to(device)


_SMOOTHED, _LIKE_DEPTH = 1 / 75, 0.06
"""Standard deviation of a bilateral filter as a part of the longer side, and in log depth: what neighbouring pixels
take from other rows and columns differs by a few per cent."""
HALF, TWICE = np.diag([0.5, 0.5, 1]), np.diag([2.0, 2, 1, 1])
"""Bring a warp between pictures to half their size."""


def halved(depth: Array, confidence: Array, image: NDArray[np.uint8], contrast: Array) -> HalfResKeyframe:
    """Reduce depth, confidence and contrast (H, W) to the size of the image (H/2, W/2, 3), both rounded up."""
    height, width = image.shape[:2]
    inverse, sure = np.zeros((height, width), np.float32), np.full((height, width), -1, np.float32)
    _keep_surest(depth, confidence, inverse, sure)
    small = np.asarray(cv2.resize(contrast, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    return HalfResKeyframe(inverse, sure, image, to_lab(image), small)


@kernel
def _keep_surest(depth: Array, confidence: Array, inverse: Array, sure: Array) -> None:
    """Of up to four pixels each: inverse depth and confidence of the surest, the first of those."""
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            own = confidence[y, x] if depth[y, x] > 0 else np.float32(0)
            if own > sure[y // 2, x // 2]:
                sure[y // 2, x // 2] = own
                inverse[y // 2, x // 2] = np.float32(1) / depth[y, x] if depth[y, x] > 0 else np.float32(0)


def complete(inputs: CompletionInputs, device: str) -> tuple[Array, Array]:
    """Return depth (h, w) at half the size, own, borrowed or completed, and its expected error in log depth (h, w)."""
    inverse = np.where(inputs.from_other_views, inputs.lent, inputs.own.inverse)
    given = inputs_of(inputs, device)
    found = weigh_candidates(given, device)
    error = np.exp(found.log_scale_known.cpu().numpy())
    if len(inputs.pixels):
        logs, risk = (x.cpu().numpy() for x in mixture_median(found))
        inverse.ravel()[inputs.unsure] = np.exp(logs + np.float32(given.reference))[inputs.speaker]
        smooth = cv2.bilateralFilter(np.log(np.maximum(inverse, 1e-9)), -1, _LIKE_DEPTH, max(inverse.shape) * _SMOOTHED)
        inverse = np.where(inputs.sure, inverse, np.exp(smooth))
        error.ravel()[inputs.unsure] = risk[inputs.speaker]
    return invert(inverse), error


def completed_keyframe(inputs: CompletionInputs, device: str) -> HalfResKeyframe:
    """Return the keyframe as others may ask it: what is not its own is unsure, however good."""
    own = inputs.own.confidence
    return replace(inputs.own, inverse=invert(complete(inputs, device)[0]), confidence=own * (own >= SURE))
