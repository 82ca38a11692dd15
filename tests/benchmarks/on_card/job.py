"""The whole job, a video to poses, map and mesh, on the card and on the CPU of the same machine."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from end_to_end import truth_figures

from on_card.rows import Rows
from on_card.scenes import REHEARSAL

SMALL = ("--set", "frames.rate=2", "--set", "frames.max_side=160", "--set", "mapping.passes=1",
         "--set", "mapping.min_iterations=20")  # fmt: skip
"""Of a run that only compiles what the others need; a rehearsal has no other."""
FIGURES = ("posed", "keyframe_psnr", "gaussians", "keyframes", "faces")


def begin(video: Path, out: Path, device: str, settings: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    """Start a run; what it says goes into a file beside it."""
    command = [sys.executable, "-m", "msgs_slam", "reconstruct", str(video), "--out", str(out), "--device", device]
    with out.with_suffix(".log").open("w") as log:
        return subprocess.Popen(
            [*command, *settings, "-q"], stdout=log, stderr=log, text=True
        )  # fmt: skip


def warm_up(video: Path, work: Path) -> list[subprocess.Popen[str]]:
    """Small runs on both, which leave compiled kernels in their caches."""
    return [begin(video, work / f"small_{d}.msgs", d, SMALL) for d in (("cpu",) if REHEARSAL else ("cuda", "cpu"))]


def whole_jobs(rows: Rows, video: Path, work: Path, truth: Path | None, seconds: dict[str, float]) -> None:
    """A run on each, with all settings at their defaults; `seconds`: of each at most."""
    for name, device in (("card", "cpu" if REHEARSAL else "cuda"), ("cpu", "cpu")):
        with rows.attempt(f"whole job on {name}"):
            out, start = work / f"{name}.msgs", time.perf_counter()
            process = begin(video, out, device, SMALL if REHEARSAL else ())
            try:
                code: int | None = process.wait(seconds[name])
            except subprocess.TimeoutExpired:
                process.kill()
                code = None
            row = {"place": name, "exit_code": code, "seconds": round(time.perf_counter() - start, 1), **figures(out)}
            if code == 0 and truth is not None:
                row |= _against(out, truth)
            if code != 0:
                row["said"] = out.with_suffix(".log").read_text(errors="replace")[-800:]
            rows.add("job", **row)


def figures(run: Path) -> dict[str, Any]:
    """Seconds of the stages that are done, the largest memory, and what they found."""
    path = run / "manifest.json"
    stages = json.loads(path.read_text())["stages"] if path.exists() else {}
    known = {k: v for s in stages.values() for k, v in s["figures"].items() if k in FIGURES}
    peak = max((s["peak_memory_mb"] for s in stages.values()), default=0)
    return {"stages": {k: round(s["seconds"], 1) for k, s in stages.items()}, "peak_mb": round(peak), **known}


def _against(run: Path, truth: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "msgs_slam", "evaluate", str(run), "--truth", str(truth), "-q"]
    subprocess.run(command, check=True, timeout=60, stdout=subprocess.DEVNULL)
    found = json.loads((run / "evaluation" / "evaluation.json").read_text())
    mesh = found.get("mesh") or {}
    return truth_figures(found) | {"mesh_f": mesh.get("f_score", mesh.get("f"))}
