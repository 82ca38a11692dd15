"""A finished run gets another video: what is refused, what is kept, what is added, and killed meanwhile."""

import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import OPTIONS, QUICK, elsewhere, files_below, invoke
from test_kill_and_resume import digests, finish, kill_when, start, written

from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.geometry.se3 import align_points, inverse
from msgs_slam.pipelines.run.files import MAP, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.manifest import read_manifest, write_manifest
from msgs_slam.pipelines.source.extending import add_videos, is_added
from tests.world import iter_clip, make_world

CLIP = replace(OPTIONS, frames=14, laps=0.24)
FIRST, SECOND, THIRD = slice(0, 8), slice(6, 14), slice(10, 14)
SETTINGS = [x for s in (*QUICK, "mapping.max_gaussians=30000") for x in ("--set", s)]


@dataclass(frozen=True)
class Videos:
    """The first part of a walk with its finished run, two more parts, and the true camera centres (N, 3) of the first
    two."""

    first: Path
    second: Path
    third: Path
    run: Path
    centers: np.ndarray


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Videos:
    root = tmp_path_factory.mktemp("extended")
    frames = list(iter_clip(make_world(texel=0.02), CLIP))
    first, second, third = (
        write_video(root / name, [f.rgb for f in frames[part]], CLIP.fps)
        for name, part in (("first.avi", FIRST), ("second.avi", SECOND), ("third.avi", THIRD))
    )
    done = invoke("reconstruct", first, "--out", root / "first.msgs", *SETTINGS, "-q")
    assert done.exit_code == 0, done.output
    centers = np.array([f.world_from_cam[:3, 3] for part in (FIRST, SECOND) for f in frames[part]])
    return Videos(first, second, third, root / "first.msgs", centers)


