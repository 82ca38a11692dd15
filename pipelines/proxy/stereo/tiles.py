"""Tiles of a picture for which the same planes are tried."""

from __future__ import annotations

TILE = 16
"""Pixels across and down."""


def tiles_of(height: int, width: int) -> tuple[int, int]:
    """Return how many tiles a picture of that size has down and across."""
    return -(-height // TILE), -(-width // TILE)
