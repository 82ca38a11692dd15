"""The choice among candidate depths: a small model predicts each one's error, then neighbours of like colour agree."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.tensors import load_arrays
from msgs_slam.pipelines.system.jit import kernel

_BLOCK = 4096
"""Pixels whose candidates are judged at once."""
_KEPT, _ROUNDS = 6, 16
"""Candidates that are kept for the smoothing, and its rounds."""
_COUPLING, _TRUNCATED, _COLOR_SD = 10.0, 0.15, 12.0
_ALIKE = 0.06
"""Candidates so near to the chosen one (log depth) are averaged with it."""
Array = NDArray[np.float32]


class ChoiceModel:
    """A network of three layers over a candidate's features and the mean over all candidates of its pixel."""

    def __init__(self, weights: dict[str, Array]) -> None:
        self._w = weights

    def judge(self, features: Array) -> tuple[Array, Array]:
        """Of (P, K, F): a cost of each candidate in nats, and its error in log depth as it is predicted, (P, K) both;
        a candidate whose features are all 0 is none."""
        costs, errors = [], []
        for first in range(0, len(features), _BLOCK):
            cost, error = self._judge(features[first : first + _BLOCK])
            costs.append(cost)
            errors.append(error)
        if not costs:
            return np.zeros((0, features.shape[1]), np.float32), np.zeros((0, features.shape[1]), np.float32)
        return np.concatenate(costs), np.concatenate(errors)

    def _judge(self, features: Array) -> tuple[Array, Array]:
        w, count = self._w, features.shape[1]
        real = features.any(-1)
        size = w["w1"].shape[0] - count
        # The last rows of the first layer are of the kinds: no column of ones and zeros is made for them.
        hidden = features.reshape(-1, size) @ w["w1"][:size]
        hidden = np.maximum(hidden.reshape(*real.shape, -1) + (w["w1"][size:] + w["b1"]), 0)
        hidden *= real[..., None]
        mean = hidden.sum(1) / np.maximum(real.sum(1), 1)[:, None]
        around = np.maximum(mean @ w["wc"] + w["bc"], 0)
        second = hidden.reshape(-1, hidden.shape[-1]) @ w["w2"]
        second = np.maximum(second.reshape(*real.shape, -1) + (around @ w["w2c"] + w["b2"])[:, None], 0)
        out = second.reshape(-1, second.shape[-1]) @ w["w3"] + w["b3"]
        out = out.reshape(*real.shape, 2)
        cost = np.where(real, -out[..., 0], np.float32(30))
        return cost, np.where(real, np.exp(np.clip(out[..., 1], -8, 0)), np.float32(1))


def load_model(path: Path) -> ChoiceModel:
    """The model that `learn` has left."""
    return ChoiceModel({k: np.asarray(v, np.float32) for k, v in load_arrays(path).items()})


def choose(inverse: Array, cost: Array, error: Array, pixels: NDArray[np.int64], lab: Array) -> tuple[Array, Array]:
    """Choose, of P pixels with K candidates each (inverse depths, 0: none), the inverse depth; and predict its error.

    Neighbours of like colour pass each other messages about which depths agree (min-sum belief propagation)."""
    order = np.argsort(np.where(inverse > 0, cost, 99), axis=1, kind="stable")[:, :_KEPT]
    kept, costs, errors = (np.take_along_axis(a, order, 1) for a in (inverse, cost, error))
    costs = np.where(kept > 0, costs - costs[:, :1], 30).astype(np.float32)
    logs = np.log(np.maximum(kept, 1e-9)).astype(np.float32)
    grid = np.full(lab.shape[:2], -1, np.int32)
    grid.ravel()[pixels] = np.arange(len(pixels), dtype=np.int32)
    belief = _pass_messages(costs, logs, grid, lab, _COUPLING, _TRUNCATED, _COLOR_SD, _ROUNDS)
    best = belief.argmin(1)[:, None]
    share = np.exp(-(belief - belief.min(1, keepdims=True))) * (kept > 0)
    share *= np.abs(logs - np.take_along_axis(logs, best, 1)) < _ALIKE
    total = np.maximum(share.sum(1), 1e-12)
    return np.exp((share * logs).sum(1) / total).astype(np.float32), ((share * errors).sum(1) / total).astype(
        np.float32
    )


@kernel
def _pass_messages(
    cost: Array,
    logs: Array,
    grid: NDArray[np.int32],
    lab: Array,
    coupling: float,
    truncated: float,
    sd: float,
    rounds: int,
) -> Array:
    """(P, M) beliefs: the cost and what the four neighbours say of each candidate."""
    height, width = grid.shape
    count, kept = cost.shape
    ys, xs = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for y in range(height):
        for x in range(width):
            if grid[y, x] >= 0:
                ys[grid[y, x]], xs[grid[y, x]] = y, x
    # messages[d]: what comes to a pixel from its neighbour at the left, the right, above, below
    messages, steps = np.zeros((4, count, kept), np.float32), ((0, -1), (0, 1), (-1, 0), (1, 0))
    strength = np.zeros((4, count), np.float32)
    other = np.full((4, count), -1, np.int32)
    for d in range(4):
        for p in range(count):
            y, x = ys[p] + steps[d][0], xs[p] + steps[d][1]
            if y < 0 or x < 0 or y >= height or x >= width or grid[y, x] < 0:
                continue
            other[d, p] = grid[y, x]
            apart = 0.0
            for c in range(3):
                apart += (lab[y, x, c] - lab[ys[p], xs[p], c]) ** 2
            strength[d, p] = coupling * np.exp(-np.sqrt(apart) / sd)
    total = np.zeros(kept, np.float32)
    for _ in range(rounds):
        before = messages.copy()
        for d in range(4):
            back = d ^ 1
            for p in range(count):
                q = other[d, p]
                if q < 0:
                    continue
                for k in range(kept):
                    total[k] = cost[q, k]
                    for e in range(4):
                        if e != back:
                            total[k] += before[e, q, k]
                least = np.float32(1e9)
                for k in range(kept):
                    best = np.float32(1e9)
                    for m in range(kept):
                        off = min(abs(logs[p, k] - logs[q, m]) / truncated, 1.0)
                        best = min(best, total[m] + strength[d, p] * np.float32(off))
                    messages[d, p, k] = best
                    least = min(least, best)
                for k in range(kept):
                    messages[d, p, k] = np.float32(0.5) * (messages[d, p, k] - least + before[d, p, k])
    out = cost.copy()
    for d in range(4):
        out += messages[d]
    return out
