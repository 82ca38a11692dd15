"""The command `work`: lead or help at a run that several processes work on."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from .config import Config
from .engine.shards import BETWEEN_LOOKS, Shard, SharedWorkers, posted_in, withdraw_all
from .reconstruct import resume
from .run.folder import RunFolder
from .run.lock import RunBusyError
from .run.records import StageRecord
from .system.limits import available_cpus
from .system.progress import Progress, log
from .system.stopping import stop_if_asked


def work_on_run(
    run: RunFolder, shard: Shard, config: Config, prepare: Callable[[str], Progress], until: str
) -> dict[str, StageRecord]:
    """Lead or help until the run is done up to a stage; its records. Raises InputError as `resume` does, and for a node
    that cannot do a task (another version of the program, a full disk): the others go on."""
    workers = SharedWorkers(shard, prepare, config.run.threads or available_cpus())
    log.info("shard %d of %d", shard.index, shard.count)
    while True:
        with suppress(RunBusyError):
            return resume(run, prepare("run"), config, until, workers, lambda: withdraw_all(run))
        if not any(posted.do_one(shard, prepare) for posted in posted_in(run)):
            stop_if_asked()
            time.sleep(BETWEEN_LOOKS)
