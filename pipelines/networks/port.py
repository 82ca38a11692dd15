"""Interface of every opened network, whatever its file format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Port:
    """An input or output: its shape with channels before rows and columns (names or None where it is free) and the
    type of its values; None where the file names one that is no number of ours."""

    shape: tuple[int | str | None, ...]
    dtype: type[np.generic] | None


class Runtime(Protocol):
    """An opened file. Images go in and come out channels first, as real numbers."""

    inputs: dict[str, Port]
    outputs: dict[str, Port]
    metadata: dict[str, str]

    def run(self, outputs: Sequence[str], feed: dict[str, NDArray]) -> list[NDArray]:
        """The named outputs. Raises RuntimeError when the network does not run on this feed."""
