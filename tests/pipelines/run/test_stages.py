"""The stage runner on small stages: what is up to date stays, what changed runs, what was interrupted goes on."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from msgs_slam.formats.atomic import write_text
from msgs_slam.formats.errors import DiskFullError, InputError
from msgs_slam.formats.reading import note_read
from msgs_slam.formats.textfile import read_text
from msgs_slam.pipelines.config import STAGES, Config, MappingConfig
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.reads import LOGS
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import Stage, StageContext
from tests.pipelines.run.recorder import Recorder


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


def test_second_run_does_nothing(recorder: Recorder, tmp_path: Path) -> None:
    assert recorder.bring(tmp_path / "r") == list(STAGES)
    assert recorder.bring(tmp_path / "r") == []
    assert not list((tmp_path / "r").rglob("snapshot"))


def test_changed_setting_reruns_its_stage_and_what_follows(recorder: Recorder, tmp_path: Path) -> None:
    recorder.bring(tmp_path / "r")
    key = next(iter(MappingConfig.__dataclass_fields__.values()))
    config = load_config(overrides=[f"mapping.{key.name}={another_value(key.default)}"])
    assert recorder.bring(tmp_path / "r", config) == ["mapping", "global_ba", "export"]


def another_value(value: Any) -> Any:
    if isinstance(value, bool):
        return str(not value).lower()
    return value + 1 if isinstance(value, int | float) else f'"{value}x"'


def contents(root: Path) -> dict[str, bytes]:
    """Of every stage's folder."""
    return {str(p.relative_to(root)): p.read_bytes() for p in root.glob("*/**/*") if p.is_file()}


def test_results_of_later_stages_stay_until_their_own_are_ready(recorder: Recorder, tmp_path: Path) -> None:
    root, other = tmp_path / "r", load_config(overrides=["frames.rate=5"])
    recorder.bring(root)
    before = contents(root)
    assert recorder.bring(root, other, until="frames") == ["frames"]
    run = RunFolder(root)
    assert list(run.records) == ["frames"]
    assert list(run.stale) == list(STAGES[1:])
    later = {k: v for k, v in before.items() if not k.startswith("frames/")}
    assert {k: v for k, v in contents(root).items() if not k.startswith("frames/")} == later
    # What does not belong to these frames is not shown with them.
    with pytest.raises(InputError, match=r"made before the run was changed.*or go back with `.* --set frames.rate="):
        run.file("mapping", "result.txt")

    recorder.fail_in = "proxy"
    with pytest.raises(KeyboardInterrupt):
        recorder.bring(root, other)
    recorder.fail_in = ""
    assert recorder.bring(root, Config()) == ["frames"], "what belongs to the frames of before counts again"
    assert {k: v for k, v in contents(root).items() if not k.startswith("proxy.partial/")} == before
    assert RunFolder(root).stale == {}
    assert recorder.bring(root, other) == list(STAGES)
    assert not {k for k, v in contents(root).items() if before.get(k) == v}
    assert not list(root.glob("*.partial"))


def test_a_stale_result_that_is_damaged_does_not_count_again(recorder: Recorder, tmp_path: Path) -> None:
    recorder.bring(tmp_path / "r")
    recorder.bring(tmp_path / "r", load_config(overrides=["frames.rate=5"]), until="frames")
    (tmp_path / "r" / "mapping" / "result.txt").write_text("damaged")
    assert recorder.bring(tmp_path / "r", Config()) == ["frames", "mapping"]


def test_made_again_on_demand_everything_after_it_is(recorder: Recorder, tmp_path: Path) -> None:
    """Even if it was stopped in between."""
    recorder.bring(tmp_path / "r")
    recorder.fail_in = "mapping"
    with pytest.raises(KeyboardInterrupt):
        recorder.bring(tmp_path / "r", redo="tracking")
    assert recorder.ran == ["tracking", "mapping"]
    recorder.fail_in = ""
    assert recorder.bring(tmp_path / "r") == ["mapping", "global_ba", "export"]


def test_an_unfinished_stage_with_links_in_it_is_begun_anew(recorder: Recorder, tmp_path: Path) -> None:
    """The program makes none: it would write through somebody else's, elsewhere on the disk."""
    recorder.fail_in = "mapping"
    with pytest.raises(KeyboardInterrupt):
        recorder.bring(tmp_path / "r")
    recorder.fail_in = ""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "0.txt").write_text("mine")
    (tmp_path / "r" / "mapping.partial" / "folder").symlink_to(tmp_path / "mine")
    assert recorder.bring(tmp_path / "r") == ["mapping", "global_ba", "export"]
    assert (tmp_path / "mine" / "0.txt").read_text() == "mine"
    assert not (tmp_path / "r" / "mapping" / "folder").is_symlink()


