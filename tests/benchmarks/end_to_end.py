"""The whole job on the real recordings: one table of what came out, against their truth.

    python tests/benchmarks/end_to_end.py [NAME ...] [--work DIR] [--json FILE]

Needs the recordings in ../shared/data beside the repository. A sequence that is done in DIR is not done again.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import keyframe_psnr

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Job:
    """source and truth relative to the data folder; options as a user would type them."""

    source: str
    truth: str | None
    options: tuple[str, ...] = ()


JOBS = {
    "kitchen": Job("videos/kitchen_640x480_30fps.mp4", "kitchen"),
    "bedroom": Job("videos/bedroom_848x364_58fps.mp4", None),
    "whiteroom": Job("whiteroom/video.mp4", "whiteroom"),
    "replica": Job(
        "replica_office0/rgb", "replica_office0",
        ("--intrinsics", "300,300,300,170", "--depth", "files", "--semantics", "files"),
    ),
}  # fmt: skip


def msgs_slam(*arguments: object) -> None:
    """Run the tool as a user does; its errors end this script."""
    subprocess.run([sys.executable, "-m", "msgs_slam", *map(str, arguments)], check=True, stdout=sys.stderr)


def run_job(name: str, job: Job, work: Path) -> dict[str, Any]:
    """Reconstruct and evaluate; returns one row."""
    run = work / f"{name}.msgs"
    msgs_slam("reconstruct", DATA / job.source, "--out", run, *job.options, "-q")
    records = RunFolder(run).manifest().records
    stages = json.loads((run / "manifest.json").read_text())["stages"]
    row: dict[str, Any] = {
        "sequence": name,
        "frames": stages["frames"]["figures"]["frames"],
        "posed": stages["tracking"]["figures"]["posed"],
        "focal_px": stages["frames"]["figures"]["focal_px"],
        "keyframe_psnr_db": keyframe_psnr(records),
        "seconds": round(sum(s["seconds"] for s in stages.values())),
        "peak_mb": round(max(s["peak_memory_mb"] for s in stages.values())),
    }
    if job.truth:
        msgs_slam("evaluate", run, "--truth", DATA / job.truth, "-q")
        row |= truth_figures(json.loads((run / "evaluation" / "evaluation.json").read_text()))
    return row


def truth_figures(evaluation: dict[str, Any]) -> dict[str, Any]:
    """The errors against the truth, those that there are."""
    trajectory, labels = evaluation["trajectory"], evaluation["labels"]
    found = {
        "ate_sim3_cm": 100 * trajectory["sim3 all"]["rmse"] if "rmse" in trajectory.get("sim3 all", {}) else None,
        "ate_se3_cm": 100 * trajectory["se3 all"]["rmse"] if "rmse" in trajectory.get("se3 all", {}) else None,
        "depth_l1_cm": 100 * evaluation["depth"]["scaled_l1"] if "scaled_l1" in evaluation["depth"] else None,
        "miou": labels.get("mean_iou"),
    }
    return {name: round(value, 4) for name, value in found.items() if value is not None}


def main() -> None:
    """Print one row a sequence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(JOBS), help=f"of {', '.join(JOBS)}")
    parser.add_argument("--work", type=Path, default=Path("end_to_end_runs"))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [run_job(name, JOBS[name], arguments.work) for name in arguments.names]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns))
    for row in rows:
        print("| " + " | ".join(str(row.get(column, "")) for column in columns) + " |")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
