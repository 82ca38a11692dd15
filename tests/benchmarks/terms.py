"""What the paper's choice and weights of keyframes do, eqs. (10) to (14), and its local adjustment, eq. (25), on runs
with a network's labels.

    python tests/benchmarks/terms.py RUN.msgs=DATASET RUN.msgs ... [--keyframes 14] [--json FILE]

Each finished run's first keyframes are mapped again at 320 pixels, four passes, every eighth frame held out, with one
term off or on at a time. Labels: share of the pixels that the map labels as its input. θ^γ of eq. (3) is told from the
run's own labels.

Eq. (25) moves every sixth keyframe's pose against the finished map, from where mapping left it and from a place shaken
by 1 % of the scene's depth and 0.3 degrees, in 20 steps. Error in cm against the truth of DATASET, after one Sim(3) of
all keyframes; without it against where mapping left them.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.config import MappingConfig, PaperConfig
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.alignment import align_points
from msgs_slam.pipelines.global_ba.local import adjusted_poses
from msgs_slam.pipelines.mapping import schedule
from msgs_slam.pipelines.mapping.load import MappingInput, load_view, load_views
from msgs_slam.pipelines.mapping.measure import mean_figures, measure_view
from msgs_slam.pipelines.mapping.optimise import optimise_map, scene_depth
from msgs_slam.pipelines.mapping.views import View
from msgs_slam.pipelines.proxy.reliability import GAMMA, theta
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.records import load_source
from msgs_slam.pipelines.types import Trajectory

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "(10), (11) off: any past keyframe": {"_covisible": lambda self, now, rng: int(rng.integers(now))},
    "(11) with T_geo = 0.3": {"t_geo": 0.3},
    "(12) with T_sem = 0.65": {"paper": PaperConfig(keyframe_miou=0.65)},
    "(13) off: tau = 0": {"TIME_DECAY": 0.0},
    "(14) off: delta = 0": {"RELIABILITY_DECAY": 0.0},
    "default, another seed": {"seed": 1},
}


def trial(given: MappingInput, change: dict[str, Any]) -> dict[str, float]:
    """Figures of the map with one change, which is undone again."""
    kept = (schedule.TIME_DECAY, schedule.RELIABILITY_DECAY, schedule.Schedule._covisible, schedule.overlaps)
    settings = MappingConfig(passes=4.0, min_iterations=0)
    try:
        for name in ("TIME_DECAY", "RELIABILITY_DECAY"):
            setattr(schedule, name, change.get(name, getattr(schedule, name)))
        if "_covisible" in change:
            schedule.Schedule._covisible = change["_covisible"]  # type: ignore[method-assign]
        if limit := change.get("t_geo", 0.0):
            schedule.overlaps = lambda views: np.where((o := kept[3](views)) > limit, o, 0.0)
        result = optimise_map(
            given.views, len(given.class_ids), settings, change.get("seed", 0), paper=change.get("paper")
        )
    finally:
        schedule.TIME_DECAY, schedule.RELIABILITY_DECAY = kept[:2]
        schedule.Schedule._covisible, schedule.overlaps = kept[2:]  # type: ignore[method-assign]
    rows = zip(given.views, result.cam_from_world, result.log_gains, result.offsets, strict=True)
    nothing = np.zeros(3, np.float32)
    held = [measure_view(result.gaussian_map, v, v.cam_from_world.numpy(), nothing, nothing) for v in given.held_out]
    seen = mean_figures([measure_view(result.gaussian_map, *row) for row in rows], "keyframe")
    return {"gaussians": len(result.gaussian_map), **seen, **mean_figures(held, "held_out")}


def local_trial(run: RunFolder, truth: Path | None) -> dict[str, dict[str, float]]:
    """Mean error of the chosen keyframes' places in cm (in thousandths of the scene's depth without truth) and degrees,
    before and after, by start."""
    trajectory, gaussian_map = run.load_trajectory("mapping"), run.load_map("mapping")
    chosen = keyframe_views(run, trajectory)
    unit = scene_depth(chosen)
    true, scale = true_poses(run, trajectory, truth, unit)
    rng = np.random.default_rng(0)
    shake = rng.normal(size=(len(chosen), 6)) / np.sqrt(3) * np.repeat([0.01 * unit, np.radians(0.3)], 3)
    out = {}
    for name, twists in (("left", np.zeros_like(shake)), ("shaken", shake)):
        start = [
            replace(v, cam_from_world=torch.from_numpy(se3.exp(t)) @ v.cam_from_world)
            for v, t in zip(chosen, twists, strict=True)
        ]
        found = adjusted_poses(start, gaussian_map, MappingConfig(), 20)
        for when, poses in (("before", {v.frame_id: v.cam_from_world.numpy() for v in start}), ("after", found)):
            ours = se3.inverse(np.array(list(poses.values())))
            theirs = se3.inverse(np.array([true[i] for i in poses]))
            away = np.linalg.norm(ours[:, :3, 3] - theirs[:, :3, 3], axis=1)
            turned = np.degrees(se3.rotation_angle(se3.inverse(ours) @ theirs))
            out[f"{name}, {when}"] = {
                "place": round(float(scale * away.mean()), 3),
                "degrees": round(float(turned.mean()), 3),
            }
    return out


def keyframe_views(run: RunFolder, trajectory: Trajectory) -> list[View]:
    """Every sixth keyframe at 320 pixels."""
    frames = {f.id: f for f in run.load_frames()}
    camera = run.load_calibration().intrinsics.at_most(320)
    fields, class_ids = run.load_depth_fields("tracking"), tuple(run.load_class_ids())
    poses = dict(zip(trajectory.frame_ids.tolist(), trajectory.cam_from_world, strict=True))
    return [
        load_view(run, frames[i], camera, poses[i], fields.in_world(i, run.load_proxy(i)), class_ids, "cpu")
        for i in trajectory.frame_ids[trajectory.is_keyframe].tolist()[::6]
    ]


def true_poses(
    run: RunFolder, trajectory: Trajectory, truth: Path | None, unit: float
) -> tuple[dict[int, NDArray[np.float64]], float]:
    """cam_from_world by frame in the run's world, and what its lengths are multiplied by."""
    ids = trajectory.frame_ids.tolist()
    if truth is None:
        return dict(zip(ids, trajectory.cam_from_world, strict=True)), 1000 / unit
    matched = match_truth(run.load_frames(), Path(load_source(run).path).is_dir(), open_sequence(truth))
    rows = np.flatnonzero(trajectory.is_keyframe & matched.has_pose)
    ours_from_true = align_points(matched.world_from_cam[rows, :3, 3], trajectory.centers[rows])
    moved = ours_from_true.apply_to_poses(se3.inverse(matched.world_from_cam[rows]))
    return dict(zip([ids[r] for r in rows], moved, strict=True)), 100 / ours_from_true.scale