def test_damaged_file_is_made_again(recorder: Recorder, tmp_path: Path) -> None:
    recorder.bring(tmp_path / "r")
    damaged = tmp_path / "r" / "global_ba" / "result.txt"
    damaged.write_text(damaged.read_text()[:-1] + "?")
    run = RunFolder(tmp_path / "r")
    assert run.damaged("global_ba") == ["result.txt"]
    with pytest.raises(InputError, match=r"result.txt is not as the program left it.*msgs-slam resume"):
        run.file("global_ba", "result.txt")
    (tmp_path / "r" / "export" / "result.txt").unlink()
    with pytest.raises(InputError, match=r"result.txt is gone"):
        run.file("export", "result.txt")
    assert recorder.bring(tmp_path / "r") == ["global_ba", "export"]


def test_other_source_or_seed_reruns_all(recorder: Recorder, tmp_path: Path) -> None:
    recorder.bring(tmp_path / "r")
    assert recorder.bring(tmp_path / "r", digest="e") == list(STAGES)
    config = Config()
    assert recorder.bring(tmp_path / "r", replace(config, run=replace(config.run, seed=1)), "e") == list(STAGES)


def test_interrupted_stage_keeps_its_snapshot(recorder: Recorder, tmp_path: Path) -> None:
    recorder.fail_in = "mapping"
    with pytest.raises(KeyboardInterrupt):
        recorder.bring(tmp_path / "r")
    run = RunFolder(tmp_path / "r")
    assert list(run.records) == ["frames", "proxy", "tracking"]
    assert (run.partial("mapping") / "snapshot" / "half.txt").exists()
    (run.partial("mapping") / ".torn.tmp.npz").write_bytes(b"x")
    recorder.fail_in = ""
    assert recorder.bring(tmp_path / "r") == ["mapping", "global_ba", "export"]
    assert not list(run.root.glob("*.partial"))
    assert not list(run.root.rglob(".torn*"))


def test_nothing_is_given_up_for_a_source_that_is_another_one(recorder: Recorder, tmp_path: Path) -> None:
    asked: list[bool] = []

    def same_source() -> None:
        asked.append(True)
        raise InputError("the source has changed")

    run = RunFolder(tmp_path / "r")
    bring = partial(recorder.bring, run.root, same_source=same_source)
    recorder.bring(run.root)
    bring(load_config(overrides=["mapping.hold_out=4"]))
    assert asked == []  # frames are done: the source is not needed
    bring(Config())
    before = run.manifest_file.read_bytes(), run.settings_file.read_bytes()
    with pytest.raises(InputError, match="the source has changed"):
        bring(load_config(overrides=["frames.rate=1"]))
    (run.stage("frames") / "result.txt").write_text("damaged")
    with pytest.raises(InputError, match="the source has changed"):
        bring(Config())
    assert asked == [True, True]
    assert (run.manifest_file.read_bytes(), run.settings_file.read_bytes()) == before


def test_snapshot_of_other_settings_is_dropped(recorder: Recorder, tmp_path: Path) -> None:
    recorder.fail_in = "frames"
    with pytest.raises(KeyboardInterrupt):
        recorder.bring(tmp_path / "r")
    stale = tmp_path / "r" / "frames.partial" / "stale.txt"
    stale.write_text("of the first settings")
    recorder.fail_in = ""
    recorder.bring(tmp_path / "r", load_config(overrides=["frames.rate=1"]))
    assert not (tmp_path / "r" / "frames" / "stale.txt").exists()


def test_full_disk_is_said_and_can_be_resumed(recorder: Recorder, tmp_path: Path) -> None:
    recorder.fail_in, recorder.error = "tracking", OSError(28, "No space left on device")
    with pytest.raises(DiskFullError, match="msgs-slam resume"):
        recorder.bring(tmp_path / "r")
    recorder.fail_in = ""
    assert recorder.bring(tmp_path / "r") == ["tracking", "mapping", "global_ba", "export"]


def test_what_a_stage_could_not_use_is_refused_first_and_other_files_make_it_again(
    recorder: Recorder, tmp_path: Path
) -> None:
    maps = tmp_path / "maps.txt"
    checked: list[str] = []

    def check(source: Path, config: Config) -> None:
        if not maps.exists():
            raise InputError(f"{maps} is not there")
        checked.append(maps.read_text())

    def run(context: StageContext) -> dict[str, Any]:
        read_text(maps)
        return plain.run(context)

    stages = recorder.stages()
    plain = stages[1]
    stages[1] = replace(plain, run=run, check=check)
    bring = partial(recorder.bring, tmp_path / "r", stages=stages)
    with pytest.raises(InputError, match="is not there"):
        bring()
    assert recorder.ran == []
    maps.write_text("one")
    assert bring() == list(STAGES)
    assert bring() == []
    assert checked == ["one"]
    maps.write_text("two")
    assert bring() == ["proxy"]
    assert checked == ["one", "two"]
    # What is finished stays when its inputs are gone, but nothing else can be made of them.
    maps.unlink()
    assert bring() == []
    with pytest.raises(InputError, match="is not there"):
        bring(load_config(overrides=["frames.rate=1"]))
    assert recorder.ran == []


