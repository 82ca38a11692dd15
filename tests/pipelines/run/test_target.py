"""What the program writes into a folder of a user replaces only what it has written there itself."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from msgs_slam.formats.atomic import process_token, write_text
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import file_sha256
from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.run.ending import move_in, results, seal, unseal
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.reads import Reads, StageRecord
from msgs_slam.pipelines.run.target import LIST, Target, read_list


def fill(target: Target, *names: str, text: str = "ours", belongs: Callable[[str], bool] | None = None) -> None:
    tops = {name.partition("/")[0] for name in names}
    with target.replacing(belongs or tops.__contains__) as staged:
        for name in names:
            write_text(staged.path(name), text)


def below(folder: Path) -> dict[str, str]:
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != LIST]
    return {p.relative_to(folder).as_posix(): p.read_text() for p in files}


def stamps(folder: Path) -> dict[str, tuple[int, str]]:
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != LIST]
    return {p.relative_to(folder).as_posix(): (p.stat().st_size, file_sha256(p)) for p in files}


def test_what_it_wrote_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    fill(Target(folder), "images/1.png", "images/2.png", "mesh.ply")
    (folder / "notes.txt").write_text("mine")
    fill(Target(folder), "images/1.png", text="again")
    assert below(folder) == {"images/1.png": "again", "mesh.ply": "ours", "notes.txt": "mine"}
    fill(Target(folder), "mesh.ply/a", belongs={"mesh.ply", "images"}.__contains__)
    assert below(folder) == {"mesh.ply/a": "ours", "notes.txt": "mine"}, "a folder left empty is gone"
    assert {p.name for p in folder.iterdir()} == {"mesh.ply", "notes.txt", LIST}


def test_files_of_others_are_in_the_way_until_they_may_be_overwritten(tmp_path: Path) -> None:
    fill(Target(tmp_path), "film.mp4", "images/1.png")
    (tmp_path / "film.mp4").write_text("edited by the user")
    (tmp_path / "images" / "3.png").write_text("mine")
    before = below(tmp_path)
    for name in ("film.mp4", "images/1.png"):
        with pytest.raises(InputError, match=f"holds {name.split('/')[0]}, .*--overwrite"):
            fill(Target(tmp_path), name)
    assert below(tmp_path) == before
    fill(Target(tmp_path, overwrite=True), "film.mp4", "images/2.png", text="new")
    assert below(tmp_path) == {"film.mp4": "new", "images/2.png": "new", "images/3.png": "mine"}


def test_what_appears_while_it_is_made_is_kept(tmp_path: Path) -> None:
    def make() -> None:
        with Target(tmp_path).replacing("film.mp4".__eq__) as staged:
            write_text(staged.path("film.mp4"), "ours")
            (tmp_path / "film.mp4").write_text("of another program")

    with pytest.raises(InputError, match="--overwrite"):
        make()
    assert below(tmp_path) == {"film.mp4": "of another program"}


def test_what_was_not_announced_is_kept_too(tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_text("mine")
    with pytest.raises(InputError, match=r"holds boxes\.csv"):
        fill(Target(tmp_path), "boxes.csv", belongs="README.txt".__eq__)
    assert below(tmp_path) == {"boxes.csv": "mine"}


def test_two_at_once_do_not_meet_and_one_that_fails_leaves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with Target(folder).replacing("a".__eq__) as first, Target(folder).replacing("b".__eq__) as second:
        write_text(first.path("a"), "1")
        write_text(second.path("b"), "2")
    assert below(folder) == {"a": "1", "b": "2"}
    assert set(read_list(folder)) == {"a", "b"}
    with pytest.raises(ZeroDivisionError), Target(tmp_path / "new").replacing("a".__eq__) as staged:
        write_text(staged.path("a"), str(1 / 0))
    assert not (tmp_path / "new").exists()


def test_what_killed_processes_left_is_removed(tmp_path: Path) -> None:
    machine = process_token().partition("-")[0]
    left = [tmp_path / f".msgs-slam-{machine}-{2**22 + 1}-x", tmp_path / f".msgs-slam-{machine}-{os.getppid()}-x"]
    for folder in left:
        folder.mkdir()
    fill(Target(tmp_path), "a")
    assert [folder.exists() for folder in left] == [False, True]


def test_files_of_another_map_do_not_stay_beside_those_of_this_one(tmp_path: Path) -> None:
    fill(Target(tmp_path, origin="one"), "mesh.ply", "world.json")
    with pytest.raises(InputError, match=r"holds mesh\.ply, made from another map"):
        fill(Target(tmp_path, origin="two"), "images/1.png", "world.json")
    assert set(below(tmp_path)) == {"mesh.ply", "world.json"}
    fill(Target(tmp_path, origin="one"), "images/1.png", "world.json")
    fill(Target(tmp_path, overwrite=True, origin="two"), "floorplan.svg", "world.json", text="two")
    assert below(tmp_path) == {"floorplan.svg": "two", "world.json": "two"}


def test_a_list_reaches_nothing_outside_and_no_linked_folder(tmp_path: Path) -> None:
    folder, away = tmp_path / "out", tmp_path / "away"
    write_text(away / "1.png", "mine")
    size, digest = stamps(away)["1.png"]
    folder.mkdir()
    (folder / "images").symlink_to(away)
    names = ("../away/1.png", str(away / "1.png"), "images/1.png", "a/../../away/1.png")
    write_json(folder / LIST, {"files": {name: [size, digest, ""] for name in names}})
    with pytest.raises(InputError, match="is a link to a folder"):
        fill(Target(folder, overwrite=True), "images/2.png")
    fill(Target(folder, overwrite=True, origin="x"), "b", belongs=lambda name: name != "images")
    assert below(away) == {"1.png": "mine"}
    for damaged in ("[]", '{"files": 3}', '{"files": {"a": 1}}', "{"):
        (folder / LIST).write_text(damaged)
        assert read_list(folder) == {}


@pytest.mark.parametrize("is_recorded", [True, False])
def test_the_export_is_replaced_and_files_of_others_in_it_are_moved_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_recorded: bool
) -> None:
    """The record of a stage that is made again as asked for is gone by then."""
    run = RunFolder(tmp_path / "video.msgs")
    own, on_request = run.stage("export"), run.path("exports", "floorplan")

    def end_stage(*names: str) -> None:
        for name in names:
            write_text(run.partial("export") / name, " ".join(names))
        record = StageRecord(Reads(), results(run.partial("export")), 1.0, 1.0, {}, [], "")
        seal(run.partial("export"), record)
        move_in(run, "export")
        if is_recorded:
            write_manifest(run.manifest_file, Manifest(Source("video.mp4", ""), {"export": record}))
        unseal(run, "export")

    end_stage("mesh.ply", "images/1.jpg", "images/2.jpg", "masks/1.png")
    fill(Target(on_request), "floorplan.svg")
    before = below(on_request)
    write_text(own / "thesis" / "chapter.txt", "mine")
    end_stage("mesh.ply", "images/1.jpg")
    again = "mesh.ply images/1.jpg"
    assert below(own) == {"mesh.ply": again, "images/1.jpg": again}
    assert below(on_request) == before
    assert below(run.path("exports", "kept_1"))["thesis/chapter.txt"] == "mine"
    assert "are not of the run: they are in" in caplog.text
    write_text(own / "thesis" / "chapter.txt", "mine too")
    end_stage("mesh.ply", "images/1.jpg")
    kept = [below(run.path("exports", f"kept_{n}"))["thesis/chapter.txt"] for n in (1, 2)]
    assert kept == ["mine", "mine too"]
