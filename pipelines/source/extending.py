"""Extension of a finished run by videos: the list of all of them, beside the poses that the run had before.

The run is made anew from that list, with these poses given, and in their world.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ...formats.reading import require_listable
from ...formats.trajectory import write_tum
from ...formats.video import probe_video
from ..config import EXTENSION, SOURCE_LIST, STAGES, Config
from ..run.files import CALIBRATION, TRAJECTORY
from ..run.folder import RunFolder
from ..run.manifest import Manifest, Source, write_manifest
from ..system.wording import quoted
from .files import require_different, video_files
from .recording import DatasetRecording, open_recording

_FINAL = "global_ba"
_POSES = "poses.txt"


def with_earlier_poses(source: Path, config: Config) -> Config:
    """Return the settings with the poses from before an extension as given ones; of any other source as they are."""
    poses = source.with_name(_POSES)
    if not is_extension(source) or not poses.is_file():
        return config
    return replace(config, frames=replace(config.frames, poses=str(poses)))


def is_extension(source: Path) -> bool:
    """Return whether a run's source is the list of an extension."""
    return source.name == SOURCE_LIST and source.parent.name.startswith(EXTENSION)


def is_added(run: RunFolder, videos: Sequence[Path]) -> bool:
    """Return whether the run's last extension, finished or not, was by exactly these videos."""
    source, added = Path(run.source.path), [video.resolve() for video in videos]
    return is_extension(source) and list(video_files(source))[-len(added) :] == added


def require_extendable(run: RunFolder, videos: Sequence[Path], config: Config) -> None:
    """Raise InputError where the run cannot be extended by these videos; nothing is written."""
    source = Path(run.source.path)
    done, needed = run.records, STAGES[: STAGES.index(_FINAL) + 1]
    unfinished = [s for s in needed if s not in done or run.damaged(s)]
    made = {
        "with --poses": bool(config.frames.poses),
        f"from {source}, no video": source.is_dir()
        or isinstance(open_recording(source, config.run.format), DatasetRecording),
        "with --method paper": config.run.method == "paper",
        "from panoramas": not unfinished and run.load(CALIBRATION).directions > 1,
    }
    if odd := next((how for how, holds in made.items() if holds), None):
        known = "" if made["with --method paper"] else f", with --poses {quoted(run.path('export', 'sparse', '0'))}"
        raise InputError(
            f"{run.root} was made {odd}: only runs of ordinary videos without given poses are extended. Reconstruct "
            f"all of it into another folder{known}"
        )
    if unfinished:
        raise InputError(f"{run.root}: {unfinished[0]} is not done. Run `msgs-slam resume {quoted(run.root)}` first")
    require_different(videos)
    require_listable(videos)
    files = video_files(source)
    width, height = _size(files[0])
    for video in videos:
        if video.resolve() in [file.resolve() for file in files]:
            raise InputError(f"{video} is part of {run.root} already: give another one")
        if _size(video) != (width, height):
            raise InputError(
                f"{video} is {_size(video)[0]}x{_size(video)[1]}, the videos of {run.root} are {width}x{height}: a run "
                "has one camera, held one way. Make it a run of its own, or convert it to that size if the camera is "
                "the same. Nothing was changed"
            )


def add_videos(run: RunFolder, videos: Sequence[Path], config: Config) -> Source:
    """Make the run one of all its videos and these, with none of its stages done; one write of the manifest decides."""
    files = [file.resolve() for file in video_files(Path(run.source.path))]
    earlier = sorted(run.root.glob(f"{EXTENSION}*"))
    numbers = [int(n) for p in earlier if (n := p.name.removeprefix(EXTENSION)).isdigit()]
    path = run.path(f"{EXTENSION}{max(numbers, default=0) + 1}", SOURCE_LIST)
    trajectory = run.load(TRAJECTORY, _FINAL)
    placed = np.flatnonzero(trajectory.is_posed)
    write_tum(path.with_name(_POSES), trajectory.timestamps[placed], trajectory.world_from_cam[placed])
    write_text(path, "".join(f"{file}\n" for file in [*files, *(v.resolve() for v in videos)]))
    source = Source(str(path.resolve()), open_recording(path, config.run.format).digest)
    write_manifest(run.manifest_file, Manifest(source, {}))
    for old in earlier:
        shutil.rmtree(old, ignore_errors=True)
    return source


def _size(video: Path) -> tuple[int, int]:
    found = probe_video(video)
    return found.width, found.height
