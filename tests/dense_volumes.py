"""Volumes of stereo as plain arrays (H, W, D), and back: tests and benchmarks compare these."""

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.volume import BLOCK, TILE, UNREACHED, CostVolume, tiles_of


def to_dense(volume: CostVolume) -> NDArray[np.float32]:
    """(H, W, D), UNREACHED where no plane is tried."""
    there, cells = _cells(volume)
    blocks = np.where(there, volume.values[np.where(there, cells, 0)], UNREACHED)
    down, across, count = volume.places.shape
    whole = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(down * TILE, across * TILE, count * BLOCK)
    return np.minimum(whole[: volume.height, : volume.width, : volume.planes], UNREACHED)


def of_dense(cost: NDArray[np.float32]) -> CostVolume:
    """CostVolume of all of (H, W, D)."""
    height, width, planes = cost.shape
    volume = CostVolume.of_tried(height, width, np.ones((*tiles_of(height, width), planes), np.bool_))
    down, across, count = volume.places.shape
    whole = np.full((down * TILE, across * TILE, count * BLOCK), UNREACHED)
    whole[:height, :width, :planes] = cost
    blocks = whole.reshape(down, TILE, across, TILE, count, BLOCK).transpose(0, 2, 4, 1, 3, 5)
    volume.values[_cells(volume)[1]] = blocks
    return volume


def _cells(volume: CostVolume) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each block is there, and where its numbers are: (tiles down, across, blocks, TILE, TILE, BLOCK)."""
    pixels = np.arange(TILE * TILE).reshape(TILE, TILE, 1) * volume.strides[:, :, None, None, None, None]
    first = volume.places[..., None, None, None]
    cells = first + pixels + np.arange(BLOCK)
    return np.broadcast_to(first >= 0, cells.shape), cells