def test_settings_by_themselves_are_refused_before_any_check_and_where_the_stage_has_work(
    recorder: Recorder, tmp_path: Path
) -> None:
    card = tmp_path / "card.toml"
    checked: list[str] = []

    def check_settings(config: Config) -> None:
        if not card.exists():
            raise InputError(f"{card} is not there")

    stages = recorder.stages()
    stages[0] = replace(stages[0], check=lambda source, config: checked.append("frames"))
    stages[1] = replace(stages[1], check_settings=check_settings)
    bring = partial(recorder.bring, tmp_path / "r", stages=stages)
    with pytest.raises(InputError, match="is not there"):
        bring()
    assert (recorder.ran, checked) == ([], [])
    card.touch()
    assert bring() == list(STAGES)
    assert checked == ["frames"]
    card.unlink()
    assert bring() == [], "what is finished stays"


def test_memory_that_divides_a_stage_otherwise_makes_it_again(recorder: Recorder, tmp_path: Path) -> None:
    """And only then: where the parts are the same, the result is."""
    stages = recorder.stages()
    stages[0] = replace(stages[0], division=lambda run, config: config.run.memory_mb // 1000)

    def bring(memory_mb: int) -> list[str]:
        return recorder.bring(tmp_path / "r", load_config(overrides=[f"run.memory_mb={memory_mb}"]), stages=stages)

    assert bring(2100) == list(STAGES)
    assert bring(2900) == []
    assert bring(900) == ["frames"], "what follows is kept where that comes out the same"
    assert bring(900) == []


def test_only_what_a_stage_reads_makes_it_again(recorder: Recorder, tmp_path: Path) -> None:
    """Settings of its own section that it does not ask for are none of it, those of another one that it does ask for
    are; so is a file that was not there."""
    given = tmp_path / "given"

    def run(context: StageContext) -> dict[str, Any]:
        recorder.ran.append("frames")
        value = context.config.frames.rate, context.config.mapping.submap, context.threads
        write_text(context.folder / "result.txt", f"{value} {given.exists() and [p.name for p in given.iterdir()]}")
        note_read(given)
        return {}

    stages = recorder.stages()
    stages[0] = Stage("frames", run)

    def bring(*settings: str) -> bool:
        ran = recorder.bring(tmp_path / "r", load_config(overrides=settings), until="frames", stages=stages)
        return ran == ["frames"]

    assert bring()
    assert not bring("frames.overlap=3", "mapping.passes=2", "run.threads=2", "run.device=cpu")
    assert bring("frames.rate=5")
    assert bring("frames.rate=5", "mapping.submap=9")
    assert not bring("frames.rate=5", "mapping.submap=9", "mapping.max_side=99")
    given.mkdir()
    assert bring("frames.rate=5", "mapping.submap=9")
    (given / "more.txt").touch()
    assert bring("frames.rate=5", "mapping.submap=9")
    (given / "more.txt").write_text("text")
    assert not bring("frames.rate=5", "mapping.submap=9")


def test_a_stage_can_run_stages_with_the_settings_that_it_is_given(recorder: Recorder, tmp_path: Path) -> None:
    """They note what they read, and a setting that one of them has read makes it and the stage around it again."""
    within = Recorder()

    def run(context: StageContext) -> dict[str, Any]:
        recorder.ran.append("export")
        within.bring(tmp_path / "r" / "within", context.config)
        return {}

    stages = [*recorder.stages()[:-1], Stage("export", run)]
    assert recorder.bring(tmp_path / "r", stages=stages) == within.ran == list(STAGES)
    for folder in (tmp_path / "r", tmp_path / "r" / "within"):
        assert RunFolder(folder).records["frames"].reads.settings["frames.rate"] == Config().frames.rate
    assert recorder.bring(tmp_path / "r", stages=stages) == []
    other = load_config(overrides=["mapping.hold_out=4"])
    assert recorder.bring(tmp_path / "r", other, stages=stages) == ["mapping", "global_ba", "export"]
    assert within.ran == ["mapping", "global_ba", "export"]


def test_unfinished_work_goes_on_unless_something_that_it_has_read_has_changed(
    recorder: Recorder, tmp_path: Path
) -> None:
    stages = recorder.stages()

    def run(context: StageContext) -> dict[str, Any]:
        if context.config.frames.rate and (context.snapshot / "first").exists():
            return {}
        write_text(context.snapshot / "first", "")
        read_text(tmp_path / "given.txt")
        raise KeyboardInterrupt

    def goes_on(*settings: str) -> bool:
        try:
            recorder.bring(tmp_path / "r", load_config(overrides=settings), until="frames", stages=stages)
        except KeyboardInterrupt:
            return False
        return True

    stages[0] = Stage("frames", run)
    (tmp_path / "given.txt").write_text("one")
    assert not goes_on()
    (tmp_path / "given.txt").write_text("two")
    assert not goes_on()
    assert not goes_on("frames.rate=5")
    log = next((tmp_path / "r" / "frames.partial" / LOGS).iterdir())
    log.write_text(log.read_text() + '["settings", "frames.ra')  # killed in the middle
    assert goes_on("frames.rate=5", "frames.overlap=3")
    reads = RunFolder(tmp_path / "r").records["frames"].reads
    assert list(reads.files) == [str(tmp_path / "given.txt")], "read before the interruption"
