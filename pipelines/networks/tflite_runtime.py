"""TensorFlow Lite files, by LiteRT: small quantised networks as phones run them.

It runs on the CPU whatever the device: the networks it is for take a fraction of a second there.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import flatbuffers
import numpy as np
from ai_edge_litert import schema_py_generated as schema
from ai_edge_litert.interpreter import Interpreter
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.reading import parsing, read_bytes
from .port import Port

_MAGIC = b"TFL3"
_MAX_BYTES = 1 << 30
_STDERR = 2


class TfliteRuntime:
    """A `Runtime` over a LiteRT interpreter. Quantised values are real numbers outside: value = scale · (q − zero)."""

    def __init__(self, path: Path, outputs: Sequence[str], threads: int) -> None:
        """`outputs` may name any tensor inside: the graph then ends there. That is how a network which answers with
        the best class alone still gives the scores of all of them.

        Raises InputError for a file that is no such network, and for a tensor that it does not have.
        """
        content = _read(path)
        with parsing(path, "TFLite network that LiteRT can load", "download it again"), without_litert_log():
            self._interpreter = Interpreter(model_content=_ending_at(path, content, outputs), num_threads=threads)
            self._interpreter.allocate_tensors()
            self._in = {d["name"]: d for d in self._interpreter.get_input_details()}
            self._out = {d["name"]: d for d in self._interpreter.get_output_details()}
        self.inputs = {k: Port(_channels_first(d["shape"]), np.float32) for k, d in self._in.items()}
        self.outputs = {k: Port(_channels_first(d["shape"]), d["dtype"]) for k, d in self._out.items()}
        self.metadata: dict[str, str] = {}

    def run(self, outputs: Sequence[str], feed: dict[str, NDArray]) -> list[NDArray]:
        """Run the network; see `Runtime.run`."""
        try:
            return self._run(outputs, feed)
        except ValueError as error:  # of an input that does not fit, or a tensor that a damaged file leaves empty
            raise RuntimeError(_first_line(error)) from error

    def _run(self, outputs: Sequence[str], feed: dict[str, NDArray]) -> list[NDArray]:
        for name, values in feed.items():
            detail = self._in[name]
            rows_first = values.transpose(0, 2, 3, 1) if values.ndim == 4 else values
            self._interpreter.set_tensor(detail["index"], _quantised(rows_first, detail))
        self._interpreter.invoke()
        found = []
        for name in outputs:
            values = _real(self._interpreter.get_tensor(self._out[name]["index"]), self._out[name])
            found.append(np.ascontiguousarray(values.transpose(0, 3, 1, 2)) if values.ndim == 4 else values)
        return found


@contextmanager
def without_litert_log() -> Iterator[None]:
    """LiteRT says on stderr which delegate it makes, whenever it opens a file, and has no switch for that. What goes
    wrong it raises."""
    try:
        kept = os.dup(_STDERR)
    except OSError:  # there is none
        yield
        return
    sys.stderr.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, _STDERR)
    try:
        yield
    finally:
        os.dup2(kept, _STDERR)
        os.close(nowhere)
        os.close(kept)


def _read(path: Path) -> bytes:
    content = read_bytes(path, _MAX_BYTES)
    if content[4:8] != _MAGIC:
        raise InputError(f"{path}: is not a TFLite network (no {_MAGIC.decode()} in its head). Download it again")
    return content


def _ending_at(path: Path, content: bytes, wanted: Sequence[str]) -> bytes:
    """The network with the tensors `wanted` as its outputs, without what comes after them."""
    model: Any = schema.ModelT.InitFromPackedBuf(content, 0)
    if not model.subgraphs:
        raise InputError(f"{path}: is a TFLite file without a network. Download it again")
    graph = model.subgraphs[0]
    index = {(t.name or b"").decode(errors="replace"): i for i, t in enumerate(graph.tensors)}
    ends = [index[name] for name in wanted if name in index]
    if set(ends) <= set(graph.outputs.tolist()):
        return content
    needed, kept = set(ends), []
    for operator in reversed(graph.operators):
        if needed & set(operator.outputs.tolist()):
            kept.append(operator)
            needed |= set(operator.inputs.tolist())
    graph.operators, graph.outputs, model.signatureDefs = kept[::-1], np.array(ends, np.int32), []
    builder = flatbuffers.Builder(len(content))
    builder.Finish(model.Pack(builder), file_identifier=_MAGIC)
    return bytes(builder.Output())


def _channels_first(shape: Sequence[int]) -> tuple[int, ...]:
    sides = tuple(int(s) for s in shape)
    return (sides[0], sides[3], sides[1], sides[2]) if len(sides) == 4 else sides


def _quantised(values: NDArray, detail: dict[str, Any]) -> NDArray:
    scale, zero = detail["quantization"]
    kind = np.dtype(detail["dtype"])
    if kind.kind == "f" or not scale:
        return np.ascontiguousarray(values, dtype=kind)
    limits = np.iinfo(kind)
    return np.clip(np.rint(values / np.float32(scale)) + zero, limits.min, limits.max).astype(kind)


def _real(values: NDArray, detail: dict[str, Any]) -> NDArray:
    scale, zero = detail["quantization"]
    if values.dtype.kind == "f" or not scale:
        return values
    return ((values.astype(np.float32) - np.float32(zero)) * np.float32(scale)).astype(np.float32)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
