"""Small stages for tests of what runs them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from msgs_slam.formats.atomic import write_text
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.runner import run_stages
from msgs_slam.pipelines.run.stages import SameSource, Stage, StageContext, trust_source
from msgs_slam.pipelines.system.progress import SilentProgress


class Recorder:
    """Six stages that note when they run; each writes files made from its own settings and its predecessor's file.
    `fail_in` names one that raises `error` instead; with its last line mapping calls `at_end`."""

    def __init__(self, at_end: Callable[[], None] = lambda: None) -> None:
        self.ran: list[str] = []
        self.fail_in, self.at_end = "", at_end
        self.error: BaseException = KeyboardInterrupt()

    def stages(self) -> list[Stage]:
        return [Stage(name, self._make(name)) for name in STAGES]

    def bring(
        self, root: Path, config: Config | None = None, digest: str = "d", until: str = STAGES[-1],
        stages: Sequence[Stage] = (), same_source: SameSource = trust_source, redo: str = "",
    ) -> list[str]:  # fmt: skip
        """Bring a run up to date; which stages ran."""
        self.ran.clear()
        root.mkdir(exist_ok=True)
        work = StageContext(RunFolder(root), Path("video.mp4"), config or Config(), root, SilentProgress())
        work = replace(work, stages=list(stages or self.stages()), same_source=same_source)
        run_stages(work, digest, until, redo=redo)
        return list(self.ran)

    def _make(self, name: str) -> Callable[[StageContext], dict[str, Any]]:
        def run(context: StageContext) -> dict[str, Any]:
            self.ran.append(name)
            own = f"{getattr(context.config, name, '')} {context.config.run.seed}"
            before = STAGES[STAGES.index(name) - 1] if name != STAGES[0] else None
            text = context.run.file(before, "result.txt").read_text() if before else "source"
            write_text(context.snapshot / "half.txt", "half")
            if name == self.fail_in:
                raise self.error
            for file in ("result.txt", "folder/0.txt"):
                write_text(context.folder / file, f"{text} > {name} {own}")
            if name == "mapping":
                self.at_end()
            return {"length": len(text), "number": float("inf")}

        return run
