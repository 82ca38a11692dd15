"""What the tests of placements run: `python -m placed_calls FUNCTION ARGUMENT...`."""

import os
import signal
import sys
import time
from pathlib import Path


def fail(value: str) -> None:
    raise ValueError(f"no {value}")


def die(marker: str, times: str) -> None:
    """Lose the process so many times."""
    seen = len(list(Path(marker).iterdir()))
    (Path(marker) / str(seen)).touch()
    if seen < int(times):
        os.kill(os.getpid(), signal.SIGKILL)


def wait(marker: str) -> None:
    """Until stopped, or until the process that started this one is gone."""
    from msgs_slam.pipelines.engine.placement import stop_with_parent
    from msgs_slam.pipelines.system.progress import soft_stop, stop_if_asked

    stop_with_parent()
    with soft_stop(lambda number: None):
        Path(marker).write_text(str(os.getpid()))
        for _ in range(600):
            stop_if_asked()
            time.sleep(0.05)


if __name__ == "__main__":
    {"fail": fail, "die": die, "wait": wait}[sys.argv[1]](*sys.argv[2:])
