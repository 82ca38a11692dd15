"""The table of a run's files: it names all of them, and writes what it reads."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.run import files
from msgs_slam.pipelines.run.folder import RunFolder, load_records
from msgs_slam.pipelines.run.schema import RunFile

ROWS: list[RunFile] = [*files.FIGURES.values(), *(row for row in vars(files).values() if isinstance(row, RunFile))]
FOR_OTHERS = re.compile(r"\d+\.jpg|timestamps\.txt")


def names(run: RunFolder) -> Iterator[tuple[str, str]]:
    for stage, record in load_records(run).items():
        if stage != STAGES[-1]:
            yield from ((stage, name) for name in record.files if not FOR_OTHERS.fullmatch(name))


def test_each_file_has_a_row_that_writes_what_it_reads(copied_run: Callable[[str], Path], tmp_path: Path) -> None:
    run, seen = RunFolder(copied_run("run.msgs")), set()
    for stage, name in names(run):
        match, row = next(
            (m, row) for row in ROWS if stage in row.stages
            if (m := re.fullmatch(row.name.replace("{:06d}", r"(\d{6})").replace("{}", "(.+)"), name))
        )  # fmt: skip
        of = "".join(match.groups())
        of = int(of) if of.isdigit() else of
        written = row.save(tmp_path / stage, run.load(row, stage, of), of)
        assert written == tmp_path / stage / name
        assert written.read_bytes() == (run.stage(stage) / name).read_bytes(), name
        seen.add(row.name)
    assert len(seen) > 15
