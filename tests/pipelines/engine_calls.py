"""What the engines' tests call: it has to be importable where the calls run."""

import os
import resource
import signal
import time
from pathlib import Path

from msgs_slam.formats.atomic import write_bytes
from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.engine.chunks import Chunk
from msgs_slam.pipelines.system.progress import SilentProgress


def double(value: int) -> int:
    return 2 * value


def fail(value: int) -> int:
    raise ValueError(f"no {value}")


def die(marker: str, times: int) -> str:
    """Lose the process so many times, then answer with how often that was."""
    seen = len(list(Path(marker).iterdir()))
    if seen < times:
        (Path(marker) / str(seen)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return f"after {seen}"


def wait(marker: str) -> None:
    """Until stopped."""
    from msgs_slam.pipelines.system.stopping import stop_if_asked

    Path(marker).write_text(str(os.getpid()))
    for _ in range(600):
        stop_if_asked()
        time.sleep(0.05)


def silent(name: str) -> SilentProgress:
    """As a process elsewhere begins a task."""
    return SilentProgress()


def halve(value: int, progress: SilentProgress) -> int:
    """A task that refuses odd numbers."""
    if value % 2:
        raise InputError(f"{value} is odd")
    return value // 2


def fill_disk(path: Path, progress: SilentProgress) -> None:
    """In a process that may write files of a kilobyte only."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
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
