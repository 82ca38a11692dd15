"""A finished run becomes one of more videos: what it was is kept in it, and what follows starts from that."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ...formats.safe_path import require_listable
from ...formats.video import probe_video
from ..config import Config
from ..run.before import FINAL, save_before
from ..run.files import CALIBRATION
from ..run.folder import RunFolder
from ..run.names import EXTENSION, SOURCE_LIST, STAGES
from ..run.records import Manifest, Source, load_records, load_source, write_manifest
from ..source.opening import open_source, source_digest, video_files
from ..source.recording import RecordingSource
from ..system.progress import Progress
from ..system.wording import quoted
from .localise import require_overlap


def is_added(run: RunFolder, videos: Sequence[Path]) -> bool:
    """Whether the run's last extension, finished or not, was by exactly these videos."""
    source = Path(load_source(run).path)
    added = [video.resolve() for video in videos]
    return source.parent.name.startswith(EXTENSION) and list(video_files(source))[-len(added) :] == added


def require_extendable(run: RunFolder, videos: Sequence[Path], config: Config, progress: Progress) -> None:
    """Raise InputError where the run cannot be extended by these videos; nothing is written."""
    source = Path(load_source(run).path)
    _require_plain_videos(run, source, config)
    done, needed = load_records(run), STAGES[: STAGES.index(FINAL) + 1]
    unfinished = [s for s in needed if s not in done or run.damaged(s)]
    if unfinished:
        raise InputError(f"{run.root}: {unfinished[0]} is not done. Run `msgs-slam resume {quoted(run.root)}` first")
    if run.load(CALIBRATION).directions > 1:
        raise InputError(
            f"{run.root} was made from panoramas, and only a run of ordinary videos can be extended: reconstruct "
            "all the recordings together, in a new run"
        )
    require_listable(videos)
    width, height = _size(video_files(source)[0])
    for video in videos:
        if video.resolve() in [file.resolve() for file in video_files(source)]:
            raise InputError(f"{video} is part of {run.root} already: give another one")
        if _size(video) != (width, height):
            raise InputError(
                f"{video} is {_size(video)[0]}x{_size(video)[1]}, the videos of {run.root} are {width}x{height}: a run "
                "has one camera, held one way. Make it a run of its own, or convert it to that size if the camera is "
                "the same. Nothing was changed"
            )
    require_overlap(run, videos, config.frames, config.run.seed, progress)


def add_videos(run: RunFolder, videos: Sequence[Path], config: Config) -> Source:
    """Make the run one of all its videos and these, with none of its stages done; one write of the manifest decides."""
    files = [file.resolve() for file in video_files(Path(load_source(run).path))]
    earlier = sorted(run.root.glob(f"{EXTENSION}*"))
    numbers = [int(n) for p in earlier if (n := p.name.removeprefix(EXTENSION)).isdigit()]
    folder = run.root / f"{EXTENSION}{max(numbers, default=0) + 1}"
    save_before(run, folder)
    path = folder / SOURCE_LIST
    write_text(path, "".join(f"{file}\n" for file in [*files, *(v.resolve() for v in videos)]))
    source = Source(str(path.resolve()), source_digest(path, config.run.format))
    write_manifest(run.manifest_file, Manifest(source, {}))
    for old in earlier:
        shutil.rmtree(old, ignore_errors=True)
    return source


def _require_plain_videos(run: RunFolder, source: Path, config: Config) -> None:
    is_set = source.is_dir() or isinstance(open_source(source, config.run.format), RecordingSource)
    if not (is_set or config.frames.poses):
        return
    why = "with --poses" if config.frames.poses else f"from {source}, no video"
    raise InputError(
        f"{run.root} was made {why}: only runs of videos without given poses are extended. Reconstruct all of it into "
        f"another folder, with --poses {quoted(run.root / 'export' / 'sparse' / '0')}"
    )


def _size(video: Path) -> tuple[int, int]:
    found = probe_video(video)
    return found.width, found.height
