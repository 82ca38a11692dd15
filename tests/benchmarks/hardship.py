"""What a run must live through beside kills: full disks, closed folders, clocks that jump, sources that vanish.

    python tests/benchmarks/hardship.py --work DIR [--seed 0] [--only WORD ...]

Needs Linux and root: it mounts a small disk in DIR, and lays root's powers down where rights are in question. Each
trouble comes to each stage of a tiny run, in the middle: at a random one of its renamings. Then the command must have
ended well, or with code 1 and a message; never by a signal of its own, never with a traceback. Where the trouble is
over, `resume` must leave the same bytes as a run that had none. After that the commands that read a run are tried
without room and without rights, and sources that are exchanged while they are read. Prints a row for each, with what
was said; ends with 1 when anything was otherwise.
"""

import argparse
import contextlib
import ctypes
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kills import SETTINGS, digests, in_child, make_clip

NOBODY = 65534
CAPABILITIES_3 = 0x20080522
DISK_BYTES = 96 << 20
TRIALS = {"full": 4, "small files": 3, "closed": 2, "clock": 2, "source gone": 2}
Act = Callable[[], None]


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, negative for a signal, and what it said."""

    code: int
    text: str

    @property
    def is_well(self) -> bool:
        """Whether a user could live with it."""
        told = "Traceback" not in self.text and "Error: " in self.text
        return self.code == 0 or (self.code == 1 and told)

    def __str__(self) -> str:
        said = [line for line in self.text.splitlines() if line.startswith("Error: ")] or self.text.splitlines()[-1:]
        return f"{self.code} {said[0][:150] if self.code and said else ''}"


def command(*arguments: object, before: Act | None = None, powerless: bool = False) -> Ended:
    """msgs-slam in a child, after `before`; powerless: files' rights count for it, though it is root's."""
    incoming, outgoing = os.pipe()  # what is said goes where no limit of files holds

    def act() -> None:
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(outgoing, number)
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 (until the child ends)
        if powerless:
            ctypes.CDLL(None).capset(struct.pack("Ii", CAPABILITIES_3, 0), bytes(24))
        if before is not None:
            before()
        from msgs_slam.msgs_cli.main import main

        try:
            main([str(a) for a in arguments])
        except SystemExit as ended:
            sys.stdout.flush()
            os._exit(int(ended.code or 0))

    child = in_child(act)
    os.close(outgoing)
    with os.fdopen(incoming, errors="replace") as stream:
        said = stream.read()
    return Ended(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), said)


def at_renaming(count: int, act: Act) -> Act:
    """Before: makes this process act at its `count`-th renaming."""

    def before() -> None:
        real, left = os.replace, [count]

        def replace(*args: Any, **kwargs: Any) -> None:
            left[0] -= 1
            if left[0] == 0:
                act()
            real(*args, **kwargs)

        os.replace = replace

    return before


# troubles -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trouble:
    """`before` brings it, in the child; `over` ends it."""

    what: str
    before: Act
    over: Act
    powerless: bool = False


def troubles(run: Path, source: Path, rng: random.Random, only: list[str]) -> Iterator[Trouble]:
    """Those of one stage."""
    ballast, away = run.parent / "ballast", source.with_name("away")

    def full(left: int) -> None:
        with contextlib.suppress(OSError), ballast.open("wb") as file:
            file.write(bytes(max(0, shutil.disk_usage(run.parent).free - left)))

    def rights(mode: int) -> None:
        for path in [run, *run.rglob("*")]:
            path.chmod(mode if path.is_dir() else mode & 0o666)

    def jump() -> None:
        for path in [run, *run.rglob("*")]:
            os.utime(path, (rng.uniform(0, 4e9),) * 2)

    def odd_clock() -> None:
        time.time = lambda: rng.uniform(0, 4e9)  # type: ignore[assignment]

    def die() -> None:
        jump()
        os.kill(os.getpid(), signal.SIGKILL)

    def chosen(name: str) -> range:
        return range(TRIALS[name] if not only or any(word in name for word in only) else 0)

    for _ in chosen("full"):
        count, left = rng.choice((1, rng.randint(1, 12))), rng.choice((0, rng.randint(1, 200_000)))
        yield Trouble(
            f"full at renaming {count}, {left} bytes left", at_renaming(count, lambda b=left: full(b)), ballast.unlink
        )
    for _ in chosen("small files"):
        limit = rng.choice((0, 4_000, 30_000, 100_000, 300_000))
        yield Trouble(
            f"small files, up to {limit} bytes",
            lambda n=limit: resource.setrlimit(resource.RLIMIT_FSIZE, (n, resource.RLIM_INFINITY)),
            lambda: None,
        )
    for _ in chosen("closed"):
        count = rng.randint(1, 10)
        yield Trouble(
            f"closed at renaming {count}",
            at_renaming(count, lambda: rights(0o555)),
            lambda: rights(0o755),
            powerless=True,
        )
    for _ in chosen("clock"):
        count = rng.randint(1, 10)
        killed = at_renaming(count, die)
        yield Trouble(f"clock jumps, killed at renaming {count}", lambda k=killed: (odd_clock(), k())[1], jump)
    for _ in chosen("source gone"):
        count = rng.randint(1, 10)
        yield Trouble(
            f"source gone at renaming {count}",
            at_renaming(count, lambda: source.rename(away)),
            lambda: away.rename(source) if away.exists() else None,
        )


def stage_trial(work: Path, stage: str, begun: Path, run: Path, source: Path, trouble: Trouble) -> tuple[bool, str]:
    """Whether the stage came to the same bytes, and how the command with the trouble ended."""
    shutil.rmtree(run, ignore_errors=True)
    if begun.exists():
        shutil.copytree(begun, run)
    start = ["resume", run] if begun.exists() else ["reconstruct", source, "--out", run, *settings()]
    ended = command(*start, "--until", stage, "-q", before=trouble.before, powerless=trouble.powerless)
    with contextlib.suppress(FileNotFoundError):
        trouble.over()
    killed = ended.code == -signal.SIGKILL and "killed" in trouble.what
    again = start if not (run / "manifest.json").exists() else ["resume", run, *settings()]
    after = command(*again, "--until", stage, "-q")
    same = after.code == 0 and digests_of(run, stage) == digests_of(work / "whole.msgs", stage)
    return same and (killed or ended.is_well), str(ended) + ("" if same else f" -> DIFFERS, {after}")


def settings() -> list[str]:
    """Of the tiny run."""
    return [x for s in SETTINGS for x in ("--set", s)]


def digests_of(run: Path, stage: str) -> dict[str, str]:
    """Of the files of one stage."""
    from msgs_slam.pipelines.run.folder import RunFolder

    return {name: digest for name, digest in digests(RunFolder(run)).items() if name.startswith(f"{stage}/")}


# commands that read a run, sources that change ---------------------------------------------------------------------


def readers(work: Path, run: Path, out: Path, truth: Path) -> dict[str, list[object]]:
    """What writes into `out`; evaluate and a plain report write into the run."""
    return {
        "status": ["status", run],
        "export --to": ["export", run, "--to", out / "files", "-q"],
        "report --to": ["report", run, "--to", out / "report.html", "-q"],
        "render": ["render", run, out / "walk.mp4", "--fps", "2", "-q"],
        "render into a folder": ["render", run, out / "walk", "--fps", "2", "-q"],
        "export": ["export", run, "-q"],
        "report": ["report", run, "-q"],
        "evaluate": ["evaluate", run, "--truth", truth, "-q"],
        "resume": ["resume", run, "--set", "mapping.min_iterations=25", "-q"],
    }


def without_room(work: Path, disk: Path, truth: Path, rng: random.Random) -> Iterator[tuple[str, bool, str]]:
    """Every command while its disk is full, or nearly."""
    run = disk / "run.msgs"
    for left in (0, 40_000):
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(work / "whole.msgs", run)
        before = digests_of(run, "global_ba")
        (disk / "ballast").write_bytes(bytes(shutil.disk_usage(disk).free - left))
        for name, arguments in readers(work, run, disk, truth).items():
            ended = command(*arguments)
            wanted = (0,) if name == "status" else (0, 1) if left else (1,)
            told = ended.code == 0 or "disk full" in ended.text or "frames could be written" in ended.text
            yield f"{name}, {left} bytes left", ended.is_well and told and ended.code in wanted, str(ended)
        (disk / "ballast").unlink()
        ended = command("resume", run, *settings(), "-q")
        yield "resume with room again", ended.code == 0 and digests_of(run, "global_ba") == before, str(ended)


def without_rights(work: Path, disk: Path, truth: Path, rng: random.Random) -> Iterator[tuple[str, bool, str]]:
    """Every command on a run of somebody else's: what only reads works, what writes there says so; nothing changes."""
    run, own = disk / "run.msgs", disk / "own"
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(work / "whole.msgs", run)
    own.mkdir()
    for path in [run, *run.rglob("*")]:
        os.chown(path, NOBODY, NOBODY)
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*")}
    for name, arguments in readers(work, run, own, truth).items():
        ended = command(*arguments, powerless=True)
        inside = name in ("export", "report", "evaluate", "resume")
        untouched = {p: p.stat().st_mtime_ns for p in run.rglob("*")} == before
        yield f"{name} without rights", ended.is_well and ended.code == inside and untouched, str(ended)


