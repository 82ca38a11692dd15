"""The choice among candidate depths: a small model says how likely each is, and the least expected error is taken."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.tensors import load_arrays
from msgs_slam.pipelines.system.jit import kernel

_NEVER = 30.0
_BLOCK = 4096
"""Pixels whose candidates are judged at once."""
Array = NDArray[np.float32]


class ChoiceModel:
    """A network of three layers over a candidate's features and the mean over all candidates of its pixel."""

    def __init__(self, weights: dict[str, Array]) -> None:
        self._w = weights

    def judge(self, features: Array) -> Array:
        """Return the cost (P, K) of each candidate in nats by its features (P, K, F); if all are 0, it is none."""
        blocks = [features[first : first + _BLOCK] for first in range(0, len(features), _BLOCK)]
        return np.concatenate([self._judge(b) for b in blocks] or [np.zeros(features.shape[:2], np.float32)])

    def _judge(self, features: Array) -> Array:
        w, size = self._w, features.shape[2]
        real = np.asarray(features.any(-1), np.bool_)
        # The last rows of the first layer are of the kinds: no column of ones and zeros is made for them.
        hidden = (features.reshape(-1, size) @ w["w1"][:size]).reshape(*real.shape, -1)
        hidden = np.maximum(hidden + (w["w1"][size:] + w["b1"]), 0) * real[..., None]
        mean = hidden.sum(1) / np.maximum(real.sum(1), 1)[:, None]
        around = np.maximum(mean @ w["wc"] + w["bc"], 0) @ w["w2c"] + w["b2"]
        second = (hidden.reshape(-1, hidden.shape[-1]) @ w["w2"]).reshape(*real.shape, -1)
        out = np.maximum(second + around[:, None], 0) @ w["w3"] + w["b3"]
        return np.where(real, -out[..., 0], np.float32(_NEVER)).astype(np.float32)


def load_model(path: Path) -> ChoiceModel:
    """Load the model that `learn` has left."""
    return ChoiceModel({k: np.asarray(v, np.float32) for k, v in load_arrays(path).items()})


@kernel
def choose(inverse: Array, cost: Array) -> tuple[Array, Array]:
    """Choose, of P pixels with K candidates each (inverse depths, 0: none) and their costs in nats, the inverse depth
    of the least expected error (log depth, at most 1), and return it with that error."""
    count, kinds = inverse.shape
    chosen, risk = np.zeros(count, np.float32), np.ones(count, np.float32)
    for p in range(count):
        share, logs = np.exp(cost[p].min() - cost[p]), np.log(np.maximum(inverse[p], np.float32(1e-9)))
        share /= share.sum()
        for k in range(kinds):
            if inverse[p, k] <= 0:
                continue
            expected = np.float32(0)
            for m in range(kinds):
                expected += share[m] * min(abs(logs[k] - logs[m]), np.float32(1))
            if expected < risk[p]:
                risk[p], chosen[p] = expected, inverse[p, k]
    return chosen, risk
