"""Tiles of an image for which the same planes are tried."""

from __future__ import annotations

from .bands import BAND_ROWS

TILE = BAND_ROWS
"""Pixels across and down: the rows of a band, and the pixels that one vector holds."""


def tiles_of(height: int, width: int) -> tuple[int, int]:
    """Return how many tiles an image of that size has down and across."""
    return -(-height // TILE), -(-width // TILE)
