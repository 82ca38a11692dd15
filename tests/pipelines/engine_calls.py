"""What the engines' tests call: it has to be importable where the calls run."""

import os
import signal
import time
from pathlib import Path


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
    from pipelines.stopping import stop_if_asked

    Path(marker).write_text(str(os.getpid()))
    for _ in range(600):
        stop_if_asked()
        time.sleep(0.05)
