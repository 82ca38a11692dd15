"""The demo: a short synthetic video with known truth, reconstructed like any other video, judged against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from formats.datasets import open_sequence
from formats.errors import InputError
from formats.jsonfile import read_json, write_json
from formats.video_writer import write_video
from pipelines.evaluation.table import evaluation_table
from pipelines.evaluation.write import write_evaluation
from pipelines.progress import Progress
from pipelines.run_folder import RunFolder
from pipelines.world import ClipOptions, iter_clip, make_world, write_sequence

CLIP = ClipOptions(frames=36, width=320, height=240, fps=10.0, laps=0.32)
VIDEO, TRUTH, RUN = "room.mp4", "room_truth", "room.msgs"
_TEXEL = 0.006


@dataclass(frozen=True)
class DemoResult:
    """Where everything lies, the figures of `evaluate_run` and their table in Markdown."""

    video: Path
    truth: Path
    run: RunFolder
    figures: dict[str, Any]
    table: str


def make_demo_clip(folder: Path, progress: Progress, options: ClipOptions = CLIP) -> tuple[Path, Path]:
    """Write the video and, in a folder beside it, the truth; returns both paths. What is there already stays.

    Raises InputError when the folder holds something else or cannot be written.
    """
    video, truth, done = folder / VIDEO, folder / TRUTH, folder / TRUTH / "clip.json"
    stamp = {"clip": vars(options), "texel": _TEXEL}
    if done.exists() and video.exists() and read_json(done) == stamp:
        return video, truth
    if video.exists() and not done.exists():
        raise InputError(f"{video} is there already and is not the demo's. Choose another folder")
    world = make_world(texel=_TEXEL)
    frames = list(iter_clip(world, options, progress))
    write_sequence(truth, world, options, frames)
    write_video(video, (f.rgb for f in frames), options.fps)
    write_json(done, stamp)
    return video, truth


def run_demo(
    folder: Path, reconstruct: Callable[[Path, RunFolder], Any], progress: Progress, options: ClipOptions = CLIP
) -> DemoResult:
    """Make the clip, have it reconstructed from the video alone (`reconstruct(video, run)`), evaluate the run.

    The truth is opened only after the reconstruction has ended. Raises InputError as the steps do.
    """
    video, truth = make_demo_clip(folder, progress, options)
    run = RunFolder(folder / RUN)
    reconstruct(video, run)
    figures = write_evaluation(run, open_sequence(truth), progress, max_views=10)
    return DemoResult(video, truth, run, figures, evaluation_table(figures))


def demo_summary(result: DemoResult) -> list[str]:
    """A few lines for a person: the errors, and where to look."""
    figures = result.figures
    frames, trajectory, images = figures["frames"], figures["trajectory"], figures["images"]
    lines = [f"{frames['posed']} of {frames['picked']} frames posed"]
    if "missing" in trajectory:
        lines.append(f"no trajectory error: {trajectory['missing']}")
    else:
        rmse = trajectory["sim3 all"].get("rmse")
        lines.append(f"camera path: {100 * rmse:.2f} cm RMSE after Sim(3)" if rmse is not None else "no camera path")
    if "keyframes" in images and "psnr" in images["keyframes"]:
        lines.append(f"map: {images['keyframes']['psnr']:.1f} dB PSNR on keyframes")
    if "focal error" in figures["camera"]:
        lines.append(f"focal length: {figures['camera']['focal error']:+.2%} off ({figures['camera']['origin']})")
    if "scaled_l1" in figures["depth"]:
        lines.append(f"depth: {100 * figures['depth']['scaled_l1']:.1f} cm mean error after one scale")
    root = result.run.root
    lines += [f"look at {root / 'evaluation' / 'views.png'}", f"        {root / 'evaluation' / 'evaluation.md'}"]
    return lines
