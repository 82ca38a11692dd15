"""Counts what a card is asked to do in steady mapping and stereo: operations, reads by the host, bytes copied.

    python tests/benchmarks/launches.py                   the table
    python tests/benchmarks/launches.py --causes          also by the function that asks for them
    python tests/benchmarks/launches.py --json rows.json  the same as rows

No card is needed: the work runs as on one, over tensors that only pretend to lie there (`tests/pretend_device.py`) and
with the card's own kernels in Triton's interpreter. An operation that torch dispatches counts as one launch, of which
a sort or a sum on a card has more; views and allocations count none. A read makes the host wait for the card: numbers
taken from it, copies, and operations whose result's size depends on the values.
"""

# ruff: noqa: E402 (the paths are set, and Triton is told to interpret, before they are needed)

import os

os.environ["TRITON_INTERPRET"] = "1"

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.depth.stereo import cuda as stereo_cuda
from msgs_slam.pipelines.depth.stereo.matching import StereoImages
from msgs_slam.pipelines.mapping.optimise import MapOptimiser, Step
from msgs_slam.pipelines.mapping.state import OptimiserState
from msgs_slam.pipelines.mapping.views import View, make_view
from msgs_slam.pipelines.render import api, cuda
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.system import gpu
from msgs_slam.pipelines.types import Intrinsics, ProxyMaps
from tests import pretend_device
from tests.pretend_device import DEVICE, PretendTensor

_choose_backend = api.choose_backend  # before the pretended device puts its own in its place
SIZE, COUNT, CLASSES, VIEWS = (48, 32), 300, 5, 3
COLUMNS = ("launches", "reads", "bytes to the card", "bytes from it")
_NO_WORK = ("aten::empty", "aten::new_empty", "aten::_local_scalar_dense", "aten::_unsafe_view", "aten::detach")
_WAITING = (
    "aten::_local_scalar_dense", "aten::nonzero", "aten::repeat_interleave", "aten::bincount", "aten::masked_select",
)  # fmt: skip


class Counting(TorchDispatchMode):
    """Counts, within, the operations that touch tensors of the pretended device; `names`: which ones, how often;
    `causes`: launches by the function of the program that asked for them."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter(dict.fromkeys(COLUMNS, 0))
        self.names: Counter[str] = Counter()
        self.causes: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
        if any(isinstance(x, PretendTensor) for x in given):
            self._note(function, given, result, bool((kwargs or {}).get("output_size")))
        return result

    def _note(self, function: Any, given: list[torch.Tensor], result: Any, told: bool) -> None:
        """`told`: the size of the result was given, and need not be read."""
        name = function._schema.name
        left = isinstance(result, torch.Tensor) and not isinstance(result, PretendTensor)
        masks = name.startswith("aten::index") and any(x.dtype == torch.bool for x in given[1:])
        if left:
            self.copied("bytes from it", result.nbytes)
        elif (name.startswith(_WAITING) and not told) or masks:
            self.counts["reads"] += 1
            self.names[f"reads: {name}"] += 1
        if name == "aten::copy_" and not isinstance(given[1], PretendTensor):
            self.counts["bytes to the card"] += given[1].nbytes
        if not left and not name.startswith(_NO_WORK) and not _is_view(function):
            self.launched(name)

    def launched(self, name: str) -> None:
        """One more launch."""
        self.counts["launches"] += 1
        self.names[name] += 1
        self.causes[_cause()] += 1

    def copied(self, way: str, size: int) -> None:
        """A copy of so many bytes; those to the host make it wait."""
        self.counts[way] += size
        self.counts["reads"] += way == "bytes from it"
        self.names[f"copies: {way}"] += 1


def _cause() -> str:
    """The innermost function of the program that is being run; what autograd does by itself is its caller's."""
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(ROOT / "pipelines"):
            return f"{path.relative_to(ROOT / 'pipelines').with_suffix('')}: {frame.f_code.co_qualname}"
        frame = frame.f_back  # type: ignore[assignment]
    return "elsewhere"


def _is_view(function: Any) -> bool:
    aliases = [x.alias_info for x in function._schema.arguments if x.alias_info is not None]
    return bool(aliases) and not any(x.is_write for x in aliases)


def counted(work: Callable[[], object]) -> Counting:
    """What a piece of work asks of the card."""
    counting, handle = Counting(), pretend_device._Mode.__torch_function__

    def watched(self: Any, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = handle(self, function, types, args, kwargs)
        of = args[:1] if function is torch.Tensor.to else (args, kwargs)
        made = isinstance(result, PretendTensor) and not pretend_device._has_pretender(of)
        if made and function in (torch.Tensor.to, torch.tensor, torch.as_tensor, torch.from_numpy):
            counting.copied("bytes to the card", result.inner.nbytes)
        elif made and function not in (torch.empty,):
            counting.launched(f"makes: {function.__name__}")
        elif function is torch.Tensor.tolist and isinstance(args[0], PretendTensor):
            counting.copied("bytes from it", args[0].inner.nbytes)
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretend_device._Mode, "__torch_function__", watched)
        patch.setattr(gpu, "launch", partial(_launch, counting))
        with counting:
            work()
    return counting


