"""ONNX networks for tests, written in ONNX's own notation."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper, parser

PICTURE = "float[1, 3, H, W] x"


def save_network(path: Path, inputs: str, outputs: str, *nodes: str, **weights: Any) -> Path:
    """Write a network: inputs and outputs such as "float[1, 3, H, W] x", nodes such as "y = Mul (x, gain)"; whole
    numbers among the weights are int64, others float32."""
    graph = parser.parse_graph(f"net ({inputs}) => ({outputs}) {{ {' '.join(nodes)} }}")
    for name, value in weights.items():
        array = np.array(value, order="C")
        kind = np.float32 if array.dtype.kind == "f" else np.int64
        graph.initializer.append(numpy_helper.from_array(array.astype(kind), name))
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def color_tokens(path: Path) -> Path:
    """Write a transformer's stand-in: a class token, then one a patch of 14 x 14 pixels that holds its mean colour."""
    return save_network(
        path, PICTURE, "float[1, n, 3] tokens",
        "pooled = AveragePool <kernel_shape = [14, 14], strides = [14, 14]> (x)",
        "flat = Reshape (pooled, shape)",
        "patches = Transpose <perm = [0, 2, 1]> (flat)",
        "tokens = Concat <axis = 1> (class_token, patches)",
        shape=[1, 3, -1], class_token=np.full((1, 1, 3), 9.0),
    )  # fmt: skip