@pytest.fixture(scope="module")
def extended(videos: Videos, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That run extended by the second part."""
    run = shutil.copytree(videos.run, tmp_path_factory.mktemp("whole") / "run.msgs")
    done = invoke("extend", run, videos.second)
    assert done.exit_code == 0, done.output
    return run


@pytest.fixture
def copied(videos: Videos, tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: shutil.copytree(videos.run, tmp_path / name)


def centers_of(run: Path) -> np.ndarray:
    trajectory = RunFolder(run).load(TRAJECTORY, "global_ba")
    assert trajectory.is_posed.all()
    return inverse(trajectory.cam_from_world)[:, :3, 3]


def test_the_path_goes_on_in_the_world_that_was_there(videos: Videos, extended: Path) -> None:
    before, old_map = centers_of(videos.run), RunFolder(videos.run).load(MAP, "global_ba")
    run, after = extended, centers_of(extended)
    assert len(after) == len(videos.centers)
    # Where the old frames were, to a fiftieth of what the path spans (160 x 120 pixels); not to the last bit, as all
    # were adjusted together.
    span = np.ptp(before, axis=0).max()
    moved = np.linalg.norm(after[: len(before)] - before, axis=1).max()
    assert 0 < moved < 0.04 * span
    fit = align_points(after, videos.centers)
    error = np.sqrt(((fit.apply(after) - videos.centers) ** 2).sum(1).mean())
    assert 0 < error < 0.03
    new_map = RunFolder(run).load(MAP, "global_ba")
    assert len(new_map) > 1.1 * len(old_map)
    assert max(new_map.anchor_frame_ids.tolist()) >= len(before), "added keyframes have seeded Gaussians"
    assert RunFolder(run).manifest().records["mapping"].figures["keyframe_psnr"] > 15

    status = invoke("status", run)
    assert "out of date" not in status.output
    stay = digests(run)
    assert invoke("extend", run, videos.second, "-q").exit_code == 0, "the same video is added once"
    assert invoke("resume", run, "-q").exit_code == 0
    assert digests(run) == stay


def test_an_extended_run_is_extended_again_elsewhere(videos: Videos, extended: Path, tmp_path: Path) -> None:
    run = RunFolder(shutil.copytree(extended, tmp_path / "elsewhere.msgs"))
    before, old_map = run.load(TRAJECTORY, "global_ba"), run.load(MAP, "global_ba")
    done = invoke("extend", run.root, videos.third)
    assert done.exit_code == 0, done.output
    assert [p.name for p in run.root.glob("extension_*")] == ["extension_2"]
    assert "out of date" not in invoke("status", run.root).output
    known, after = inverse(before.cam_from_world)[:, :3, 3], centers_of(run.root)
    assert len(after) == len(known) + len(range(*THIRD.indices(CLIP.frames)))
    span = np.ptp(known, axis=0).max()
    assert 0 < np.linalg.norm(after[: len(known)] - known, axis=1).max() < 0.04 * span
    # The third video shows frames of the second again: they are where they were.
    again = known[FIRST.stop + THIRD.start - SECOND.start :]
    assert np.linalg.norm(after[len(known) :] - again, axis=1).max() < 0.04 * span
    assert len(run.load(MAP, "global_ba")) > 0.9 * len(old_map)


@pytest.mark.parametrize("made", [False, True], ids=["before", "after"])
def test_stopped_at_any_write_it_is_the_old_run_or_the_extended_one(
    made: bool, videos: Videos, copied: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before or after each file of the change takes its name: one of the two, with its settings."""
    config, rename, seen = RunFolder(videos.run).settings(), os.replace, []
    for stop in itertools.count():
        run, count = RunFolder(copied(f"{stop}.msgs")), itertools.count()

        def replace_or_stop(source: Path, target: Path, stop: int = stop, count: Iterator[int] = count) -> None:
            is_last = next(count) == stop
            if made or not is_last:
                rename(source, target)
            if is_last:
                raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", replace_or_stop)
            try:
                add_videos(run, [videos.second], config)
                break
            except KeyboardInterrupt:
                pass
        assert run.settings() == config
        records, path = run.records, Path(run.source.path)
        assert path in (videos.first.resolve(), run.root / "extension_1" / "source.videos")
        is_old = path == videos.first.resolve()
        assert list(records) == (list(STAGES) if is_old else [])
        assert is_added(run, [videos.second]) != is_old
        assert not is_old or not any(run.damaged(stage) for stage in STAGES)
        seen.append(is_old)
    assert seen == sorted(seen, reverse=True), "once extended it stays so"
    assert len(seen) > 2
    assert is_added(run, [videos.second])
    assert run.settings() == config, "its first line is of the run before, until the first stage begins"


def test_while_another_process_works_on_it_nothing_is_begun(videos: Videos, copied: Callable[[str], Path]) -> None:
    run = RunFolder(copied("busy.msgs"))
    with locked(run):
        refused = invoke("extend", run.root, videos.second)
    assert refused.exit_code == 1
    assert "another msgs-slam process is working on this run" in refused.output.replace("\n", " ")
    assert list(run.records) == list(STAGES)


def test_killed_it_goes_on_and_ends_with_the_same_bytes(
    videos: Videos, extended: Path, copied: Callable[[str], Path], tmp_path: Path
) -> None:
    broken = copied("broken.msgs")
    places = elsewhere(tmp_path)
    killed = kill_when(start(places, "extend", broken, videos.second, "-q"), written(broken / "frames.partial", 3))
    assert killed
    killed = kill_when(start(places, "resume", broken, "-q"), written(broken / "mapping.partial", 1))
    assert killed
    finish(start(places, "extend", broken, videos.second, "-q"))
    assert digests(broken) == digests(extended)


def files_but_lock(run: RunFolder) -> dict[str, int]:
    """Of every file but the lock, which names the last process."""
    return {path: changed for path, changed in files_below(run.root).items() if Path(path).name != ".lock"}


REFUSED = {
    "another size": "a run has one camera, held one way. Make it a run of its own",
    "itself": "give another one",
    "no video": "is a text file, not a video",
    "without a map": "mapping is not done. Run `msgs-slam resume",
    "damaged": "mapping is not done. Run `msgs-slam resume",
    "images": "Reconstruct all of it into another folder, with --poses",
    "the paper's": "was made with --method paper",
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused_and_nothing_is_changed(
    what: str, videos: Videos, copied: Callable[[str], Path], tmp_path: Path
) -> None:
    run, other = RunFolder(copied("run.msgs")), tmp_path / "other.avi"
    manifest = read_manifest(run.manifest_file)
    if what == "another size":
        write_video(other, [np.tile(np.arange(128, dtype=np.uint8)[:, None], (96, 1, 3))] * 5, CLIP.fps)
    elif what == "no video":
        other.write_text("no video")
    else:
        other = videos.first if what == "itself" else videos.second
    if what == "images":
        (tmp_path / "images").mkdir()
        source = replace(manifest.source, path=str(tmp_path / "images"))
        write_manifest(run.manifest_file, replace(manifest, source=source))
    elif what == "without a map":
        begun = {name: manifest.records[name] for name in ("frames", "proxy", "tracking")}
        write_manifest(run.manifest_file, replace(manifest, records=begun))
    elif what == "the paper's":
        run.settings_file.write_text(run.settings_file.read_text().replace('method = "default"', 'method = "paper"'))
    elif what == "damaged":
        (run.root / "mapping" / next(iter(manifest.records["mapping"].files))).unlink()
    before = files_but_lock(run)
    refused = invoke("extend", run.root, other)
    assert refused.exit_code == 1
    assert REFUSED[what] in " ".join(refused.output.split())
    assert files_but_lock(run) == before
