"""What the paper's choice and weights of keyframes do, eqs. (10) to (14), on runs with a network's labels.

    python tests/benchmarks/terms.py RUN.msgs RUN.msgs ... [--keyframes 14] [--json FILE]

Each finished run's first keyframes are mapped again at 320 pixels, four passes, every eighth frame held out, with one
term off or on at a time. Labels: share of the pixels that the map labels as its input.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.mapping import optimise
from msgs_slam.pipelines.mapping.measure import mean_figures, measure_view
from msgs_slam.pipelines.mapping.optimise import optimise_map
from msgs_slam.pipelines.mapping.views import MappingInput, load_views
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "(10), (11) off: any past keyframe": {"_covisible": lambda self, now, rng: int(rng.integers(now))},
    "(11) with T_geo = 0.3": {"t_geo": 0.3},
    "(13) off: tau = 0": {"TIME_DECAY": 0.0},
    "(14) off: delta = 0": {"RELIABILITY_DECAY": 0.0},
    "default, another seed": {"seed": 1},
}


def trial(given: MappingInput, change: dict[str, Any]) -> dict[str, float]:
    """Figures of the map with one change, which is undone again."""
    kept = (optimise.TIME_DECAY, optimise.RELIABILITY_DECAY, optimise.Schedule._covisible, optimise.overlaps)
    settings = MappingConfig(passes=4.0, min_iterations=0)
    try:
        for name in ("TIME_DECAY", "RELIABILITY_DECAY"):
            setattr(optimise, name, change.get(name, getattr(optimise, name)))
        if "_covisible" in change:
            optimise.Schedule._covisible = change["_covisible"]  # type: ignore[method-assign]
        if limit := change.get("t_geo", 0.0):
            optimise.overlaps = lambda views: np.where((o := kept[3](views)) > limit, o, 0.0)
        result = optimise_map(given.views, len(given.class_ids), settings, change.get("seed", 0))
    finally:
        optimise.TIME_DECAY, optimise.RELIABILITY_DECAY = kept[:2]
        optimise.Schedule._covisible, optimise.overlaps = kept[2:]  # type: ignore[method-assign]
    rows = zip(given.views, result.cam_from_world, result.log_gains, result.offsets, strict=True)
    nothing = np.zeros(3, np.float32)
    held = [measure_view(result.gaussian_map, v, v.cam_from_world.numpy(), nothing, nothing) for v in given.held_out]
    seen = mean_figures([measure_view(result.gaussian_map, *row) for row in rows], "keyframe")
    return {"gaussians": len(result.gaussian_map), **seen, **mean_figures(held, "held_out")}


def stretch(run: RunFolder, count: int) -> MappingInput:
    """The views of the first keyframes, and the held-out frames between them."""
    settings = MappingConfig(max_side=320, hold_out=8)
    given = load_views(run, run.load(TRAJECTORY, "tracking"), settings)
    views = given.views[:count]
    held = [v for v in given.held_out if v.frame_id < views[-1].frame_id]
    return MappingInput(views, held, given.class_ids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN", type=Path)
    parser.add_argument("--keyframes", type=int, default=14)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found: dict[str, Any] = {}
    for path in given.runs:
        run = RunFolder(path)
        found[path.stem] = {}
        views = stretch(run, given.keyframes)
        for name, change in VARIANTS.items():
            found[path.stem][name] = trial(views, change)
            print(path.stem, name, json.dumps(found[path.stem][name]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
