"""The identity of a stage is what it has read: another byte of any such file is another identity, and of no other file.

What Python opens is listened to from outside of the program (`sys.addaudithook`), so that a reader which is not noted
is found here. Of the package's own files `tests/pipelines/system/test_identity.py` holds the same.
"""

import os
import re
import shutil
import sys
from collections import defaultdict
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import QUICK, FinishedRun, invoke

from msgs_slam.formats.images import write_grey_png
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.run import files as run_files
from msgs_slam.pipelines.run import runner
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.reads import Situation, StageRecord
from msgs_slam.pipelines.run.schema import RunFile
from msgs_slam.pipelines.source.recording import open_recording
from tests.networks import PICTURE, save_network

LABELS = (
    'task="segmentation"\nmodel="net.onnx"\ninput="x"\noutput="y"\nkind="logits"\nclasses=["wall","floor","table"]\n'
)
MACHINE = {"run.threads", "run.device", "run.memory_mb"}
UNREAD = {"run.kappa", "run.quality", *MACHINE}  # of the paper's method; asked for before a stage runs; of the machine
READ_BY = {"proxy.moving": {"proxy"}, "mapping.hold_out": {"mapping"}, "frames.rate": {"frames", "global_ba"}}
_running: list[str] = []
_opened: dict[str, set[Path]] = defaultdict(set)


