"""The demo around a reconstruction: the clip, its truth, what is compared."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.evaluation.write import TRUTH, VIDEO, demo_summary, run_demo, unpack_demo_clip
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.world import make_world, render_frame
from tests.world.demo_clip import OPTIONS, pack_clip

OracleRun = Callable[..., RunFolder]


@pytest.fixture
def clip(world_sequence: Path, tmp_path: Path) -> Path:
    """The walk of `world_sequence`, packed as the demo's own clip is."""
    pictures = (read_rgb(p) for p in list_images(world_sequence / "rgb"))
    folder = tmp_path / "clip"
    video = write_video(folder / "made" / VIDEO, pictures, 10.0)
    return pack_clip(folder, video, world_sequence)


def test_demo_reconstructs_the_video_alone_and_then_opens_the_truth(
    oracle_run: OracleRun, clip: Path, tmp_path: Path
) -> None:
    seen: list[Path] = []

    def reconstruct(video: Path, run: RunFolder) -> None:
        seen.append(video)
        shutil.copytree(oracle_run(video=True, metric=False, rename=True).root, run.root)

    result = run_demo(tmp_path, reconstruct, SilentProgress(), clip)
    assert seen == [tmp_path / VIDEO]
    assert sum(1 for _ in VideoReader(tmp_path / VIDEO)) == 32
    assert result.figures["trajectory"]["sim3 all"]["rmse"] < 1e-6
    assert "32 of 32 frames posed" in demo_summary(result)[0]
    assert (result.run.root / "evaluation" / "views.png").exists()
    stamp = (tmp_path / VIDEO).stat().st_mtime_ns
    assert unpack_demo_clip(tmp_path, clip)[0].stat().st_mtime_ns == stamp


def test_demo_does_not_write_over_another_video(tmp_path: Path) -> None:
    (tmp_path / VIDEO).write_bytes(b"mine")
    with pytest.raises(InputError, match="not the demo's"):
        unpack_demo_clip(tmp_path)
    assert (tmp_path / VIDEO).read_bytes() == b"mine"
    assert not (tmp_path / TRUTH).exists()


def test_the_demo_comes_with_what_the_made_up_world_shows(tmp_path: Path) -> None:
    _, truth = unpack_demo_clip(tmp_path)
    sequence, world = open_sequence(truth), make_world(texel=0.02)  # coarser textures on the same surfaces
    assert len(sequence) == OPTIONS.frames
    for index in (0, 20):
        frame = render_frame(world, OPTIONS, index)
        np.testing.assert_allclose(sequence.world_from_cam[index], frame.world_from_cam, atol=1e-8)
        np.testing.assert_allclose(sequence.depth(index), frame.depth, atol=6e-4)
        told, shown = np.array(sequence.class_names), np.array(world.class_names)
        np.testing.assert_array_equal(told[sequence.labels(index)], shown[frame.labels])
        assert sequence.timestamps[index] == pytest.approx(frame.timestamp)
        here, later = (psnr(sequence.rgb(i), frame.rgb) for i in (index, index + 3))
        assert later + 2 < here < 60