def exchanged_sources(work: Path, disk: Path, truth: Path, rng: random.Random) -> Iterator[tuple[str, bool, str]]:
    """Pictures that change while they are read; a source that changes before frames are made again."""
    folder, run, kept = work / "pictures", disk / "run.msgs", work / "kept"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(truth / "rgb", folder)
    options = ["--out", run, *settings(), "--format", "images", "--intrinsics", "110,110,64,48,0.1", "-q"]
    start = ["reconstruct", folder, *options, "--until", "frames"]
    shutil.rmtree(run, ignore_errors=True)
    assert command(*start).code == 0
    expected = digests_of(run, "frames")
    pictures = sorted(folder.iterdir())
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(folder, kept)
    acts: dict[str, Act] = {
        "one gone": lambda: pictures[5].unlink(),
        "one cut": lambda: os.truncate(pictures[5], 900),
        "one exchanged": lambda: pictures[5].write_bytes((kept / pictures[6].name).read_bytes()),
        "all gone": lambda: shutil.rmtree(folder),
        "one more": lambda: pictures[5].with_stem("zz").write_bytes((kept / pictures[5].name).read_bytes()),
    }  # fmt: skip
    for name, act in acts.items():
        for count in (3, 8, 36):
            shutil.rmtree(run, ignore_errors=True)
            ended = command(*start, before=at_renaming(count, act))
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(kept, folder)
            refused = ended.code == 1 or digests_of(run, "frames") == expected
            after = command(*start)
            same = after.code == 0 and digests_of(run, "frames") == expected
            said = str(ended) + ("" if same else f" -> DIFFERS, {after}")
            yield f"pictures: {name} at renaming {count}", refused and ended.is_well and same, said
    yield from _frames_made_again(work, run, folder, pictures[5])


