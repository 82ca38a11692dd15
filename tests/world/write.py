"""A clip on disk: a sequence with its truth."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from msgs_slam.formats.atomic import write_text
from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.pipelines.system.progress import Progress, SilentProgress
from tests.world.build import World
from tests.world.clip import ClipOptions, WorldFrame, render_frame


def iter_clip(world: World, options: ClipOptions, progress: Progress | None = None) -> Iterator[WorldFrame]:
    """All frames of the clip, in order."""
    indices = (progress or SilentProgress()).track(range(options.frames), "rendering", options.frames)
    return (render_frame(world, options, i) for i in indices)


def write_sequence(
    folder: Path, world: World, options: ClipOptions, frames: Iterable[WorldFrame] | None = None
) -> Path:
    """Write the clip as a sequence with truth, and return `folder`.

    rgb/, depth/ (uint16 millimetres, 0 = nothing) and labels/ (class ids) as PNG with names %06d; traj.txt: one
    world_from_cam 4x4 a row; intrinsics.json with pixel centres at integers and, as cx_colmap, at +0.5; classes.json;
    timestamps.txt in seconds. `frames`: the clip, when it is at hand already. Raises InputError as `atomic_path` does.
    """
    poses, times = [], []
    for i, frame in enumerate(iter_clip(world, options) if frames is None else frames):
        write_rgb(folder / "rgb" / f"{i:06d}.png", frame.rgb)
        write_grey_png(folder / "depth" / f"{i:06d}.png", np.round(frame.depth * 1000).astype(np.uint16))
        write_grey_png(folder / "labels" / f"{i:06d}.png", frame.labels)
        poses.append(frame.world_from_cam)
        times.append(frame.timestamp)
    write_text(folder / "traj.txt", "".join(" ".join(f"{x:.9f}" for x in p.ravel()) + "\n" for p in poses))
    write_text(folder / "timestamps.txt", "".join(f"{t:.6f}\n" for t in times))
    write_text(folder / "intrinsics.json", json.dumps(_camera_json(options), indent=1) + "\n")
    rows = [
        {"id": i, "name": name, "color": list(color)}
        for i, (name, color) in enumerate(zip(world.class_names, world.class_colors, strict=True))
    ]
    write_text(folder / "classes.json", json.dumps({"classes": rows}, indent=1) + "\n")
    return folder


def _camera_json(options: ClipOptions) -> dict[str, object]:
    k = options.intrinsics
    return {
        "width": k.width,
        "height": k.height,
        "fx": k.fx,
        "fy": k.fy,
        "cx": k.cx - 0.5,
        "cy": k.cy - 0.5,
        "cx_colmap": k.cx,
        "cy_colmap": k.cy,
        "depth_scale": 1000.0,
        "fps": options.fps,
        "distortion": [options.k1, 0.0, 0.0, 0.0],
        "pixel_centre": "integer: cx, cy for a first pixel centre at (0, 0); cx_colmap, cy_colmap for (0.5, 0.5)",
    }
