"""Helper: a TensorFlow Lite file of one convolution, with the contract of the real ones, written byte by byte."""

from pathlib import Path
from typing import Any

import flatbuffers
import numpy as np
from ai_edge_litert import schema_py_generated as schema
from numpy.typing import NDArray

from msgs_slam.pipelines.networks.registry import ModelStore

FLOAT, INT32, UINT8 = schema.TensorType.FLOAT32, schema.TensorType.INT32, schema.TensorType.UINT8
OPERATORS = schema.BuiltinOperator


class Builder:
    """Collects tensors and operators of one graph."""

    def __init__(self) -> None:
        self.model = schema.ModelT()
        self.model.version, self.model.operatorCodes, self.model.signatureDefs = 3, [], []
        self.model.buffers = [schema.BufferT()]
        self.graph = schema.SubGraphT()
        self.graph.tensors, self.graph.operators = [], []
        self.model.subgraphs = [self.graph]

    def tensor(self, name: str, shape: list[int], kind: int, data: NDArray | None = None, scale: float = 0) -> int:
        tensor = schema.TensorT()
        tensor.name, tensor.shape, tensor.type, tensor.buffer = name.encode(), np.array(shape, np.int32), kind, 0
        if scale:
            tensor.quantization = schema.QuantizationParametersT()
            tensor.quantization.scale = np.array([scale], np.float32)
            tensor.quantization.zeroPoint = np.array([128], np.int64)
        if data is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(data.tobytes(), np.uint8)
            self.model.buffers.append(buffer)
            tensor.buffer = len(self.model.buffers) - 1
        self.graph.tensors.append(tensor)
        return len(self.graph.tensors) - 1

    def operator(self, kind: int, inputs: list[int], outputs: list[int], options: Any = None, name: str = "") -> None:
        code = schema.OperatorCodeT()
        code.builtinCode, code.deprecatedBuiltinCode, code.version = kind, min(kind, 127), 1
        self.model.operatorCodes.append(code)
        operator = schema.OperatorT()
        operator.opcodeIndex = len(self.model.operatorCodes) - 1
        operator.inputs, operator.outputs = np.array(inputs, np.int32), np.array(outputs, np.int32)
        if options is not None:
            operator.builtinOptions, operator.builtinOptionsType = options, getattr(schema.BuiltinOptions, name)
        self.graph.operators.append(operator)

    def bytes(self, inputs: list[int], outputs: list[int]) -> bytes:
        self.graph.inputs, self.graph.outputs = np.array(inputs, np.int32), np.array(outputs, np.int32)
        builder = flatbuffers.Builder(1024)
        builder.Finish(self.model.Pack(builder), file_identifier=b"TFL3")
        return bytes(builder.Output())


def write_tflite(
    path: Path,
    weight: list[list[float]],
    bias: list[float],
    last: str = "",
    size: tuple[int, int] = (24, 32),
    called: tuple[str, str] = ("image", "scores"),
    answer: str = "logistic",
) -> Path:
    """scores = weight (C, 3) @ rgb + bias at every pixel; the input is RGB in −1..1 as uint8 (scale 1/128, zero 128).

    `last` is what the file answers with: the "scores" as float, "uint8" scores (scale 1/16, zero 128), "argmax" of
    those, or the "logistic" of the scores. All that comes before can be asked for by its name; `called` names the
    input and the scores, `answer` the logistic.
    """
    (rows, columns), count = size, len(weight)
    build = Builder()
    image = build.tensor(called[0], [1, rows, columns, 3], UINT8, scale=1 / 128)
    real = build.tensor("real", [1, rows, columns, 3], FLOAT)
    build.operator(OPERATORS.DEQUANTIZE, [image], [real], schema.DequantizeOptionsT(), "DequantizeOptions")
    kernel = build.tensor("kernel", [count, 1, 1, 3], FLOAT, np.array(weight, np.float32))
    offset = build.tensor("bias", [count], FLOAT, np.array(bias, np.float32))
    end = scores = build.tensor(called[1], [1, rows, columns, count], FLOAT)
    options = schema.Conv2DOptionsT()
    options.strideW = options.strideH = options.dilationWFactor = options.dilationHFactor = 1
    build.operator(OPERATORS.CONV_2D, [real, kernel, offset], [scores], options, "Conv2DOptions")
    if last in ("uint8", "argmax"):
        end = build.tensor("uint8", [1, rows, columns, count], UINT8, scale=1 / 16)
        build.operator(OPERATORS.QUANTIZE, [scores], [end], schema.QuantizeOptionsT(), "QuantizeOptions")
    if last == "argmax":
        axis = build.tensor("axis", [1], INT32, np.array([3], np.int32))
        best = build.tensor("argmax", [1, rows, columns], INT32)
        choice = schema.ArgMaxOptionsT()
        choice.outputType = INT32
        build.operator(OPERATORS.ARG_MAX, [end, axis], [best], choice, "ArgMaxOptions")
        end = best
    if last == "logistic":
        end = build.tensor(answer, [1, rows, columns, count], FLOAT)
        build.operator(OPERATORS.LOGISTIC, [scores], [end])
    path.write_bytes(build.bytes([image], [end]))
    return path


def blue_people(folder: Path) -> ModelStore:
    """Networks for people, of the real ones' contracts, to which blue is a person, taken into the cache."""
    store = ModelStore.open()
    blue = write_tflite(
        folder / "p.tflite", [[-4, -4, 8.0]], [-3.0], "logistic", (256, 256), ("input_1", "raw"), "activation_10"
    )
    store.add(blue, "selfie-person", "my-person")
    weight = np.zeros((32, 3))
    weight[13] = 5 * np.array([-2, -2, 4.0])
    bias = np.full(32, -20.0)
    bias[1], bias[13] = 0.0, -15.0
    names = ("MobilenetV2/MobilenetV2/input", "logits/semantic/BiasAdd")
    classes = write_tflite(folder / "c.tflite", weight.tolist(), bias.tolist(), "argmax", (512, 512), names)
    store.add(classes, "deeplab-ade20k", "my-classes")
    return ModelStore.open()
