"""What runs a network's file: the same few lines whatever its format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
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


def is_tflite(path: Path) -> bool:
    """Whether a file is meant as a TensorFlow Lite network, by its name."""
    return path.suffix.lower() == ".tflite"


def open_runtime(path: Path, outputs: Sequence[str], threads: int, device: str) -> Runtime:
    """Open a network's file, told by its name: .tflite, else ONNX. `outputs` are those that will be asked for.

    Raises InputError for a file that is none, or keeps weights outside its own folder.
    """
    if is_tflite(path):
        from msgs_slam.pipelines.proxy.networks.tflite_runtime import TfliteRuntime

        return TfliteRuntime(path, outputs, threads)
    from msgs_slam.pipelines.proxy.networks.onnx_runtime import OnnxRuntime

    return OnnxRuntime(path, threads, device)
