"""The machine that figures are of."""

import importlib.metadata
import os
import platform
import re
import subprocess
from pathlib import Path

import torch

from on_card.rows import Rows

LIBRARIES = ("msgs-slam", "triton", "numpy", "numba", "pycolmap", "onnxruntime", "gsplat")


def add_machine(rows: Rows) -> None:
    """One row: card, driver, processor, versions."""
    row = {"python": platform.python_version(), "torch": torch.__version__, "cores": len(os.sched_getaffinity(0))}
    model = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text())
    row["processor"] = model[1] if model else platform.processor()
    for name in LIBRARIES:
        try:
            row[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            row[name] = "-"
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(0)
        row |= {
            "card": card.name,
            "capability": f"{card.major}.{card.minor}",
            "memory_gb": round(card.total_memory / 1e9),
        }
        with rows.attempt("driver"):
            told = subprocess.run(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"], text=True,
                                  capture_output=True, timeout=20)  # fmt: skip
            row["driver"] = told.stdout.strip()
    rows.add("machine", **row)
