"""Walks of any length: what a keyframe costs in every stage, in time and memory, and how good the result is, by length.

    python tests/benchmarks/long.py --work RUNS                        walks of 15, 30 and 60 seconds
    python tests/benchmarks/long.py --work RUNS 60 300 1200 --json rows.json
    python tests/benchmarks/long.py --work RUNS 60x10                  60 seconds of walk, ten times forth and back
    python tests/benchmarks/long.py --work RUNS --fps 10 --size 640x480 --focal 0.6 --set mapping.passes=5
    python tests/benchmarks/long.py --work RUNS --poses --size 480x360   structure from motion alone: its error

The walk leads through a building of rooms and corridors that is made as it is read (`worlds/building.py`): exact
poses, depth and classes. Every stage runs in a process of its own, so that its peak of memory is its own, and its CPU
seconds, which a crowded machine changes least. What lies finished in RUNS is not done again, so that a longer walk can
be added to a table later.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import BACKBONE, FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from tests.benchmarks.worlds.building import Walk, around, frames
from tests.world import ClipOptions, write_sequence


def make_clip(folder: Path, walk: Walk, camera: dict[str, Any]) -> tuple[Path, Path]:
    """video.mkv, without loss, and truth/ with poses, depth and classes; holds one picture at a time. camera: its
    width, height, fps and focal length in pixels."""
    options = ClipOptions(frames=round(walk.seconds * camera["fps"]), **camera)
    stamp, done = asdict(walk) | camera, folder / "clip.json"
    video, truth = folder / "video.mkv", folder / "truth"
    if not done.exists() or json.loads(done.read_text()) != stamp:
        write_sequence(truth, around(0, 0.01), options, frames(walk, options))
        write_video(video, (read_rgb(p) for p in sorted((truth / "rgb").iterdir())), camera["fps"])
        done.write_text(json.dumps(stamp))
    return video, truth


def msgs_slam(*arguments: object) -> None:
    """Run the tool as a user does; its errors end this script."""
    subprocess.run([sys.executable, "-m", "msgs_slam", *map(str, arguments)], check=True, stdout=sys.stderr)


def cpu_seconds() -> float:
    """Of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def prepared(name: str, work: Path, camera: dict[str, Any]) -> tuple[Path, Path, Path]:
    """The video of a walk, its truth, and where its run is."""
    seconds, _, turns = name.partition("x")
    folder = work / f"walk_{name}_{camera['width']}"
    return *make_clip(folder, Walk(float(seconds), int(turns or 0)), camera), folder / "video.msgs"


def run_walk(name: str, work: Path, camera: dict[str, Any], settings: list[str]) -> dict[str, Any]:
    """One row: the walk made, reconstructed stage by stage, evaluated."""
    video, truth, run = prepared(name, work, camera)
    for stage in STAGES:
        before, cpu = cpu_seconds(), run.with_suffix(f".{stage}.cpu")
        msgs_slam("reconstruct", video, "--out", run, "--until", stage, "-q", *settings)
        if not cpu.exists():
            cpu.write_text(f"{cpu_seconds() - before:.2f}")
    if not (run / "evaluation" / "evaluation.json").exists():
        msgs_slam("evaluate", run, "--truth", truth, "-q")
    return row_of(name, run, truth)


def poses_of(name: str, work: Path, camera: dict[str, Any], settings: list[str]) -> dict[str, Any]:
    """One row of `frames` alone: how far its keyframes are off."""
    video, truth, run = prepared(name, work, camera)
    msgs_slam("reconstruct", video, "--out", run, "--until", STAGES[0], "-q", *settings)
    backbone, frames = RunFolder(run).find(BACKBONE), RunFolder(run).load(FRAMES)
    assert backbone is not None
    stage = json.loads((run / "manifest.json").read_text())["stages"][STAGES[0]]
    centers, path = true_path(truth)
    wanted = centers[[frames[i].source_index for i in backbone.frame_ids]]
    found = np.linalg.inv(backbone.cam_from_world)[:, :3, 3]
    apart = np.linalg.norm(align_points(found, wanted).apply(found) - wanted, axis=1)
    ate = float(np.sqrt((apart**2).mean()))
    placed = f"{len(found)} of {stage['figures']['frames']} frames"
    figures = {"ate_cm": round(100 * ate, 2), "ate_share_of_path": round(ate / path, 6)}
    return {"walk": name, "path_m": round(path, 1), "keyframes": placed, **figures, "peak_mb": stage["peak_memory_mb"]}


