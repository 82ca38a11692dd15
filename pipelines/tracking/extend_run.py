"""A finished run becomes one of more videos: what it was is kept in it, and what follows starts from that."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ...formats.reading import require_listable
from ...formats.video import VideoFrame, probe_video
from ..config import EXTENSION, SOURCE_LIST, STAGES, Config, FramesConfig
from ..frames.learned import open_learned, picture_features
from ..run.extension import FINAL, save_parent
from ..run.files import CALIBRATION, SPARSE
from ..run.folder import RunFolder, load_records, load_source
from ..run.manifest import Manifest, Source, write_manifest
from ..sfm.adjust import FEATURE_SD
from ..sfm.lens import Lens, calibrated_camera, make_lens, to_pycolmap
from ..source.given import read_intrinsics
from ..source.recording import DatasetRecording, VideoRecording, open_recording
from ..source.sharpness import reduce_image
from ..source.videos import require_different, video_files
from ..system.progress import Progress
from ..system.wording import quoted
from ..types import Features
from .pictures import Pictures, load_shutter
from .pnp import MIN_INLIERS, relocalise, solve_pose
from .state import Sightings, TrackState

_SAMPLES, _ENOUGH, _MIN_RECOGNISED = 24, 4, 2
"""Pictures of a video that are looked at; recognised ones that are enough to stop at, and that are needed."""
_FOCALS = np.geomspace(0.5, 2.0, 25)
_SAME_FOCAL, _BETTER = 0.08, 1.25
"""Relative difference that is no other camera; how many times as many agreeing points make it one. Seen on one clip of
a rendered room, which is told from itself enlarged by 1.3."""


def is_added(run: RunFolder, videos: Sequence[Path]) -> bool:
    """Return whether the run's last extension, finished or not, was by exactly these videos."""
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
    if config.run.method == "paper":
        raise InputError(
            f"{run.root} was made with --method paper, which poses frames in their order and grows no finished map: "
            "reconstruct all the videos together, in a new run"
        )
    require_different(videos)
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
    folder = run.path(f"{EXTENSION}{max(numbers, default=0) + 1}")
    save_parent(run, folder)
    path = folder / SOURCE_LIST
    write_text(path, "".join(f"{file}\n" for file in [*files, *(v.resolve() for v in videos)]))
    source = Source(str(path.resolve()), open_recording(path, config.run.format).digest)
    write_manifest(run.manifest_file, Manifest(source, {}))
    for old in earlier:
        shutil.rmtree(old, ignore_errors=True)
    return source


def _require_plain_videos(run: RunFolder, source: Path, config: Config) -> None:
    is_set = source.is_dir() or isinstance(open_recording(source, config.run.format), DatasetRecording)
    if not (is_set or config.frames.poses):
        return
    why = "with --poses" if config.frames.poses else f"from {source}, no video"
    raise InputError(
        f"{run.root} was made {why}: only runs of videos without given poses are extended. Reconstruct all of it into "
        f"another folder, with --poses {quoted(run.path('export', 'sparse', '0'))}"
    )


def _size(video: Path) -> tuple[int, int]:
    found = probe_video(video)
    return found.width, found.height


def require_overlap(
    run: RunFolder, videos: Sequence[Path], settings: FramesConfig, seed: int, progress: Progress
) -> None:
    """Raise InputError for the first video in which fewer than two pictures are recognised, or whose pictures are
    recognised much better by another focal length than that of the run."""
    state = TrackState.from_backbone(run.load(SPARSE, "global_ba"), FEATURE_SD, shutter=load_shutter(run))
    pictures = _WithAdded(run, settings)
    lens = _lens_of(run, settings)
    for video in videos:
        recognised, seen = 0, []
        for features in progress.track(_features_of(video, settings, lens), f"looking at {video.name}", _SAMPLES):
            number = pictures.add(features)
            found, solved = relocalise(number, state, pictures, seed)
            seen.append(found)
            recognised += solved is not None and int(solved.inliers.sum()) >= MIN_INLIERS
            if recognised == _ENOUGH:
                break
        _require_same_focal(run, video, seen, state, seed)
        if recognised < _MIN_RECOGNISED:
            raise InputError(
                f"{video}: of {len(seen)} of its images {recognised} show what {run.root} has seen, so nothing tells "
                "where it belongs. Film it from a place that the run has seen on, or make it a run of its own: "
                f"`msgs-slam reconstruct {quoted(video)}`. Nothing was changed"
            )


class _WithAdded(Pictures):
    """The run's pictures, and behind them those that are looked for in it."""

    def __init__(self, run: RunFolder, settings: FramesConfig) -> None:
        super().__init__(run, settings)
        self._added: dict[int, Features] = {}

    def add(self, features: Features) -> int:
        """The number by which these features are asked for from now on."""
        number = len(self.frames) + len(self._added)
        self._added[number] = features
        return number

    def features(self, frame_id: int) -> Features:
        """Return the features of a frame, including added ones."""
        return self._added[frame_id] if frame_id in self._added else super().features(frame_id)


def _lens_of(run: RunFolder, settings: FramesConfig) -> Lens:
    known = run.load(CALIBRATION)
    if not settings.intrinsics:
        return make_lens(calibrated_camera(known))
    size = known.intrinsics.width, known.intrinsics.height
    return make_lens(to_pycolmap(read_intrinsics(settings.intrinsics, *size).resized(*size)))


def _features_of(video: Path, settings: FramesConfig, lens: Lens) -> Iterator[Features]:
    """Of pictures spread over the video, in the run's undistorted pixels."""
    learned = open_learned(settings)
    for picture in _samples(video):
        rgb = lens.undistort_image(reduce_image(picture.rgb, settings.max_side))
        yield picture_features(rgb, None, settings, learned)


def _samples(video: Path) -> Iterator[VideoFrame]:
    source = VideoRecording(video)
    count = max(source.expected_frames, _SAMPLES)
    return source.read(set(np.linspace(0, count - 1, _SAMPLES).round().astype(int).tolist()))


def _require_same_focal(run: RunFolder, video: Path, seen: Sequence[Sightings], state: TrackState, seed: int) -> None:
    """Look at the pictures of most matches through lenses of other focal lengths."""
    best = sorted((s for s in seen if len(s) >= MIN_INLIERS), key=len)[-_ENOUGH:]
    if not best:
        return
    camera = run.load(CALIBRATION).intrinsics

    def agreeing(factor: float) -> int:
        lens = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        solved = [solve_pose(s.xy, state.points[s.point], lens, seed) for s in best]
        return sum(int(found.inliers.sum()) for found in solved if found is not None)

    counts: NDArray[np.int64] = np.array([agreeing(f) for f in _FOCALS])
    factor, most = float(_FOCALS[counts.argmax()]), int(counts.max())
    if abs(factor - 1) > _SAME_FOCAL and most >= MIN_INLIERS and most > _BETTER * agreeing(1.0):
        raise InputError(
            f"{video}: it was taken by another camera, or zoomed: its focal length is about {factor * camera.fx:.0f} "
            f"px, that of {run.root} {camera.fx:.0f} px. Make it a run of its own: "
            f"`msgs-slam reconstruct {quoted(video)}`. Nothing was changed"
        )
