"""Watching a run that is not finished: what the viewer shows of it, what is still to come, and when there is more."""

import threading
from collections.abc import Callable
from contextlib import suppress

from ...formats.errors import InputError
from ..config import STAGES
from ..run.folder import RunFolder, load_records
from ..run.progress import load_run_progress
from ..system.progress import log
from ..system.wording import quoted
from .scene import ViewerScene, load_scenes

_BETWEEN_LOOKS = 2.0
"""Seconds."""
_SHOWING = {
    "frames": "cameras and points after frames", "tracking": "cameras and points after tracking",
    "mapping": "the map after mapping", "global_ba": "the map after global_ba",
}  # fmt: skip


def progress_summary(run: RunFolder) -> str:
    """Say in a line what is shown of a run and what is still to come; "" for a finished one."""
    records = load_records(run)
    left = [name for name in STAGES if name not in records]
    if not left:
        return ""
    shown = next((text for name, text in reversed(_SHOWING.items()) if name in records), "nothing yet")
    running = load_run_progress(run)
    if running is None:
        what = f"{', '.join(left)}. No job is running: `msgs-slam resume {quoted(run.place.name)}` goes on"
    else:
        what = ", ".join(f"{name} ({running.text})" if name == running.stage else name for name in left)
    return f"Shown: {shown} ({len(STAGES) - len(left)} of {len(STAGES)} stages done). Still to come: {what}."


class RunWatcher:
    """Looks at a run every other second until it is finished: `tell` gets its progress, `show` its scenes when a stage
    has ended that changes them."""

    def __init__(self, run: RunFolder, tell: Callable[[str], None], show: Callable[[list[ViewerScene]], None]) -> None:
        self._run, self._tell, self._show = run, tell, show
        self._seen = self._shown_stages()
        self._stop = threading.Event()
        self._tell(progress_summary(run))
        if len(load_records(run)) < len(STAGES):
            threading.Thread(target=self._watch, daemon=True).start()

    def stop(self) -> None:
        """End the watch after the look that is on."""
        self._stop.set()

    def _watch(self) -> None:
        while not self._stop.wait(_BETWEEN_LOOKS):
            try:
                self._look()
                if len(load_records(self._run)) == len(STAGES):
                    return
            except InputError as error:  # a stage that is made again just now: the next look finds it whole
                self._tell(str(error))
            except Exception as error:  # nobody waits for this thread: it says what went wrong, and looks again
                log.exception("%s cannot be shown as it is now", self._run.root)
                with suppress(Exception):
                    self._tell(f"Not shown as it is now, {type(error).__name__}: {error}. Looking again")

    def _look(self) -> None:
        stages = self._shown_stages()
        if stages != self._seen:
            self._show(load_scenes(self._run.root))
            self._seen = stages
        self._tell(progress_summary(self._run))

    def _shown_stages(self) -> dict[str, str]:
        """Stage → digest of its files, of all whose results are shown."""
        return {name: record.content for name, record in load_records(self._run).items() if name != "proxy"}
