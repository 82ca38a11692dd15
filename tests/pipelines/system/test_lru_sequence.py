"""What does not fit into memory is made again, and nobody sees the difference."""

import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system import machine as limits
from msgs_slam.pipelines.system import threads
from msgs_slam.pipelines.system.machine import available_cpus, machine_memory, memory_room
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.threads import get_threads


def test_what_was_used_last_stays_and_the_rest_is_made_again() -> None:
    made: list[int] = []

    def make(i: int) -> bytes:
        made.append(i)
        return bytes([i]) * 10

    values = LruSequence(5, make, len, room=30)
    assert [v[0] for v in values] == [0, 1, 2, 3, 4]
    assert [values[i][0] for i in (4, 2, 3)] == [4, 2, 3]
    assert made == [0, 1, 2, 3, 4]
    assert values[0][0] == 0
    assert values[2][0] == values[3][0] - 1 == 2
    assert made == [0, 1, 2, 3, 4, 0]
    assert values[4][0] == 4  # the oldest of the three when 0 came
    assert made == [0, 1, 2, 3, 4, 0, 4]
    assert values[-1] == values[4] == bytes([4]) * 10
    assert values[1:3] == [bytes([1]) * 10, bytes([2]) * 10]
    with pytest.raises(IndexError):
        values[5]
    values.forget()
    assert values[1] == bytes([1]) * 10
    assert made[7:] == [1, 2, 1]


def test_one_value_is_kept_however_little_room_there_is() -> None:
    made: list[int] = []
    values = LruSequence(2, lambda i: made.append(i) or "x", len, room=0)
    assert (values[0], values[0], values[1], values[0]) == ("x",) * 4
    assert made == [0, 1, 0]


def test_a_change_takes_over_what_is_kept() -> None:
    made: list[int] = []
    values = LruSequence(4, lambda i: made.append(i) or f"{i}", len, room=2)
    list(values)
    changed = values.changed(lambda i, v: v + "!" * i)
    assert [changed[i] for i in (3, 2)] == ["3!!!", "2!!"]
    assert made == [0, 1, 2, 3]
    assert list(changed) == ["0", "1!", "2!!", "3!!!"]


def test_what_is_at_hand_is_taken_and_threads_get_what_they_ask_for() -> None:
    made: list[int] = []
    values = LruSequence(40, lambda i: made.append(i) or str(i), len, room=6)
    for i in range(40):
        values.keep(i, str(i))
    assert (values[39], values[38]) == ("39", "38")
    assert made == []
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(values.__getitem__, [i % 40 for i in range(400)])) == [str(i % 40) for i in range(400)]


def test_two_values_are_made_at_once_and_each_of_them_once() -> None:
    made: list[int] = []
    both = threading.Barrier(2, timeout=30)

    def make(i: int) -> str:
        made.append(i)
        both.wait()
        return str(i)

    values = LruSequence(2, make, len, room=9)
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(values.__getitem__, [0, 1] * 4)) == ["0", "1"] * 4
    assert sorted(made) == [0, 1]


def test_a_value_that_is_kept_again_counts_once() -> None:
    made: list[int] = []
    values = LruSequence(3, lambda i: made.append(i) or "0123456789", len, room=30)
    for _ in range(3):
        values.keep(0, "0123456789")
    assert [len(v) for v in (*values, *values)] == [10] * 6
    assert made == [1, 2]


PEAKS = """
import numpy as np
from msgs_slam.pipelines.run.runner import forget_peak, peak_memory_mb
peaks = [peak_memory_mb()]
block = np.ones(40_000_000)
peaks.append(peak_memory_mb())
del block
forget_peak()
print(*peaks, peak_memory_mb())
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux forgets a peak")
def test_the_peak_of_memory_is_that_of_a_stage() -> None:
    # A process of its own: in one that has used much before, the block lies in memory that is held already.
    done = subprocess.run(
        [sys.executable, "-c", PEAKS], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
    )
    before, with_block, after = map(float, done.stdout.split())
    assert with_block > before + 200
    assert after < with_block - 200


@pytest.fixture
def cgroups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Sets the cgroups of this process: the lines of /proc/self/cgroup, and files below /sys/fs/cgroup."""
    monkeypatch.setattr(limits, "_CGROUPS", tmp_path / "sys")
    monkeypatch.setattr(limits, "_OWN_CGROUPS", tmp_path / "own")

    def place(own: str, **files: str) -> None:
        shutil.rmtree(tmp_path / "sys", ignore_errors=True)
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            (tmp_path / "sys" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "sys" / name).write_text(text)

    return place


def test_room_is_half_of_the_machine_or_container(cgroups: Callable[..., None]) -> None:
    assert memory_room(700) == 700e6
    cgroups("0::/\n", **{"memory.max": "max\n"})
    whole = machine_memory()
    assert 2e8 < memory_room(0) == whole / 2
    job = "/system.slice/slurmstepd.scope/job_7/step_0"
    for own, name in (
        ("0::/\n", "memory.max"),
        (f"0::{job}\n", "system.slice/slurmstepd.scope/job_7/memory.max"),  # the limit is the job's, not the step's
        ("0::/kubepods/pod3/of-the-host\n", "memory.max"),  # seen from inside the container
        ("4:cpu,cpuacct:/\n9:memory:/slurm/job_7/step_0\n", "memory/slurm/job_7/memory.limit_in_bytes"),
        ("9:memory:/docker/of-the-host\n", "memory/memory.limit_in_bytes"),
        ("", "memory.max"),
    ):
        cgroups(own, **{name: "300000000\n"})
        assert machine_memory() == 300e6 < whole, own
    cgroups("0::/a\n", **{"a/memory.max": "max\n", "b/memory.max": "300000000\n"})
    assert machine_memory() == whole


def test_cpus_are_those_of_the_process(cgroups: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """By its affinity (SLURM, docker --cpuset-cpus) and by quotas (docker --cpus, Kubernetes)."""
    monkeypatch.setattr("os.cpu_count", lambda: 128)
    monkeypatch.setitem(threads._state, "threads", 0)  # another test of this process may have set it
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    run = RunFolder(Path("run.msgs"))
    for own, files, wanted in (
        ("", {}, 8),
        ("0::/pod/c\n", {"pod/c/cpu.max": "max 100000\n"}, 8),
        ("0::/pod/c\n", {"pod/c/cpu.max": "max 100000\n", "pod/cpu.max": "150000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "20000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "1600000 100000\n"}, 8),
        ("3:cpu,cpuacct:/d\n", {"cpu/d/cpu.cfs_quota_us": "300000\n", "cpu/d/cpu.cfs_period_us": "100000\n"}, 3),
        ("3:cpu,cpuacct:/d\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
    ):
        cgroups(own, **files)
        assert available_cpus() == get_threads() == wanted, own
        assert StageContext(run, Path(), Config(), Path(), SilentProgress()).threads == wanted
