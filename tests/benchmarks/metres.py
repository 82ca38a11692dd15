"""How well a run without any reference knows its metres: each source alone and all together, against the truth.

    python tests/benchmarks/metres.py [NAME ...] [--work DIR] [--networks FOLDER] [--json FILE]

Needs the recordings in ../shared/data beside the repository. Recordings are reconstructed until `tracking` without any
flag but those of `JOBS`; a run that is there is not made again. The depth network and the classes network of the
default pull are taken from FOLDER (../shared/data/models); classes are the network's frame by frame where the run's own
are only regions.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.trajectory import read_matrices
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.labels.learned import OnnxLabels
from msgs_slam.pipelines.networks.network_pass import ResultCache, Workplace
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, FRAMES, PROXY_MAPS, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.evidence import Evidence, combine
from msgs_slam.pipelines.scene.metres import Seen, describe, load_seen, usual_evidence
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Trajectory

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Job:
    """source and truth relative to the data folder, and options as a user would type them."""

    source: str
    truth: str
    options: tuple[str, ...] = ()


JOBS = {
    "whiteroom": Job("whiteroom/video.mp4", "whiteroom"),
    "replica": Job("replica_office0/rgb", "replica_office0"),
    "kitchen": Job("videos/kitchen_640x480_30fps.mp4", "kitchen"),
    "kitchen_long": Job(
        "kitchen_long/kitchen_33s_640x480_30fps.mp4", "kitchen_long/world_from_camera_16.txt",
        ("--set", "frames.rate=3"),
    ),
}  # fmt: skip


def reconstruct(name: str, work: Path) -> RunFolder:
    """The run of a job until tracking; its errors end this script."""
    job, run = JOBS[name], RunFolder(work / f"{name}.msgs")
    if not (run.stage("tracking") / "trajectory.npz").exists():
        command = [sys.executable, "-m", "msgs_slam", "reconstruct", DATA / job.source, "--out", run.root]
        rest = ["--until", "tracking", "-q", *job.options]
        subprocess.run([*map(str, command), *rest], check=True, stdout=sys.stderr)
    return run


def true_scale(run: RunFolder, trajectory: Trajectory, truth: Path) -> float:
    """Metres per unit of the run by Sim(3) alignment of its camera centres."""
    frames = run.load(FRAMES)
    if truth.suffix == ".txt":  # a pose for every frame of the video
        true = read_matrices(truth)[[f.source_index for f in frames]]
    else:
        from msgs_slam.pipelines.evaluation.truth import match_truth

        true = match_truth(frames, truth.name == "replica_office0", open_sequence(truth)).world_from_cam
    usable = trajectory.is_posed & np.isfinite(true).all(axis=(1, 2))
    return align_points(trajectory.centers[usable], true[usable, :3, 3]).scale


def with_names(run: RunFolder, seen: Seen, store: ModelStore) -> Seen:
    """The same keyframes with the classes network's labels, voted on in the world as the proxy stage does."""
    model = store.first_here("segmentation")
    if seen.is_named or model is None:
        return seen
    calibration, backbone = run.load(CALIBRATION), run.find(BACKBONE)
    camera = calibration.intrinsics.at_most(640)
    sequence = Sequence(run.load(FRAMES), calibration, camera, backbone, run.image)
    frames = [f for f in sequence.frames if f.id in set(seen.frame_ids)]
    depths = {}
    for frame in frames:
        maps = run.load(PROXY_MAPS, of=frame.id)
        depths[frame.id] = DepthEstimate(maps.depth, maps.confidence)
    with tempfile.TemporaryDirectory() as scratch:
        place = Workplace(
            sequence, lambda: Path(scratch), 1, "cpu", SilentProgress(), ResultCache(Path(scratch) / "kept", 0)
        )
        labels = OnnxLabels(store.card(model), place, 16)
        labels.fit(frames, lambda frame: depths[frame.id])
        maps_of = {}
        for frame in frames:
            found = labels.estimate(frame, depths[frame.id])
            maps_of[frame.id] = found.labels
    relabelled = [
        replace(f, maps=replace(f.maps, labels=maps_of[i])) for i, f in zip(seen.frame_ids, seen.frames, strict=True)
    ]
    return Seen(relabelled, seen.frame_ids, seen.camera, labels.classes().names, True)


def measure(name: str, work: Path, store: ModelStore) -> list[dict[str, Any]]:
    """One row for each source, for all without networks, and for all."""
    run = reconstruct(name, work)
    trajectory = run.load(TRAJECTORY, "tracking")
    true = true_scale(run, trajectory, DATA / JOBS[name].truth)
    seen = load_seen(run, trajectory)
    model = store.first_here("depth", metres_only=True)
    bare = usual_evidence(seen, None)
    pieces = usual_evidence(with_names(run, seen, store), store.card(model) if model else None)
    rows = [
        _row(name, source, [p for p in pieces if p.source == source], true)
        for source in dict.fromkeys(p.source for p in pieces)
    ]
    return [*rows, _row(name, "all without networks", bare, true), _row(name, "all", pieces, true)]


def _row(name: str, source: str, pieces: list[Evidence], true: float) -> dict[str, Any]:
    found = combine(pieces if source.startswith("all") else [replace(p, wrong=0.0) for p in pieces])
    error = found.log_scale - float(np.log(true))
    return {
        "recording": name,
        "source": source if source.startswith("all") or len(pieces) == 1 else f"{len(pieces)} x {source}",
        "stated / true": round(float(np.exp(error)), 3),
        "sigma": f"{found.sd:.0%}",
        "sigmas off": round(abs(error) / found.sd, 2),
        "says": describe(pieces).text if source.startswith("all") else "",
    }


def main() -> None:
    """Print one row a source and recording, and how the results with all sources meet their bars."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(JOBS), help=f"of {', '.join(JOBS)}")
    parser.add_argument("--work", type=Path, default=Path("metres_runs"))
    parser.add_argument("--networks", type=Path, default=DATA / "models")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        store = ModelStore.open(Path(cache))
        store.take(arguments.networks, store.models)
        os.environ["MSGS_SLAM_CACHE"] = cache
        for name in arguments.names or JOBS:
            rows += measure(name, arguments.work, store)
    print("| " + " | ".join(rows[0]) + " |\n|" + " --- |" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(map(str, row.values())) + " |")
    for kind in ("all without networks", "all"):
        chosen = [r for r in rows if r["source"] == kind]
        errors = [abs(r["stated / true"] - 1) for r in chosen]
        print(f"{kind}: mean |error| {np.mean(errors):.1%}, at most {max(r['sigmas off'] for r in chosen)} sigmas off")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
