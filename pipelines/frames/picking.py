"""Which images of a source become frames, and how they are stored until the lens is known."""

from dataclasses import asdict, replace

from ...formats.atomic import copy_file
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.textfile import read_json, write_json
from ...formats.video import VideoFrame
from ..config import FramesConfig
from ..engine.stages import StageContext
from ..source.faces import Faces
from ..source.sharpness import reduce_image, sharpest_of_windows
from ..types import Frame
from .tasks import AnySource, picked


def pick_frames(context: StageContext, source: AnySource, faces: Faces | None) -> list[Frame]:
    """The sharpest image of every window of time, kept in the snapshot. Raises InputError for a source of one."""
    table = context.snapshot / "picked.json"
    if table.exists():
        stored = read_json(table, None)
        frames = [Frame(**row) for row in stored["frames"]]
        if all(picked(context, f.name).exists() for f in frames):
            for message in stored["warnings"]:
                context.warn(message)
            return frames
    config, earlier = context.config.frames, len(context.warnings)  # those before are given again by who gave them
    pictures = source.read(warn=context.warn)
    pictures = context.progress.track(pictures, "picking", source.expected_frames or None)
    rate = config.rate if source.has_times else 0.0
    frames = []
    for picture, score in sharpest_of_windows(pictures, rate):
        frame_id = len(frames)
        timestamp = picture.timestamp if source.has_times else _untimed(config, frame_id)
        name = source.name(frame_id, picture.source_index)
        frames.append(Frame(frame_id, name, timestamp, picture.source_index, score))
        _save_picked(context, source, picture, name, faces)
    context.same_source()
    if len(frames) < 2:
        raise InputError(f"{source.path} gives one frame only; a reconstruction needs several views of a scene")
    if faces is not None:
        frames = _of_all_directions(frames, faces)
    write_json(table, {"frames": [asdict(f) for f in frames], "warnings": context.warnings[earlier:]})
    return frames


def _of_all_directions(frames: list[Frame], faces: Faces) -> list[Frame]:
    """Direction by direction, as `Rig` counts."""
    named = [(c, f, faces.names(f.name)[c]) for c in range(len(faces)) for f in frames]
    return [replace(f, id=c * len(frames) + f.id, name=name) for c, f, name in named]


def _untimed(config: FramesConfig, frame_id: int) -> float:
    return frame_id / (config.rate if config.rate > 0 else 1.0)


def _save_picked(context: StageContext, source: AnySource, picture: VideoFrame, name: str, faces: Faces | None) -> None:
    if faces is not None:
        for face, rgb in zip(faces.names(name), faces.cut(picture.rgb), strict=True):
            write_rgb(picked(context, face), rgb)
        return
    path = picked(context, name)
    reduced = reduce_image(picture.rgb, context.config.frames.max_side)
    original = source.original(picture.source_index) if reduced is picture.rgb else None
    if original is None:
        write_rgb(path, reduced)
    else:
        copy_file(original, path)
