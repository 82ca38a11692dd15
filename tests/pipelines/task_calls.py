"""Tasks of tests, importable in the processes that do them."""

import os
import signal
import time
from pathlib import Path

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.run.stages import Chunk
from msgs_slam.pipelines.system.progress import Progress, stop_if_asked


def halve(value: int, progress: Progress) -> int:
    """Refuses odd numbers."""
    if value % 2:
        raise InputError(f"{value} is odd")
    return value // 2


def fail(value: int, progress: Progress) -> None:
    raise ValueError(f"no {value}")


def known_in_chunk(chunk: Chunk, progress: Progress) -> int:
    """What is known of all things, for each of the chunk's."""
    return chunk.known["number"] * len(chunk.numbers)


def die(task: tuple[Path, int], progress: Progress) -> int:
    """Lose the process so many times; returns how often it was begun."""
    marker, times = task
    seen = len(list(marker.iterdir()))
    (marker / str(seen)).touch()
    if seen < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return seen + 1


def wait(marker: Path, progress: Progress) -> None:
    """Until stopped; the process says its number."""
    marker.with_suffix(".tmp").write_text(str(os.getpid()))
    marker.with_suffix(".tmp").rename(marker)
    for _ in range(600):
        stop_if_asked()
        time.sleep(0.05)
