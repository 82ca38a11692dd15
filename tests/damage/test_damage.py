"""Damaged files reach every reader: it refuses with InputError, or what it lets in makes sense; it never hangs.

A few cases of each here; `tests/benchmarks/fuzz.py` runs thousands with limits of time and memory, any seed.
"""

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType

import pytest
from damage_doors import DOORS, Door
from damage_mutate import damage

from msgs_slam.formats.errors import InputError

CASES = 16
SECONDS = 20


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """A hang fails the test, where the system has alarms."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"no answer within {seconds} s")

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Door → folder of its good files; made once."""
    root, folders = tmp_path_factory.mktemp("good"), {}
    for number, (name, door) in enumerate(DOORS.items()):
        folders[name] = root / str(number)
        folders[name].mkdir()
        door.make(folders[name])
    return folders


@pytest.mark.parametrize("name", DOORS)
def test_damage_is_refused_or_harmless(name: str, good: dict[str, Path], tmp_path: Path) -> None:
    door = DOORS[name]
    door.read(good[name] / door.entry)  # else everything would be refused for another reason
    outcomes = {"accepted": 0, "refused": 0}
    for number in range(round(CASES * door.weight)):
        outcomes[one_case(name, door, good[name], tmp_path / "case", number)] += 1
    assert sum(outcomes.values()) == round(CASES * door.weight)


def one_case(name: str, door: Door, good: Path, case: Path, number: int) -> str:
    shutil.copytree(good, case, symlinks=True)
    how = damage(case, door.damaged or door.entry, door.mutate, Random(f"suite {name} {number}"))
    try:
        with within(SECONDS):
            door.read(case / door.entry)
        return "accepted"
    except InputError:
        return "refused"
    except BaseException as error:
        error.add_note(f"case {number} of {name}: {how}")
        raise
    finally:
        shutil.rmtree(case)