def _listen(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _running and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened[_running[-1]].add(Path(os.fsdecode(arguments[0])).absolute())


@dataclass(frozen=True)
class World:
    """A run, the folder of all that was given to it, and what each of its stages was seen to open."""

    run: RunFolder
    given: Path
    opened: dict[str, set[Path]]

    @property
    def records(self) -> dict[str, StageRecord]:
        return self.run.records

    def changed(self, config: Config | None = None, records: dict[str, StageRecord] | None = None) -> set[str]:
        """Stages that would be others with these settings, results of other stages, and the files as they are."""
        known, source = self.records, open_recording(self.given / "room.avi").digest
        now = config or self.run.settings(), records or known
        return {
            stage.name
            for stage in all_stages()
            if known[stage.name].reads.difference(Situation(stage.program, source, *now))
        }


@pytest.fixture(scope="module")
def world(finished_run: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> World:
    given = tmp_path_factory.mktemp("given")
    shutil.copy(finished_run.video, given / "room.avi")
    shutil.copy(finished_run.folder / "export" / "trajectory.txt", given / "poses.txt")
    (given / "camera.txt").write_text("150 150 80 60")
    (given / "track.csv").write_text(
        "time,lat,lon,alt\n" + "".join(f"{i / 10},{47 + i * 1e-6},8,400\n" for i in range(14))
    )
    shutil.copytree(finished_run.truth / "depth", given / "depth")
    (given / "depth" / "notes.txt").write_text("not read")
    kept = np.full((120, 160), 255, np.uint8)
    kept[:20] = 0
    write_grey_png(given / "masks" / "000003.png", kept)
    (given / "net").mkdir()
    save_network(given / "net" / "net.onnx", PICTURE, "float[1, 3, H, W] y", "y = Mul (x, gain)", gain=[2.0])
    (given / "net" / "card.toml").write_text(LABELS)
    settings = [x for s in (*QUICK, "frames.parallax=0.16") for x in ("--set", s)]
    options = ("--poses", given / "poses.txt", "--intrinsics", given / "camera.txt", "--masks", given / "masks")
    proxies = ("--depth", f"files:{given / 'depth'}", "--semantics", f"onnx:{given / 'net' / 'card.toml'}")
    run_one = runner._run_one

    def heard(stage: Any, *arguments: Any) -> StageRecord:
        _running.append(stage.name)
        try:
            return run_one(stage, *arguments)
        finally:
            _running.pop()

    _opened.clear()
    sys.addaudithook(_listen)  # stays, and hears nothing outside of a stage
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_run_one", heard)
        made = invoke(
            "reconstruct", given / "room.avi", "--out", given.parent / "read.msgs", *options, *proxies,
            "--gps", given / "track.csv", *settings, "-q",
        )  # fmt: skip
    assert made.exit_code == 0, made.output
    return World(RunFolder(given.parent / "read.msgs"), given, {stage: set(files) for stage, files in _opened.items()})


def another_value(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int | float) else f"{value}x"


def flip(path: Path) -> bytes:
    """Change the last byte of a file; what it held."""
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    return data


def test_any_byte_of_what_was_given_changes_the_stages_that_have_opened_it_and_no_other(world: World) -> None:
    assert world.changed() == set()
    expected = {
        "room.avi": set(STAGES), "poses.txt": {"frames"}, "camera.txt": {"frames", "global_ba"},
        "masks/000003.png": {"frames"},
        "net/net.onnx": {"proxy"}, "net/card.toml": {"proxy"}, "track.csv": {"export"}, "depth/notes.txt": set(),
        **{f"depth/{n:06d}.png": {"proxy"} for n in range(14)},
    }  # fmt: skip
    files = sorted(p for p in world.given.rglob("*") if p.is_file())
    assert {p.relative_to(world.given).as_posix() for p in files} == set(expected)
    for path in files:
        name, before = path.relative_to(world.given).as_posix(), flip(path)
        try:
            assert world.changed() == expected[name], name
        finally:
            path.write_bytes(before)
        seen = {stage for stage in STAGES if path in world.opened[stage]}
        assert seen <= expected[name], "what was heard is noted"
    assert world.changed() == set()


def test_any_byte_of_an_earlier_stage_changes_the_stages_that_have_opened_it_and_no_other(world: World) -> None:
    records, unread = world.records, 0
    for stage, record in records.items():
        for name, (size, _) in record.files.items():
            other = replace(record, files={**record.files, name: (size, "another")})
            path = world.run.root / stage / name
            seen = {later for later in STAGES if later != stage and path in world.opened[later]}
            assert world.changed(records={**records, stage: other}) == seen, path
            unread += not seen
    assert unread > 10
    assert world.run.source.digest == open_recording(world.given / "room.avi").digest


def test_a_file_that_was_looked_for_counts_as_read(world: World) -> None:
    expected = {
        ("frames", "masks/000005.jpg.png"): {"proxy", "mapping", "export"},  # a mask of another frame was given
        ("proxy", "masks/000005.jpg.png"): {"mapping", "export"},  # nothing has moved
        ("tracking", "piece_2/sparse.npz"): {"export"},
    }
    for (stage, name), readers in expected.items():
        record = world.records[stage]
        assert name not in record.files
        found = replace(record, files={**record.files, name: (1, "new")})
        assert world.changed(records={**world.records, stage: found}) == readers, (stage, name)


def test_settings_that_were_not_asked_for_change_nothing(world: World) -> None:
    config, counts = world.run.settings(), dict.fromkeys(STAGES, 0)
    for section in fields(Config):
        values = getattr(config, section.name)
        for key in fields(values):
            value = getattr(values, key.name)
            other = another_value(value)
            changed = world.changed(replace(config, **{section.name: replace(values, **{key.name: other})}))
            name = f"{section.name}.{key.name}"
            assert not (changed and name in MACHINE)
            assert changed == {s for s, r in world.records.items() if name in r.reads.settings}, name
            for stage in changed:
                counts[stage] += 1
    assert min(counts.values()) > 1
    read_in = {name: {s for s, r in world.records.items() if name in r.reads.settings} for name in {*UNREAD, *READ_BY}}
    assert read_in == {**{name: set() for name in UNREAD}, **READ_BY}


def table_of_files(*runs: dict[str, StageRecord]) -> str:
    """The rows of `run/files.py` as `docs/files.md` shows them: which stage leaves a file, and which ones read it."""
    kinds = [*(kind for kind in vars(run_files).values() if isinstance(kind, RunFile)), *run_files.FIGURES.values()]
    lines = ["| file (N: a frame) | left by → read by |", "| --- | --- |"]
    for kind in {kind.name: kind for kind in kinds}.values():
        pattern = re.compile("(.*/)?" + re.escape(kind.name).replace(r"\{:06d\}", r"\d+").replace(r"\{\}", ".+"))
        ways = []
        for stage in kind.stages:
            names = {
                s: [n for records in runs for n in records[s].reads.results.get(stage, ("", []))[1]] for s in STAGES
            }
            readers = [later for later in STAGES if any(map(pattern.fullmatch, names[later]))]
            ways.append(f"{stage} → {', '.join(readers)}" if readers else stage)
        lines.append(f"| `{kind.name.replace('{:06d}', 'N').replace('{}', 'N')}` | {'; '.join(ways)} |")
    return "\n".join(lines)


def test_the_page_of_files_shows_who_leaves_and_who_reads_each(world: World, finished_run: FinishedRun) -> None:
    runs = RunFolder(finished_run.folder).records, world.records
    assert table_of_files(*runs) in (Path(__file__).parents[2] / "docs" / "files.md").read_text()
