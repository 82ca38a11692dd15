"""Fixtures: the synthetic room, and a run over it."""

from collections.abc import Callable
from pathlib import Path

import pytest
from proxy_room import Room, perfect_backbone, write_source

from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, save_frames
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Frame
from tests.pipelines.kept import keep_correspondences
from tests.world import ClipOptions, make_world, render_frame


@pytest.fixture(scope="session")
def room() -> Room:
    world = make_world(texel=0.01)
    options = ClipOptions(frames=110, width=256, height=192, laps=1.0, noise=1.0)
    views = [render_frame(world, options, i) for i in range(20, 31)]
    frames = [Frame(i, f"{i:06d}.png", i / 10, i, 1.0) for i in range(len(views))]
    calibration = Calibration(options.intrinsics, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    return Room(views, frames, calibration, perfect_backbone(views, options.intrinsics))


@pytest.fixture
def make_context(room: Room, tmp_path: Path) -> Callable[..., StageContext]:
    """A stage's surroundings over a finished frames stage; the source has depth and labels beside its pictures."""

    def make(*settings: str, name: str = "run", backbone: bool = True, room: Room = room) -> StageContext:
        source = write_source(room, tmp_path / f"source of {name}")
        run = RunFolder(tmp_path / name)
        folder = run.stage("frames")
        save_frames(folder, room.frames)
        CALIBRATION.save(folder, room.calibration)
        if backbone:
            BACKBONE.save(folder, room.backbone)
            keep_correspondences(folder, {i: room.views[i].rgb for i in room.backbone.frame_ids.tolist()})
        for frame in room.frames:
            write_rgb(folder / frame.name, room.views[frame.id].rgb)
        run.stage("proxy").mkdir(exist_ok=True)
        config = load_config(None, ["run.threads=2", *settings])
        return StageContext(run, source, config, run.stage("proxy"), SilentProgress())

    return make
