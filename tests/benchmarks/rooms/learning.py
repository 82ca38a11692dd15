"""Learning of the network that completes depth, from made rooms alone: processes make rooms, the stereo on them and its
candidates, while the network learns from what there is, best on a card.

Rooms come in the order of their seeds, but how many there are when a step is taken depends on the machine: a second
learning gives a network as good as the first, not the same bytes.
"""

import math
import multiprocessing
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.depth.completion.evidence import KINDS, CompletionInputs
from msgs_slam.pipelines.depth.completion.fill import SURE
from msgs_slam.pipelines.depth.completion.network import CompletionNetwork, Inputs, compare, inputs_of, numbers_of
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth

from .clip import make_clip, worn
from .furniture import furniture

SIZES = ((384, 288), (448, 336), (448, 336), (640, 480), (640, 480), (640, 360), (360, 640))
_KEPT = 9
"""Keyframes of a room that are learned from: there is more to learn from other rooms."""
_LEAST_PIXELS = 200
_BATCH, _RATE, _DECAY = 8, 3e-3, 2e-3
_HIDDEN, _RECOLORED, _COLORLESS = 0.1, 0.15, 0.08
"""Shares of the evidence that are hidden, how far colours are changed, and how often they are taken away: rooms are
seldom like those that were made."""
_RISK, _DOUBT = 4.0, 0.3
"""Weight of the expected error beside the likelihood, and of the spread of what is sure."""
_SPARED_BYTES = 9e9
_AGAIN = 2 / 3
"""Share of the keyframes whose neighbours are asked completed, by the network that the program has."""
_MADE_UNTIL = 0.72
"""Part of the time in which rooms are made."""
_FEWEST, _READERS = 150, 3
"""Examples to begin with, and threads that read them."""
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


def room_cases(seed: int, folder: Path, device: str = "cpu") -> list[tuple[CompletionInputs, Array]]:
    """Film the room of a seed, three of five by a worse camera, and gather the cases of its keyframes, by the stereo on
    a device, with the true depth (h, w) at half the size; none where there is no place to walk."""
    rng, as_worn = np.random.default_rng(seed + 5), seed % 5 in (1, 2, 3)
    clip = make_clip(seed, furniture(str(folder)), SIZES[int(rng.integers(len(SIZES)))])
    if clip is None:
        return []
    clip = worn(clip, seed, shaken=0.5) if as_worn else clip
    maps = folder / "stereo" / str(seed)
    try:
        provider, frames = clip.stereo(maps, device)
        provider.all_speak = True
        if (as_worn or seed % 5 == 4) and rng.random() < 0.75:
            _match_falsely(provider, seed)
        kept = np.sort(rng.permutation(len(frames))[:_KEPT])
        cases = [provider.inputs(k) if rng.random() < _AGAIN else provider.first_inputs(k) for k in kept.tolist()]
    finally:
        shutil.rmtree(maps, ignore_errors=True)
    truths = [half_truth(clip.truth[k]) for k in kept]
    return [
        (case, scaled(case, truth) if as_worn else truth)
        for case, truth in zip(cases, truths, strict=True)
        if case is not None and len(case.pixels) >= _LEAST_PIXELS
    ]


def scaled(case: CompletionInputs, truth: Array) -> Array:
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
    """A keyframe to learn from: the network's inputs; log inverse depth (P,) that is wanted, NaN where it is not known;
    and error (h, w) of what is sure, 99 where there is none. Where candidates are good it counts more."""

    given: Inputs
    wanted: Tensor
    sure_error: Tensor
    weight: float

    @classmethod
    def of(cls, arrays: dict[str, NDArray], device: str) -> "Example":
        """Load what `example_arrays` gave."""
        of = {name: torch.from_numpy(values).to(device) for name, values in arrays.items() if name != "weight"}
        given = Inputs(*(of[n] for n in ("planes", "pixels", "evidence", "place", "real", "logs")), 0.0)
        return cls(given, of["wanted"], of["sure_error"], float(arrays["weight"]))

    def mirrored(self) -> "Example":
        """Return it with left and right exchanged."""
        given, order = self.given, torch.tensor(_MIRRORED, device=self.wanted.device)
        width = given.planes.shape[2]
        evidence, real, logs = (x[:, order] for x in (given.evidence, given.real, given.logs))
        pixels = given.pixels + width - 1 - 2 * (given.pixels % width)
        turned = Inputs(given.planes.flip(2), pixels, evidence, given.place, real, logs, 0.0)
        return replace(self, given=turned, sure_error=self.sure_error.flip(1))


