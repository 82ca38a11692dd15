"""Triton's kernels compiled for cards, which needs none: the interpreter accepts more than the compiler does."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MOST_SHARED = 99 * 1024
"""Bytes of shared memory that a program may have on compute capability 8.6."""


def build(kernels: dict[str, list[str]], constants: dict[str, Any], kinds: dict[str, str], folder: Path) -> None:
    """Compile the named kernels of each module below `msgs_slam.pipelines` for compute capability 8.0; fails where one
    does not compile or wants more shared memory than cards have.

    `kinds`: types of the arguments that are not pointers to float32, by name. `folder`: for the compiled files.
    """
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    given = json.dumps([kernels, constants, kinds])
    done = subprocess.run(
        [sys.executable, "-c", _BUILD, given],
        env=environment | {"TRITON_CACHE_DIR": str(folder)}, cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    shared = json.loads(done.stdout.splitlines()[-1])
    assert shared.keys() == {name for names in kernels.values() for name in names}
    assert all(0 <= used <= MOST_SHARED for used in shared.values()), shared


_BUILD = """
import importlib, json, sys
import triton
from triton.compiler import ASTSource
from triton.backends.compiler import GPUTarget
kernels, constants, kinds = json.loads(sys.argv[1])
warps = constants.pop("num_warps", 4)
shared = {}
for module, names in kernels.items():
    for name in names:
        kernel = getattr(importlib.import_module("msgs_slam.pipelines." + module), name)
        own = {n: x for n, x in constants.items() if n in kernel.arg_names}
        signature = {n: "constexpr" if n in own else kinds.get(n, "*fp32") for n in kernel.arg_names}
        source = ASTSource(kernel, signature, constexprs=own)
        built = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=dict(num_warps=warps))
        assert built.asm["ptx"]
        shared[name] = built.metadata.shared
print(json.dumps(shared))
"""
