"""Thousands of damaged files to every reader, each in a process of its own with limits of time and memory.

    python tests/benchmarks/fuzz.py [--seed TEXT] [--cases 200] [--only WORD ...] [--keep FOLDER]

Prints a row for each reader; ends with 1 when a case ended in anything but acceptance that makes sense or InputError.
`--keep` holds the files of failed cases, one folder for each kind of failure. The readers, good files and judges are
those of `tests/damage`; Linux only (fork, limits).
"""

import argparse
import collections
import contextlib
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from random import Random

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
sys.path[:0] = [str(p) for p in (ROOT, TESTS / "damage", TESTS / "pipelines", TESTS / "pipelines" / "proxy")]

from damage_doors import DOORS, Door, Nonsense  # noqa: E402
from damage_mutate import damage  # noqa: E402

from msgs_slam.formats.errors import InputError  # noqa: E402

SECONDS, RESIDENT_MB, EXTRA_BYTES = 20, 2000, 4 << 30
FINE = ("accepted", "refused")


def main() -> int:
    """Run the campaign; the exit code says whether everything held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", default="1")
    parser.add_argument("--cases", type=int, default=200, help="of a reader; some get twice as many")
    parser.add_argument("--only", nargs="*", default=[], help="readers with one of these words in their names")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    header = ("reader", "cases", "accepted", "refused", "failed", "longest", "largest")
    print("| " + " | ".join(header) + " |")
    print("| " + " | ".join(["---"] * len(header)) + " |")
    failed, cases = 0, 0
    for name, door in DOORS.items():
        if options.only and not any(word in name for word in options.only):
            continue
        count = round(options.cases * door.weight)
        found, seconds, megabytes = campaign(name, door, count, options.seed, options.keep)
        bad = sum(n for kind, n in found.items() if kind not in FINE)
        failed, cases = failed + bad, cases + count
        row = (name, count, found["accepted"], found["refused"], bad, f"{seconds:.1f} s", f"{megabytes:.0f} MB")
        print("| " + " | ".join(map(str, row)) + " |", flush=True)
        for kind in found.keys() - set(FINE):
            print(f"    {found[kind]} x {kind}", flush=True)
    print(f"{cases} cases with seed {options.seed}, {failed} failed")
    return failed > 0


def campaign(
    name: str, door: Door, count: int, seed: str, keep: Path | None
) -> tuple[collections.Counter[str], float, float]:
    """Outcomes, the longest case in seconds and the largest process in MB."""
    found: collections.Counter[str] = collections.Counter()
    longest = largest = 0.0
    with tempfile.TemporaryDirectory() as place:
        good, case = Path(place, "good"), Path(place, "case")
        good.mkdir()
        door.make(good)
        door.read(good / door.entry)
        for number in range(count):
            shutil.copytree(good, case, symlinks=True)
            how = damage(case, door.damaged or door.entry, door.mutate, Random(f"{seed} {name} {number}"))
            kind, seconds, megabytes = one_case(door, case / door.entry)
            found[kind] += 1
            longest, largest = max(longest, seconds), max(largest, megabytes)
            if kind not in FINE and keep is not None and found[kind] == 1:
                kept = keep / f"{name} {number}".replace("/", "_")
                with contextlib.suppress(shutil.Error):  # a pipe cannot be kept
                    shutil.copytree(case, kept, symlinks=True, dirs_exist_ok=True)
                (keep / f"{kept.name}.txt").write_text(f"{kind}\n{how}\n")
            shutil.rmtree(case)
    return found, longest, largest


def one_case(door: Door, path: Path) -> tuple[str, float, float]:
    """What became of it, seconds, and MB of the process that did it."""
    incoming, outgoing = os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(incoming)
        os.write(outgoing, judged(door, path).encode()[:4000])
        os._exit(0)
    os.close(outgoing)
    answered = bool(select.select([incoming], [], [], SECONDS)[0])
    if not answered:
        os.kill(child, signal.SIGKILL)
    said = os.read(incoming, 4000).decode(errors="replace")
    os.close(incoming)
    _, status, usage = os.wait4(child, 0)
    megabytes = usage.ru_maxrss / 1024
    kind = said or (f"died of signal {os.WTERMSIG(status)}" if answered else f"no answer in {SECONDS} s")
    if kind in FINE and megabytes > RESIDENT_MB:
        kind = f"more than {RESIDENT_MB} MB"
    return kind, time.monotonic() - started, megabytes


def judged(door: Door, path: Path) -> str:
    """In the child: read, and say what happened."""
    silence = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silence, stream)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (pages + EXTRA_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        door.read(path)
    except InputError:
        return "refused"
    except Nonsense as error:
        return f"accepted nonsense: {str(error)[:60]}"
    except BaseException as error:
        where = next((f for f in reversed(traceback.extract_tb(error.__traceback__)) if str(ROOT) in f.filename), None)
        place = f"{Path(where.filename).relative_to(ROOT)}:{where.lineno}" if where else "?"
        return f"{type(error).__name__} at {place}"
    return "accepted"


if __name__ == "__main__":
    sys.exit(main())
