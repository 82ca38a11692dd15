"""What does not fit into memory is made again, and nobody sees the difference."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from msgs_slam.pipelines.system import memory
from msgs_slam.pipelines.system.lru_sequence import LruSequence
from msgs_slam.pipelines.system.memory import machine_memory, memory_room


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


PEAKS = """
import numpy as np
from msgs_slam.pipelines.engine.stages import forget_peak, peak_memory_mb
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


def test_room_is_half_of_the_machine_or_container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert memory_room(700) == 700e6
    assert 2e8 < memory_room(0) == machine_memory() / 2
    (tmp_path / "memory.max").write_text("max\n")
    monkeypatch.setattr(memory, "_CONTAINER", tmp_path)
    whole = machine_memory()
    (tmp_path / "memory.max").write_text("300000000\n")
    assert machine_memory() == 300e6 < whole
