"""Shared fixtures."""

import gc
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, settings

# `tests.world` and its like are importable without the checkout on the path: its sources would be found before the
# installed program that is tested.
tests = sys.modules.setdefault("tests", ModuleType("tests"))
tests.__path__ = [str(Path(__file__).resolve().parent)]

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

# How fast examples come says something of the machine, nothing of the code.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it does not exist."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real recordings in {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def _no_networks_of_the_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What `auto` chooses must not depend on what this machine's user has pulled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MSGS_SLAM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module", autouse=True)
def _objects_of_earlier_files_are_not_traced_again() -> None:
    """Every stage collects garbage once, which takes seconds where hundreds of tests have left their objects."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _logging_as_at_first() -> Iterator[None]:
    """A command run in this process sets the level for all that comes after it."""
    yield
    logging.getLogger().setLevel(logging.WARNING)


@pytest.fixture(scope="session")
def world_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short walk in the synthetic room with exact truth: 32 frames of 240x180, half a lap, 10 frames a second.

    rgb/, depth/, labels/, traj.txt, intrinsics.json, classes.json, timestamps.txt.
    """
    from tests.world import ClipOptions, make_world, write_sequence

    options = ClipOptions(frames=32, width=240, height=180, laps=0.5)
    return write_sequence(tmp_path_factory.mktemp("world"), make_world(texel=0.01), options)