def _launch(counting: Counting | None, kernel: Any, programs: int, *arguments: Any, **settings: Any) -> None:
    """Interpret a kernel, on the values."""
    if counting is not None:
        counting.launched(f"kernel: {kernel.fn.__name__}")
    inner = (x.inner.detach() if isinstance(x, PretendTensor) else x for x in arguments)
    with _disable_current_modes():
        kernel[(programs,)](*inner, **settings)


def as_on_a_card(patch: pytest.MonkeyPatch) -> None:
    """The pretended device takes the card's kernels instead of the CPU's."""

    def backend(name: str | None, example: torch.Tensor) -> Any:
        return _choose_backend("cuda" if isinstance(example, PretendTensor) else name, example)

    patch.setattr(gpu, "supports_triton", lambda example: isinstance(example, PretendTensor))
    patch.setattr(gpu, "launch", partial(_launch, None))
    for number in ("TILE", "STEP_BACK"):  # the interpreter takes as long for a small step as for a large one
        patch.setattr(cuda, number, 16)
    patch.setattr(api, "choose_backend", backend)


def made_views(generator: np.random.Generator) -> list[View]:
    """A wall two metres away, seen from a few places side by side."""
    width, height = SIZE
    k = Intrinsics(width, height, 40.0, 40.0, width / 2, height / 2)
    out = []
    for i in range(VIEWS):
        pose = np.eye(4)
        pose[0, 3] = 0.05 * i
        labels = generator.integers(0, CLASSES, (height, width)).astype(np.uint8)
        maps = ProxyMaps(
            np.full((height, width), 2, np.float32), np.ones((height, width), np.float32), labels,
            np.ones((height, width), np.float32),
        )  # fmt: skip
        image = generator.integers(0, 256, (height, width, 3)).astype(np.uint8)
        out.append(make_view(i, k, pose, image, maps, tuple(range(CLASSES)), DEVICE))
    return out


def made_map(generator: np.random.Generator) -> GaussianMap:
    """Gaussians on that wall."""
    means = np.concatenate([generator.uniform(-1.2, 1.2, (COUNT, 2)), generator.uniform(1.9, 2.1, (COUNT, 1))], 1)
    arrays = (means, generator.uniform(-3, -2, COUNT), generator.normal(1, 1, COUNT), generator.random((COUNT, 3)))
    floats = (torch.tensor(x, dtype=torch.float32).to(DEVICE) for x in (*arrays, np.zeros((COUNT, CLASSES))))
    return GaussianMap(*floats, torch.zeros(COUNT, dtype=torch.int64).to(DEVICE))


def optimiser() -> MapOptimiser:
    """One that has visited its views once, so that nothing is done for the first time."""
    generator = np.random.default_rng(0)
    views = made_views(generator)
    state = OptimiserState.fresh(views, CLASSES, made_map(generator), None)
    out = MapOptimiser(views, CLASSES, MappingConfig(), state)
    for _ in range(2):
        out.step(step(1))
    return out


def stereo_of_a_keyframe() -> None:
    """Matched with six others, its depth compared with those of eight."""
    pictures = np.random.default_rng(0).random((9, 6, 10)).astype(np.float32)
    warps = np.repeat(np.eye(3, 4)[None], 8, 0)
    warps[:, 0, 3] = 5 * np.arange(8)
    stereo_cuda.match_planes(StereoImages(pictures[0], pictures[1:7], warps[:6]), np.linspace(0.2, 1.0, 4), DEVICE)
    stereo_cuda.fuse_depths(pictures[0], pictures[1:], warps, warps[:, 2], 0.01, DEVICE)


def step(view: int, note: bool = False) -> Step:
    """A visit."""
    return Step(view, 1.0, 0.5, False, note=note, refine_pose=True)


def measure() -> dict[str, Counting]:
    """Rows of the table."""
    with pytest.MonkeyPatch.context() as patch, pretend_device.pretended(patch):
        as_on_a_card(patch)
        mapper = optimiser()
        mapper.state.settle_poses()
        rows = {"a visit": counted(lambda: mapper.step(step(1)))}
        mapper.step(step(2))
        return rows | {
            "poses, once a pass": counted(mapper.state.settle_poses),
            "a visit that notes weights and errors": counted(lambda: mapper.step(step(1, note=True))),
            f"classes counted, {VIEWS} views": counted(mapper.count_labels),
            "stereo of a keyframe": counted(stereo_of_a_keyframe),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--causes", action="store_true", help="also list which functions ask for the launches")
    parser.add_argument("--operations", action="store_true", help="also list which operations they are")
    options = parser.parse_args()
    rows = measure()
    print("| steady work | " + " | ".join(COLUMNS) + " |\n|" + " --- |" * (len(COLUMNS) + 1))
    for name, found in rows.items():
        print(f"| {name} | " + " | ".join(str(found.counts[c]) for c in COLUMNS) + " |")
        for wanted, listed in ((options.causes, found.causes), (options.operations, found.names)):
            if wanted:
                print("\n".join(f"    {count:4d} {name}" for name, count in listed.most_common()))
    if options.json is not None:
        options.json.write_text(json.dumps({n: dict(f.counts) for n, f in rows.items()}, indent=1))


if __name__ == "__main__":
    main()