def example_arrays(case: CompletionInputs, truth: Array) -> dict[str, NDArray]:
    """Return what is kept of a case and its true depth (h, w)."""
    given = inputs_of(case)
    known, at, known_inverse_depth = truth > 0, case.pixels, case.known_inverse_depth
    wanted = -np.log(np.maximum(truth, 1e-6)) - np.float32(given.reference)
    relative = np.log(np.maximum(known_inverse_depth, 1e-9)) - np.float32(given.reference)
    logs, of_pixel = given.logs.numpy().clip(-6, 6), np.where(known, wanted, np.float32(np.nan)).ravel()[at]
    fill = np.abs(logs[:, 0] - of_pixel).clip(max=1)
    return {
        "planes": given.planes.numpy().astype(np.float16),
        "pixels": at.astype(np.int32),
        "evidence": case.evidence,
        "place": case.place,
        "real": given.real.numpy(),
        "logs": logs.astype(np.float16),
        "wanted": of_pixel.clip(-6, 6),
        "sure_error": np.where(known & (known_inverse_depth > 0), relative - wanted, _UNKNOWN).astype(np.float16),
        "weight": np.array(1 / (np.nanmean(fill) + 0.08)),
    }


def _leave_examples(job: tuple[int, Path, float, str]) -> None:
    """Leave a file of each keyframe of a room, unless the time is over or an earlier call left some."""
    seed, folder, deadline, device = job
    if time.time() > deadline or any((folder / "examples").glob(f"{seed}_*.npz")):
        return
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for k, (case, truth) in enumerate(room_cases(seed, folder, device)):
        if (truth.ravel()[case.pixels] > 0).sum() >= _LEAST_PIXELS // 2:
            save_arrays(folder / "examples" / f"{seed}_{k}.npz", example_arrays(case, truth), compress=False)


class Examples:
    """The examples that are there, by size of their images; read by threads as files come."""

    def __init__(self, folder: Path, device: str, fewest: int = _FEWEST) -> None:
        self._folder, self._device, self._known, self._lock = folder, device, set[Path](), threading.Lock()
        self._fewest = fewest
        self.of_size: dict[tuple[int, ...], list[Example]] = {}
        self.count, self._over = 0, threading.Event()
        self._readers = ThreadPoolExecutor(_READERS)
        self._reading = [self._readers.submit(self._read) for _ in range(_READERS)]

    def close(self) -> None:
        """Stop reading. Raises what a reader raised."""
        self._over.set()
        for reader in self._reading:
            reader.result()
        self._readers.shutdown()

    def _read(self) -> None:
        waiting: list[Path] = []
        while not self._over.is_set():
            with self._lock:
                if not waiting:
                    there = {p for p in self._folder.glob("[0-9]*.npz") if p.stem.replace("_", "").isdigit()}
                    waiting = sorted(there - self._known)[:20]
                    self._known.update(waiting)
            full = self._device == "cuda" and torch.cuda.mem_get_info()[0] < _SPARED_BYTES
            if not waiting or full:
                self._over.wait(1.0)
                continue
            example = Example.of(load_arrays(waiting.pop()), self._device)
            with self._lock:
                self.of_size.setdefault(tuple(example.given.planes.shape[1:]), []).append(example)
                self.count += 1

    def batch(self, rng: np.random.Generator) -> list[Example]:
        """Draw examples of one size, every second one mirrored; none while there are too few."""
        groups = [list(g) for g in list(self.of_size.values()) if len(g) >= _BATCH]
        if not groups or self.count < self._fewest:
            return []
        counts = np.array([len(g) for g in groups], float)
        group = groups[rng.choice(len(groups), p=counts / counts.sum())]
        drawn = [group[k] for k in rng.choice(len(group), _BATCH, replace=False)]
        return [e.mirrored() if rng.random() < 0.5 else e for e in drawn]


# learning -------------------------------------------------------------------------------------------------------


