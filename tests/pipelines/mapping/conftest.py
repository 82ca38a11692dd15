"""The synthetic room as a run folder and as views."""

from pathlib import Path

import pytest

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.mapping.views import MappingInput, load_views
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from tests.pipelines.mapping.small_run import make_run


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory, world_sequence: Path) -> RunFolder:
    """16 keyframes of 80 x 60."""
    return make_run(tmp_path_factory.mktemp("mapping") / "run", world_sequence)


@pytest.fixture(scope="session")
def room(small_run: RunFolder) -> MappingInput:
    """Its views, with every eighth frame held out."""
    return load_views(small_run, small_run.load(TRAJECTORY, "tracking"), MappingConfig(hold_out=8))
