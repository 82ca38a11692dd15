"""Opening a network's file, whatever its format: ONNX by onnxruntime, TensorFlow Lite by LiteRT.

An ONNX file is looked into before anything runs it: weights that it keeps in other files must lie beside it. LiteRT is
for small quantised networks as phones run them; it runs on the CPU whatever the device, where they take a fraction of a
second. Both libraries load slowly, and are imported where a network is opened.
"""

import mmap
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError, install_command
from ...formats.reading import note_read, opened, parsing, read_bytes
from ..system.progress import log

_MAGIC = b"TFL3"
_MAX_BYTES = 1 << 30
_STDERR = 2

_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(int64)": np.int64, "tensor(int32)": np.int32,
}  # fmt: skip

# Field numbers of onnx.proto: which fields lead to tensors, by message.
_DESCEND = {
    "model": {7: "graph", 25: "function"},
    "function": {7: "node"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "tensor": {13: "entry"},
}
_MAX_DEPTH = 32


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
    """Open a network's file, by its suffix as TFLite or else ONNX. `outputs` are those that will be asked for.

    Raises InputError for a file that is none, or keeps weights outside its own folder.
    """
    if is_tflite(path):
        return TfliteRuntime(path, outputs, threads)
    return OnnxRuntime(path, threads, device)


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


def _open(path: Path, threads: int, device: str) -> Any:
    """An `onnxruntime.InferenceSession`; the library loads slowly, and identities need none of it."""
    import onnxruntime as ort

    wanted = "CUDAExecutionProvider" if device == "cuda" else "CPUExecutionProvider"
    if wanted not in ort.get_available_providers():
        fix = install_command("onnxruntime-gpu")
        log.warning("this onnxruntime has no CUDA: the network runs on the CPU. To use the card: %s", fix)
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


def require_own_weights(path: Path) -> None:
    """Raise InputError unless `path` is an ONNX file all of whose external weights are in its own folder."""
    folder = path.parent.resolve()
    for location in external_locations(path):
        target = folder / location
        if "\0" in location or Path(location).is_absolute() or not target.resolve().is_relative_to(folder):
            raise InputError(
                f"{path}: keeps weights in {location!r}, outside its own folder. Such a file may read anything on "
                "this disk; get the network from its makers again"
            )
        if not target.is_file():
            raise InputError(f"{path}: its weights {location} are not beside it. Download that file as well")
        note_read(target)


def external_locations(path: Path) -> list[str]:
    """Names of the files with weights outside the ONNX file, sorted. Raises InputError when it is no ONNX file."""
    with (
        opened(path) as stream,
        parsing(path, "ONNX network", "download it again"),
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        return sorted(set(_locations(data, 0, len(data), "model", 0)))


def _locations(data: mmap.mmap, start: int, end: int, message: str, depth: int) -> Iterator[str]:
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deep")
    for field, first, last in _fields(data, start, end):
        inner = _DESCEND[message].get(field)
        if inner == "entry":
            texts = {f: data[a:b] for f, a, b in _fields(data, first, last)}
            if texts.get(1) == b"location":
                yield texts.get(2, b"").decode()
        elif inner is not None:
            yield from _locations(data, first, last, inner, depth + 1)


def _fields(data: mmap.mmap, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(number, first, last) of every length-delimited field of a protobuf message; the others are skipped."""
    at = start
    while at < end:
        tag, at = _varint(data, at, end)
        kind = tag & 7
        if kind == 2:
            length, at = _varint(data, at, end)
            if at + length > end:
                raise ValueError("field runs over its message")
            yield tag >> 3, at, at + length
            at += length
        elif kind == 0:
            _, at = _varint(data, at, end)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise ValueError("unknown wire type")
    if at != end:
        raise ValueError("message ends inside a field")


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            break
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("number without an end")


class TfliteRuntime:
    """A `Runtime` over a LiteRT interpreter. Quantised values are real numbers outside: value = scale · (q − zero)."""

    def __init__(self, path: Path, outputs: Sequence[str], threads: int) -> None:
        """`outputs` may name any tensor inside: the graph then ends there. That is how a network which answers with
        the best class alone still gives the scores of all of them.

        Raises InputError for a file that is no such network, and for a tensor that it does not have.
        """
        from ai_edge_litert.interpreter import Interpreter

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
            raise RuntimeError((str(error).strip().splitlines() or [type(error).__name__])[0]) from error

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
    import flatbuffers
    from ai_edge_litert import schema_py_generated as schema

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
