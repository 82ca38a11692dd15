"""ONNX files, by onnxruntime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from ...formats.reading import parsing
from ..system.progress import log
from .onnx_file import require_own_weights
from .port import Port

_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(int64)": np.int64, "tensor(int32)": np.int32,
}  # fmt: skip


class OnnxRuntime:
    """A `Runtime` over an onnxruntime session."""

    def __init__(self, path: Path, threads: int, device: str) -> None:
        """Raises InputError for a file that is no ONNX network, or keeps weights outside its own folder."""
        require_own_weights(path)
        with parsing(path, "ONNX network that onnxruntime can load", "download it again"):
            self._session = _open(path, threads, device)
            self.inputs = {i.name: Port(tuple(i.shape), _TYPES.get(i.type)) for i in self._session.get_inputs()}
            self.outputs = {o.name: Port(tuple(o.shape), _TYPES.get(o.type)) for o in self._session.get_outputs()}
            self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def run(self, outputs: Sequence[str], feed: dict[str, NDArray]) -> list[NDArray]:
        """Run the network; see `Runtime.run`."""
        try:
            return list(self._session.run(list(outputs), feed))
        except Exception as error:  # onnxruntime's errors share no narrower base class
            if type(error).__module__.startswith("onnxruntime"):
                raise RuntimeError(str(error)) from error
            raise


def _open(path: Path, threads: int, device: str) -> ort.InferenceSession:
    wanted = "CUDAExecutionProvider" if device == "cuda" else "CPUExecutionProvider"
    if wanted not in ort.get_available_providers():
        log.warning("this onnxruntime has no CUDA: the network runs on the CPU (pip install onnxruntime-gpu)")
        wanted = "CPUExecutionProvider"
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Threads that spin while they wait steal the cores of whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers = [wanted] if wanted == "CPUExecutionProvider" else [wanted, "CPUExecutionProvider"]
    session = ort.InferenceSession(str(path), options, providers=providers)
    # It falls back to the CPU without an error when CUDA's libraries are missing.
    if session.get_providers()[0] != wanted:
        log.warning("%s was asked for, the network runs on %s", wanted, session.get_providers()[0])
    return session