def true_path(truth: Path) -> tuple[NDArray[np.float64], float]:
    """Camera centres (N, 3) and the length of the way, metres."""
    centers = np.loadtxt(truth / "traj.txt").reshape(-1, 4, 4)[:, :3, 3]
    return centers, float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())


def row_of(name: str, run: Path, truth: Path) -> dict[str, Any]:
    """Figures of a finished and evaluated run."""
    stages = json.loads((run / "manifest.json").read_text())["stages"]
    found = json.loads((run / "evaluation" / "evaluation.json").read_text())
    _, path = true_path(truth)
    keyframes = stages["tracking"]["figures"]["keyframes"]
    ate = found["trajectory"].get("sim3 all", {}).get("rmse")
    views = [v["psnr"] for v in found["views"] if "psnr" in v] if isinstance(found["views"], list) else []
    return {
        "walk": name,
        "path_m": round(path, 1),
        "frames": stages["frames"]["figures"]["frames"],
        "posed": stages["tracking"]["figures"]["posed"],
        "keyframes": keyframes,
        "seconds_a_keyframe": {s: round(stages[s]["seconds"] / keyframes, 3) for s in STAGES},
        "cpu_seconds_a_keyframe": {
            s: round(float(run.with_suffix(f".{s}.cpu").read_text()) / keyframes, 3) for s in STAGES
        },
        "peak_mb": {s: round(stages[s]["peak_memory_mb"]) for s in STAGES},
        "run_mb": round(sum(f.stat().st_size for f in run.rglob("*") if f.is_file()) / 1e6, 1),
        "ate_cm": None if ate is None else round(100 * ate, 2),
        "ate_share_of_path": None if ate is None else round(ate / path, 6),
        "psnr_db": found["images"].get("keyframes", {}).get("psnr"),
        "worst_psnr_db": round(min(views), 2) if views else None,
        "depth_l1_cm": round(100 * found["depth"]["scaled_l1"], 2) if "scaled_l1" in found["depth"] else None,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one row a walk, then seconds a keyframe and peak memory of every stage."""
    by_stage = ("seconds_a_keyframe", "cpu_seconds_a_keyframe", "peak_mb") if "posed" in rows[0] else ()
    plain = [k for k in rows[0] if k not in by_stage]
    lines = ["| " + " | ".join(plain) + " |", "|" + " --- |" * len(plain)]
    lines += ["| " + " | ".join(str(row[k]) for k in plain) + " |" for row in rows]
    for key in by_stage:
        lines += ["", f"| {key} | " + " | ".join(STAGES) + " | all |", "|" + " --- |" * (len(STAGES) + 2)]
        for row in rows:
            values = row[key].values()
            together = max(values) if key == "peak_mb" else round(sum(values), 3)
            lines.append(f"| {row['walk']} | " + " | ".join(map(str, [*values, together])) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walks", nargs="*", default=["15", "30", "60"], help="SECONDS, or SECONDSxTURNS forth and back")
    parser.add_argument("--work", type=Path, default=Path("long_runs"))
    parser.add_argument("--size", default="240x180")
    parser.add_argument("--fps", type=float, default=5.0, help="of the video")
    parser.add_argument("--focal", type=float, default=0.85, help="of the lens, as a share of the width")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--poses", action="store_true", help="frames alone, and how far its keyframes are off")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    width, height = (int(x) for x in arguments.size.split("x"))
    camera = {"width": width, "height": height, "fps": arguments.fps, "focal": arguments.focal * width}
    settings = [part for setting in arguments.settings for part in ("--set", setting)]
    row = poses_of if arguments.poses else run_walk
    rows = [row(name, arguments.work, camera, settings) for name in arguments.walks]
    print(table(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
