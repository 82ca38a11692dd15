"""What the tests of tasks call: it has to be importable where the calls run."""

import time
from pathlib import Path

from msgs_slam.formats.atomic import write_bytes
from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.engine.tasks import Chunk
from msgs_slam.pipelines.system.progress import SilentProgress


def silent(name: str) -> SilentProgress:
    """As a process elsewhere begins a task."""
    return SilentProgress()


def halve(value: int, progress: SilentProgress) -> int:
    """A task that refuses odd numbers."""
    if value % 2:
        raise InputError(f"{value} is odd")
    return value // 2


def fill_disk(path: Path, progress: SilentProgress) -> None:
    write_bytes(path, bytes(100_000))


def halve_slowly(value: int, progress: SilentProgress) -> int:
    time.sleep(0.5)
    return halve(value, progress)


def halve_noted(task: tuple[Path, int], progress: SilentProgress) -> int:
    """One mark a time that it is done, beside the result."""
    path, value = task
    with path.open("a") as stream:
        stream.write("x")
    return halve(value, progress)


def read_missing(path: Path, progress: SilentProgress) -> str:
    """A bug: nobody has written the file that it reads."""
    with path.with_name("attempts").open("a") as attempts:
        attempts.write("x")
    return path.read_text()


def known_in_chunk(chunk: Chunk, progress: SilentProgress) -> int:
    """What is known of all things, for each of the chunk's."""
    return chunk.known["number"] * len(chunk.numbers)