def learn(folder: Path, seeds: range, seconds: float, workers: int, start: Path | None, pause: float) -> Path | None:
    """Learn for so many seconds in all, while rooms are made for the first of them; return the file of the weights, as
    it comes with the program. From the weights of `start`, if given, by a half of the rate. Pauses after `pause`
    seconds of this call (None), if not 0; the next call goes on with the rooms that there are."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    target, state = folder / "weights.npz", folder / "paused.npz"
    (folder / "examples").mkdir(parents=True, exist_ok=True)
    network = CompletionNetwork()
    if start is not None:
        load_weights(network, start)
    with closing(Examples(folder / "examples", device)) as examples:
        fit = Fit(network.to(device), examples, seconds, 0.5 if start else 1.0)
        if state.exists():
            fit.load(load_arrays(state))
        # Each has a context of its own on the card: no copies of this process.
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            deadline = time.time() + _MADE_UNTIL * seconds - fit.done
            made = pool.imap_unordered(_leave_examples, [(s, folder, deadline, device) for s in seeds])
            is_over = fit.run(pause or math.inf)
            for _ in made if is_over else ():
                pass
    if not is_over:
        save_arrays(state, fit.state())
        return None
    state.unlink(missing_ok=True)
    save_weights(network, target)
    return target


def load_weights(network: CompletionNetwork, path: Path) -> None:
    """Load what `save_weights` wrote."""
    arrays = load_arrays(path)
    network.load_state_dict({k: torch.from_numpy(v.astype(np.float32)) for k, v in arrays.items()}, strict=False)


def save_weights(network: CompletionNetwork, path: Path) -> None:
    """Write weights as they come with the program."""
    states = {k: v.cpu().numpy() for k, v in network.state_dict().items() if not k.endswith("num_batches_tracked")}
    save_arrays(path, {k: v if "running" in k else v.astype(np.float16) for k, v in states.items()})


def rate_at(part: float, warmed: float) -> float:
    """Return the share of the largest rate at a part of the learning: it grows until `warmed`, then falls as a cosine
    does."""
    return part / warmed if part < warmed else 0.5 * (1 + math.cos(math.pi * (part - warmed) / (1 - warmed)))


class Fit:
    """A network that learns, its optimiser, and the seconds that are done."""

    def __init__(self, network: CompletionNetwork, examples: Examples, seconds: float, slower: float) -> None:
        self.network, self.done = network, 0.0
        self._examples, self._seconds, self._rate = examples, seconds, _RATE * slower
        self._device = next(network.parameters()).device.type
        fused = self._device == "cuda"
        self._optimizer = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_DECAY, fused=fused)

    def state(self) -> dict[str, NDArray]:
        """What `load` goes on from."""
        arrays = {f"network/{k}": v.cpu().numpy() for k, v in self.network.state_dict().items()}
        for k, values in self._optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{k}/{name}": v.cpu().numpy() for name, v in values.items()}
        return {**arrays, "done": np.array(self.done)}

    def load(self, arrays: dict[str, NDArray]) -> None:
        """Go on from what `state` gave."""
        self.done = float(arrays["done"])
        of = {k: torch.from_numpy(np.array(v)) for k, v in arrays.items()}
        self.network.load_state_dict({k.removeprefix("network/"): v for k, v in of.items() if k.startswith("network/")})
        moments: dict[int, dict[str, Tensor]] = {}
        for key in (k for k in of if k.startswith("optimizer/")):
            _, number, name = key.split("/")
            moments.setdefault(int(number), {})[name] = of[key]
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})

    def run(self, most: float) -> bool:
        """Learn until the time is over (True), or for at most so many seconds."""
        begun, before, rng = time.time(), self.done, np.random.default_rng(int(self.done))
        steps, told, losses = 0, begun, list[float]()
        while self.done < self._seconds:
            self.done = before + time.time() - begun
            if self.done - before > most:
                return False
            batch = self._examples.batch(rng)
            if not batch:
                time.sleep(0.5)
                continue
            loss = self._step(batch)
            steps += 1
            losses += [float(loss)] if steps % 20 == 1 else []
            if time.time() - told > 30:
                told, count = time.time(), self._examples.count
                recent = np.mean(losses[-30:])
                print(f"{self.done:.0f} s, {steps} steps, {count} keyframes, loss {recent:.3f}", flush=True)
        return True

    def _step(self, batch: list[Example]) -> Tensor:
        for group in self._optimizer.param_groups:
            group["lr"] = max(self._rate * rate_at(self.done / self._seconds, 0.04), 1e-6)
        self._optimizer.zero_grad(set_to_none=True)
        with torch.autocast(self._device, dtype=torch.bfloat16, enabled=self._device == "cuda"):
            loss = loss_of(self.network, batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        return loss.detach()


def loss_of(network: CompletionNetwork, batch: list[Example]) -> Tensor:
    """Negative log likelihood of the truth and expected error, and likelihood of the error of what is sure."""
    counts, area, device = [len(e.wanted) for e in batch], batch[0].given.planes[0].numel(), batch[0].wanted.device
    of_frame = torch.repeat_interleave(
        torch.arange(len(batch), device=device), torch.tensor(counts, device=device), output_size=sum(counts)
    )
    joined = {n: torch.cat([getattr(e.given, n) for e in batch]) for n in ("evidence", "place", "real", "logs")}
    real, logs = joined["real"], joined["logs"].float()
    wanted, pixels = torch.cat([e.wanted for e in batch]), torch.cat([e.given.pixels for e in batch]).long()
    known, at = ~wanted.isnan(), pixels + of_frame * area
    evidence, place = (numbers_of(joined[n]) for n in ("evidence", "place"))
    numbers = [_partly_hidden(x, of_frame, len(batch)) for x in (evidence, place, compare(logs, real))]
    hidden = network.read(*numbers, real)
    gathered = network.gather(hidden, real)
    planes = _recolored(torch.stack([e.given.planes for e in batch]).float())
    around = network.find_context(planes.contiguous(memory_format=torch.channels_last), at, gathered)
    share, moved, log_spread = network.weigh(hidden, real, gathered, around[..., :-1].flatten(0, 2)[at])
    error = logs - torch.where(known, wanted, 0)[:, None]
    apart = (torch.cat([error, error[:, :1]], 1) + moved).abs()
    counted = torch.tensor([e.weight for e in batch])
    counted = (counted / counted.mean()).clamp(max=3).to(device)[of_frame] * known
    unlikely = -torch.logsumexp(share - apart.clamp(max=2) / log_spread.exp() - log_spread, 1)
    expected = (share.exp() * apart.clamp(max=1)).sum(1)
    total = (counted * (unlikely + _RISK * expected)).sum() / counted.sum().clamp(min=1)
    off, log_scale_known = torch.stack([e.sure_error for e in batch]).float(), around[..., -1].float().clamp(-5.8, 0)
    there = (off < _UNKNOWN / 2).float()
    unlikely = off.abs().clamp(max=0.5) / log_scale_known.exp() + log_scale_known
    return total + _DOUBT * (unlikely * there).sum() / there.sum().clamp(min=1)


def _partly_hidden(numbers: Tensor, of_frame: Tensor, frames: int) -> Tensor:
    """Take kinds of evidence (P, ..., kinds) away, at random from a keyframe as a whole and from single pixels."""
    device, kinds, half = numbers.device, numbers.shape[-1], _HIDDEN / 2
    shown = (torch.rand(frames, kinds, device=device) > half)[of_frame]
    shown = shown & (torch.rand(len(numbers), kinds, device=device) > half)
    return numbers * (shown[:, None] if numbers.ndim == 3 else shown)


def _recolored(planes: Tensor) -> Tensor:
    """Change lightness, colour, noise and contrast of images' planes (B, 10, h, w)."""
    by = _RECOLORED

    def draw(channels: int) -> Tensor:
        return torch.randn(len(planes), channels, 1, 1, device=planes.device)

    lightness = planes[:, :1] * (1 + by * draw(1)) + 0.5 * by * draw(1)
    colors = torch.cat([lightness, planes[:, 1:3] * (1 + 2 * by * draw(2)).clamp(min=0) + 0.5 * by * draw(2)], 1)
    colors = colors + 0.15 * by * draw(1).abs() * torch.randn_like(colors)
    contrast = planes[:, 9:] + 0.3 * by * draw(1)
    colored = torch.rand(len(planes), 1, 1, 1, device=planes.device) >= _COLORLESS
    return torch.cat([colors * colored, planes[:, 3:9], contrast], 1)
