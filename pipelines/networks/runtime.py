"""Opening a network's file: the same few lines whatever its format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .port import Runtime


def is_tflite(path: Path) -> bool:
    """Whether a file is meant as a TensorFlow Lite network, by its name."""
    return path.suffix.lower() == ".tflite"


def open_runtime(path: Path, outputs: Sequence[str], threads: int, device: str) -> Runtime:
    """Open a network's file, by its suffix as TFLite or else ONNX. `outputs` are those that will be asked for.

    Raises InputError for a file that is none, or keeps weights outside its own folder.
    """
    if is_tflite(path):
        from .tflite_runtime import TfliteRuntime

        return TfliteRuntime(path, outputs, threads)
    from .onnx_runtime import OnnxRuntime

    return OnnxRuntime(path, threads, device)