def _frames_made_again(work: Path, run: Path, folder: Path, picture: Path) -> Iterator[tuple[str, bool, str]]:
    """A frame is damaged, or a setting is changed, and the source is not what it was: nothing is given up."""
    before = (run / "manifest.json").read_bytes()
    whole = picture.read_bytes()
    for what, act in {"gone": folder.rename, "changed": lambda _: picture.write_bytes(whole + b"\0")}.items():
        for name, option in {"damaged frame": [], "setting": ["--set", "frames.parallax=0.03"]}.items():
            frame = next((run / "frames").glob("*.png"))
            good = frame.read_bytes()
            if not option:
                frame.write_bytes(good[:-9])
            act(folder.with_name("away"))
            ended = command("resume", run, *option, "--until", "frames", "-q")
            kept = (run / "manifest.json").read_bytes() == before
            if what == "gone":
                folder.with_name("away").rename(folder)
            picture.write_bytes(whole)
            frame.write_bytes(good)
            yield f"source {what}, {name}", ended.code == 1 and ended.is_well and kept, str(ended)


# the whole --------------------------------------------------------------------------------------------------------


def prepare(work: Path) -> None:
    """A clip with its truth, a whole run of it, and copies of it as it was before each stage."""
    from tests.world import ClipOptions, make_world, write_sequence

    make_clip(work / "clip.avi")
    write_sequence(work / "truth", make_world(texel=0.02), ClipOptions(frames=10, width=128, height=96, laps=0.2))


def begin_all(work: Path, source: Path) -> dict[str, Path]:
    """Stage → a run of which everything before that stage is done."""
    from msgs_slam.pipelines.config import STAGES

    whole, begun = work / "whole.msgs", {}
    shutil.rmtree(whole, ignore_errors=True)
    for stage in STAGES:
        begun[stage] = work / f"{stage}.begun"
        shutil.rmtree(begun[stage], ignore_errors=True)
        if whole.exists():
            shutil.copytree(whole, begun[stage])
        ended = command("reconstruct", source, "--out", whole, *settings(), "--until", stage, "-q")
        assert ended.code == 0, ended.text
    return begun


def rows(work: Path, disk: Path, rng: random.Random, only: list[str]) -> Iterator[tuple[str, bool, str]]:
    """What was tried, whether it went as it must, how it ended."""
    source = work / "clip.avi"
    for stage, begun in begin_all(work, source).items():
        run = disk / "own" / "run.msgs"
        run.parent.mkdir(exist_ok=True)
        for trouble in troubles(run, source, rng, only):
            good, said = stage_trial(work, stage, begun, run, source, trouble)
            yield f"{stage}: {trouble.what}", good, said
        shutil.rmtree(run.parent)
    for part in (without_room, without_rights, exchanged_sources):
        if not only or any(word in part.__name__ for word in only):
            yield from part(work, disk, work / "truth", rng)


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], help="troubles with one of these words in their names")
    options = parser.parse_args()
    work = options.work.resolve()
    disk = work / "disk"
    disk.mkdir(parents=True, exist_ok=True)
    os.environ["MSGS_SLAM_CACHE"] = str(work / "no_networks")
    from msgs_slam.pipelines.system.identity import package_digest

    package_digest()  # what every child would read again
    assert os.waitpid(in_child(lambda: prepare(work)), 0)[1] == 0
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(disk)], check=True)
    tried = wrong = 0
    try:
        for what, good, said in rows(work, disk, random.Random(options.seed), options.only):
            tried, wrong = tried + 1, wrong + (not good)
            print(f"{'' if good else 'WRONG '}{what}: {said}", flush=True)
    except BaseException:
        traceback.print_exc()
        wrong += 1
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    print(f"{tried} tried, {wrong} wrong")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
