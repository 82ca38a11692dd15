"""A run from somebody else, whose names, links and checksums are made to reach elsewhere: no command follows them."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runs import FinishedRun, files_below, invoke

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import content_digest, read_manifest, write_manifest
from msgs_slam.pipelines.run.progress import PROGRESS, ProgressFile
from msgs_slam.pipelines.system.progress import BEGUN, SilentProgress, StageEvent

SECRET = b"a file of the user, elsewhere"


def sign(run: Path, stage: str, added: tuple[str, ...] = ()) -> None:
    """Make the manifest one that says of every file of the stage that the program has left it so."""
    manifest = read_manifest(run / "manifest.json")
    folder = run / stage
    names = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()] + list(added)
    files = {n: ((folder / n).stat().st_size, file_sha256(folder / n)) for n in names}
    record = replace(manifest.records[stage], files=files, content=content_digest(files))
    write_manifest(run / "manifest.json", replace(manifest, records={**manifest.records, stage: record}))


def rename_frame(name: str) -> Callable[[Path, Path], None]:
    """Another name for the first frame, whose file is where that leads."""

    def spoil(run: Path, outside: Path) -> None:
        table = run / "frames" / "frames.json"
        rows = json.loads(table.read_text())
        rows[0]["name"] = name.format(outside=outside)
        table.write_text(json.dumps(rows))
        file = run / "frames" / rows[0]["name"]
        if not file.exists() and "/" not in name:
            shutil.copy(run / "frames" / "000000.jpg", file)
        sign(run, "frames", (rows[0]["name"],) if file.exists() else ())

    return spoil


def through_a_link(run: Path, outside: Path) -> None:
    """A name that is harmless as text, and not behind the link."""
    (run / "frames" / "link").symlink_to(run / "frames" / "correspondence")
    rename_frame("link/../../../outside/secret.jpg")(run, outside)


def linked(name: str, *hops: str) -> Callable[[Path, Path], None]:
    """Something of the run moved outside, with a link, or several, in its place."""

    def spoil(run: Path, outside: Path) -> None:
        target = outside / "moved"
        if (run / name).is_dir():
            shutil.copytree(run / name, target)
            shutil.rmtree(run / name)
        elif (run / name).exists():
            (run / name).rename(target)
        else:
            target.mkdir()
        for hop in hops:
            (run / hop).symlink_to(target)
            target = run / hop
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).symlink_to(target)

    return spoil


def linked_lock(run: Path, outside: Path) -> None:
    (run / ".lock").unlink(missing_ok=True)
    (run / ".lock").symlink_to(outside / "made.txt")


def named_in_the_manifest(run: Path, outside: Path) -> None:
    sign(run, "export", ("../../outside/secret.jpg",))


def linked_piece(run: Path, outside: Path) -> None:
    shutil.copytree(run / "tracking", outside / "moved" / "tracking")
    (run / "piece_2").symlink_to(outside / "moved")
    (run / "export" / "piece_2").mkdir()
    (run / "export" / "piece_2" / "a.txt").write_text("a")
    sign(run, "export")


COLMAP = ("export", "{run}", "--only", "colmap", "--to", "{out}")
ALL = ("export", "{run}", "--to", "{out}")
OWN = ("export", "{run}", "--only", "colmap")
RENDER = ("render", "{run}", "{out}/film.avi", "--fps", "1")
EXTEND = ("extend", "{run}", "{video}")
EVALUATE = ("evaluate", "{run}", "--truth", "{truth}")
RESUME, REPORT = ("resume", "{run}"), ("report", "{run}")

Spoil = Callable[[Path, Path], None]
ESCAPES: dict[str, tuple[Spoil, tuple[tuple[str, ...], ...]]] = {
    "a frame above": (rename_frame("../../outside/secret.jpg"), (COLMAP, ALL, OWN, EXTEND, RENDER, REPORT, EVALUATE)),
    "a frame by its whole path": (rename_frame("{outside}/secret.jpg"), (COLMAP, ALL)),
    "a frame behind a link": (through_a_link, (COLMAP, ALL, OWN)),
    "a frame with backslashes": (rename_frame("..\\..\\outside\\secret.jpg"), (COLMAP,)),
    "a frame on a drive": (rename_frame("C:secret.jpg"), (COLMAP,)),
    "a frame of two lines": (rename_frame("a\nb.jpg"), (COLMAP,)),
    "a frame that is a link": (linked("frames/000000.jpg"), (COLMAP,)),
    "a chain of links": (linked("frames/000000.jpg", "frames/hop", "frames/hop2"), (COLMAP,)),
    "a linked folder of a stage": (linked("global_ba"), (COLMAP, RENDER, REPORT, EXTEND, RESUME)),
    "a linked folder in a stage": (linked("frames/correspondence"), (EXTEND,)),
    "a linked export": (linked("export"), (RESUME, REPORT)),
    "a linked folder of exports": (linked("exports"), (OWN,)),
    "a linked folder of an export": (linked("exports/colmap/sparse"), (OWN,)),
    "a linked unfinished stage": (linked("export.partial"), (("resume", "{run}", "--redo", "export"),)),
    "a linked evaluation": (linked("evaluation"), (EVALUATE, REPORT)),
    "linked settings": (linked("run.toml"), (COLMAP, RESUME)),
    "a linked manifest": (linked("manifest.json"), (COLMAP, RESUME)),
    "a linked lock": (linked_lock, (RESUME,)),
    "a name in the manifest": (named_in_the_manifest, (RESUME, COLMAP)),
    "a linked piece": (linked_piece, (RESUME,)),
}


@pytest.mark.parametrize("how", ESCAPES)
def test_nothing_outside_of_a_foreign_run_is_touched(
    how: str, finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    run, outside, out = copied_run("run.msgs"), tmp_path / "outside", tmp_path / "out"
    (outside / "folder").mkdir(parents=True)
    for name in ("secret.jpg", "secret.jpg.png", "folder/ready.json", "folder/0000.lock"):
        (outside / name).write_bytes(SECRET)
    spoil, commands = ESCAPES[how]
    spoil(run, outside)
    before, of_run = files_below(outside), files_below(run)
    for words in commands:
        places = {"run": run, "out": out, "video": finished_run.video, "truth": finished_run.truth}
        done = invoke(*(word.format(**places) for word in words))
        assert done.exit_code == 1, (words, done.output)
        assert files_below(outside) == before, words
        assert {k: v for k, v in files_below(run).items() if not k.endswith(".lock")} == {
            k: v for k, v in of_run.items() if not k.endswith(".lock")
        }, words
        assert {p.name for p in tmp_path.iterdir()} <= {"run.msgs", "outside", "out"}, words
        assert not [p for p in out.rglob("*") if p.is_file() and SECRET in p.read_bytes()], words


def test_how_far_it_is_is_not_noted_through_a_link(tmp_path: Path) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_bytes(SECRET)
    run = RunFolder(tmp_path / "run")
    run.root.mkdir()
    (run.root / PROGRESS).with_suffix(".tmp").symlink_to(mine)
    with ProgressFile(SilentProgress(), run) as noted:
        noted.stage(StageEvent("frames", 1, 6, BEGUN))
        assert json.loads((run.root / PROGRESS).read_text())["stage"] == "frames"
    assert mine.read_bytes() == SECRET


def test_every_path_of_a_run_stays_inside(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.root.mkdir()
    (run.root / "link").symlink_to(tmp_path)
    names = (
        "..",
        "../x",
        "/etc/passwd",
        "a/../../x",
        "a\\b",
        "C:x",
        "a\0b",
        "",
        ".",
        "a//b",
        "link",
        "link/x",
        "x" * 256,
    )
    for name in names:
        for join in (run.path, run.stage, run.piece, lambda n: run.path("frames", n), lambda n: run.file("frames", n)):
            if name in ("link", "link/x") and join not in (run.path, run.stage, run.piece):
                continue
            with pytest.raises(InputError):
                join(name)
    assert run.path("frames", "masks", "ü 1.jpg.png") == run.root / "frames" / "masks" / "ü 1.jpg.png"
    assert os.path.islink(run.root / "link")
