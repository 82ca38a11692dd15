"""Commands write to the run folder, the cache and the folder asked for alone; the table of files names all of them."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from cli_runs import FinishedRun, elsewhere, files_below, invoke

from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.run import files
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Source, read_manifest, write_manifest
from msgs_slam.pipelines.run.schema import RunFile
from msgs_slam.pipelines.run.target import LIST

ALL_OF_THEM = """
import json, sys
from click.testing import CliRunner
from msgs_slam.msgs_cli.main import main
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, (arguments, done.output, done.exception)
"""


def test_nothing_is_written_elsewhere(
    finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    run, asked = copied_run("run.msgs"), tmp_path / "asked"
    environment = elsewhere(tmp_path)
    source = files_below(finished_run.truth, finished_run.video.parent)
    commands: list[list[object]] = [
        ["resume", run, "--set", "export.planes=off", "-q"],
        ["status", run],
        ["export", run, "--to", asked / "export", "-q"],
        ["render", run, asked / "walk.mp4", "--fps", "2", "-q"],
        ["report", run, "--to", asked / "report.html", "-q"],
        ["evaluate", run, "--truth", finished_run.truth, "-q"],
        ["config"],
        ["models", "list"],
    ]
    arguments = json.dumps([[str(word) for word in command] for command in commands])
    done = subprocess.run(
        [sys.executable, "-c", ALL_OF_THEM, arguments],
        cwd=tmp_path / "here", env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert files_below(*(tmp_path / name for name in ("home", "temporary", "here"))) == {}
    assert files_below(finished_run.truth, finished_run.video.parent) == source
    assert {p.name for p in asked.iterdir()} == {"export", "walk.mp4", "report.html", LIST}
    assert {p.name for p in tmp_path.iterdir()} == {"run.msgs", "asked", "home", "temporary", "here"}
    assert {p.name for p in run.iterdir() if p.name not in {q.name for q in finished_run.folder.iterdir()}} == {
        "evaluation"
    }


def test_what_the_user_has_is_not_overwritten(
    finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    """Photographs beside which a data set is wanted, the video in the place of the film, files of one's own."""
    run, photos, site = copied_run("run.msgs"), tmp_path / "scene" / "images", tmp_path / "site"
    for mine in (photos / "000000.jpg", site / "README.txt", site / "tiles" / "tile.png"):
        mine.parent.mkdir(parents=True, exist_ok=True)
        mine.write_text("mine")
    before = files_below(tmp_path / "scene", site, finished_run.video.parent)
    refused = invoke("render", run, finished_run.video)
    assert (refused.exit_code, "is the source of" in refused.stderr) == (1, True)
    manifest = read_manifest(run / "manifest.json")
    write_manifest(run / "manifest.json", replace(manifest, source=Source(str(photos), manifest.source.digest)))
    for words in (("render", run, photos), ("export", run, "--only", "nerfstudio", "--to", photos.parent)):
        refused = invoke(*words)
        assert (refused.exit_code, "is the source of" in refused.stderr) == (1, True)
    for kind, name in (("html", "README.txt"), ("tiles", "README.txt, tiles")):
        refused = invoke("export", run, "--only", kind, "--to", site)
        assert (refused.exit_code, f"holds {name}, which msgs-slam has not written" in refused.stderr) == (1, True)
    (site / "film.mp4").write_text("mine")
    for words in (("render", run, site / "film.mp4"), ("report", run, "--to", site / "film.mp4")):
        refused = invoke(*words)
        assert (refused.exit_code, "add --overwrite" in refused.stderr) == (1, True)
    (site / "film.mp4").unlink()
    assert files_below(tmp_path / "scene", site, finished_run.video.parent) == before

    (site / "README.txt").unlink()
    assert invoke("export", run, "--only", "html", "--to", site).exit_code == 0
    assert invoke("export", run, "--only", "tiles", "--to", site, "--overwrite").exit_code == 0
    assert (site / "tiles" / "tile.png").read_text() == "mine"
    assert (site / "tiles" / "tileset.json").is_file()


ROWS: list[RunFile] = [*files.FIGURES.values(), *(row for row in vars(files).values() if isinstance(row, RunFile))]
FOR_OTHERS = re.compile(r"\d+\.jpg|timestamps\.txt")


def names(run: RunFolder) -> Iterator[tuple[str, str]]:
    for stage, record in run.records.items():
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
