"""For a trainer's plug-in: a video in, a folder out that trainers open, progress as JSON lines, and a way to cancel.

    python video_to_dataset.py video.mp4 dataset --quality draft

A graphical program starts it as a process of its own, with the Python of an environment that has msgs-slam. Each
line of its stdout is a JSON object:

    {"event": "progress", "stage": "depth and classes", "index": 2, "of": 6, "done": 12, "total": 46}
    {"event": "warning", "message": "..."}
    {"event": "done", "dataset": "...", "images": 46, "metres_per_unit": 1.9, "metres_per_unit_sd": 0.2}
    {"event": "failed", "message": "..."} or {"event": "cancelled"}

The exit code is 0, 1 or 2 in this order. To cancel, write a line to its stdin, or close that; started again with the
same paths it continues. The folder has images/, sparse/0 (COLMAP), transforms.json (nerfstudio), masks/ where people
were left out, and depth/ with --depth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

STAGES = {
    "frames": "camera poses", "proxy": "depth and classes", "tracking": "loops and remaining poses", "mapping": "map",
    "global_ba": "poses between", "export": "files",
}  # fmt: skip


def main() -> int:
    """Run the job and report how it ends."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("videos", nargs="+", type=Path, metavar="VIDEO", help="one camera, one place")
    parser.add_argument("dataset", type=Path, help="the folder to write")
    parser.add_argument("--quality", choices=("draft", "normal", "best"), default="normal")
    parser.add_argument("--depth", action="store_true", help="write a depth map for each image, too")
    given = parser.parse_args()
    job = Job()
    threading.Thread(target=job.cancel_on_input, daemon=True).start()
    run = given.dataset.with_name(f"{given.dataset.name}.msgs")
    kind, made = "depth" if given.depth else "colmap", given.dataset.with_name(f"{given.dataset.name}.partial")
    words = ["reconstruct", *map(str, given.videos), "--out", str(run), "--quality", given.quality]
    if job.call(*words) and job.call("export", str(run), "--only", kind, "--to", str(made), "--overwrite"):
        shutil.rmtree(given.dataset, ignore_errors=True)
        made.rename(given.dataset)
        say("done", dataset=str(given.dataset), images=len(list((given.dataset / "images").iterdir())), **metres(run))
        return 0
    say("cancelled" if job.cancelled else "failed", **({} if job.cancelled else {"message": job.reason}))
    return 2 if job.cancelled else 1


def metres(run: Path) -> dict[str, float]:
    """How long a unit of the data set is, where the run could tell."""
    scale = json.loads((run / "export" / "scale.json").read_text(encoding="utf-8"))
    if not (value := scale.get("metres_per_unit")):
        return {}
    return {"metres_per_unit": value, "metres_per_unit_sd": value * scale["metres_relative_sd"]}


class Job:
    """Commands of msgs-slam, one after the other; another thread may cancel them."""

    def __init__(self) -> None:
        self.cancelled, self.reason = False, "it ended without a reason"
        self._process: subprocess.Popen[str] | None = None

    def call(self, *words: str) -> bool:
        """Run a command to its end and pass on what it says; returns whether it ended well."""
        if self.cancelled:
            return False
        command = [sys.executable, "-m", "msgs_slam", *words, "--log-format", "json"]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, encoding="utf-8") as process:
            self._process = process
            if self.cancelled:  # meanwhile
                process.terminate()
            for event in events(process):
                self._pass_on(event)
        return process.returncode == 0

    def _pass_on(self, event: dict[str, Any]) -> None:
        kind = event["event"]
        if kind == "progress" and "stage" in event:
            kept = {key: event[key] for key in ("index", "of", "done", "total") if key in event}
            say("progress", stage=STAGES.get(event["stage"], event["stage"]), **kept)
        elif kind == "stage" and event["state"] == "done":
            say("progress", stage=STAGES.get(event["name"], event["name"]), seconds_left=event["seconds_left"])
        elif kind == "warning":
            say("warning", message=event["message"])
        elif kind == "error":
            self.reason = event["message"]

    def cancel_on_input(self) -> None:
        """Wait for a line or the end of stdin; then stop the command at its next snapshot."""
        sys.stdin.readline()
        self.cancelled = True
        if self._process is not None:
            self._process.terminate()


def events(process: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    """The JSON lines of a command; other output, of libraries, is left out."""
    assert process.stderr is not None
    for line in process.stderr:
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict) and "event" in event:
            yield event


def say(event: str, **values: Any) -> None:
    """Write one line for the program that started this."""
    print(json.dumps({"event": event, **values}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