def stretch(run: RunFolder, count: int) -> MappingInput:
    """The views of the first keyframes, and the held-out frames between them."""
    settings = MappingConfig(max_side=320, hold_out=8)
    given = load_views(run, run.load_trajectory("tracking"), settings)
    views = given.views[:count]
    held = [v for v in given.held_out if v.frame_id < views[-1].frame_id]
    return MappingInput(views, held, given.class_ids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN[=DATASET]")
    parser.add_argument("--keyframes", type=int, default=14)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found: dict[str, Any] = {}
    for text in given.runs:
        path, _, truth = text.partition("=")
        path, truth = Path(path), Path(truth) if truth else None
        run = RunFolder(path)
        agreement = run.load_proxy_report().get("label_agreement", 0.0)
        found[path.stem] = {"theta^gamma at the mean agreement": round(theta(agreement) ** GAMMA, 4)}
        print(path.stem, json.dumps(found[path.stem]), flush=True)
        found[path.stem]["(25)"] = local_trial(run, truth)
        print(path.stem, "(25)", json.dumps(found[path.stem]["(25)"]), flush=True)
        views = stretch(run, given.keyframes) if given.keyframes else None
        if views is None:
            continue
        for name, change in VARIANTS.items():
            found[path.stem][name] = trial(views, change)
            print(path.stem, name, json.dumps(found[path.stem][name]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
