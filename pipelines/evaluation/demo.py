"""The demo: a short synthetic video, reconstructed like any other video, evaluated against its ground truth."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...formats.atomic import write_bytes
from ...formats.datasets import open_sequence
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.video import VideoReader
from ..run.folder import RunFolder
from ..system.progress import Progress
from .write import write_evaluation

VIDEO, TRUTH, RUN = "room.mp4", "room_truth", "room.msgs"
CLIP = Path(__file__).with_name("demo_clip")
"""The video, and its truth without the images as a zip: 36 frames of a made-up room (tests/world/demo_clip.py)."""


@dataclass(frozen=True)
class DemoResult:
    """The run of a demo and the figures of `evaluate_outcome`."""

    run: RunFolder
    figures: dict[str, Any]


def unpack_demo_clip(folder: Path, clip: Path = CLIP) -> tuple[Path, Path]:
    """Put the video and, in a folder beside it, its truth into `folder`; returns both paths. What is there stays.

    Raises InputError when the folder holds another video of that name or cannot be written.
    """
    video, truth, content = folder / VIDEO, folder / TRUTH, (clip / VIDEO).read_bytes()
    if video.exists():
        if video.read_bytes() != content:
            raise InputError(f"{video} is there already and is not the demo's. Choose another folder")
        return video, truth
    for frame in VideoReader(clip / VIDEO):
        write_rgb(truth / "rgb" / f"{frame.source_index:06d}.png", frame.rgb)
    with zipfile.ZipFile(clip / f"{TRUTH}.zip") as archive:
        archive.extractall(truth)
    write_bytes(video, content)  # last: where it is, the truth is whole
    return video, truth


def run_demo(
    folder: Path, reconstruct: Callable[[Path, RunFolder], Any], progress: Progress, clip: Path = CLIP
) -> DemoResult:
    """Unpack the clip, have it reconstructed from the video alone (`reconstruct(video, run)`), evaluate the run.

    The truth is opened only after the reconstruction has ended. Raises InputError as the steps do.
    """
    video, truth = unpack_demo_clip(folder, clip)
    run = RunFolder(folder / RUN)
    reconstruct(video, run)
    figures = write_evaluation(run, open_sequence(truth), progress)
    return DemoResult(run, figures)


def demo_summary(result: DemoResult) -> list[str]:
    """A few lines for a person: the errors, and where to look."""
    figures = result.figures
    frames, trajectory = figures["frames"], figures["trajectory"]
    lines = [f"{frames['posed']} of {frames['picked']} frames posed"]
    if "missing" in trajectory:
        lines.append(f"no trajectory error: {trajectory['missing']}")
    else:
        rmse = trajectory["sim3 all"].get("rmse")
        lines.append(f"camera path: {100 * rmse:.2f} cm RMSE after Sim(3)" if rmse is not None else "no camera path")
    if figures["keyframe psnr"] is not None:
        lines.append(f"map: {figures['keyframe psnr']:.1f} dB PSNR at keyframes")
    if "focal error" in figures["camera"]:
        lines.append(f"focal length: {figures['camera']['focal error']:+.2%} off ({figures['camera']['origin']})")
    if "scaled_l1" in figures["depth"]:
        lines.append(f"depth: {100 * figures['depth']['scaled_l1']:.1f} cm mean error after one scale")
    root = result.run.root
    lines += [f"images: {root / 'evaluation' / 'views.png'}", f"tables: {root / 'evaluation' / 'evaluation.md'}"]
    return lines
