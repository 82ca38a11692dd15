"""Everything that needs an NVIDIA card, in one run of at most nine minutes: right, how fast, and the whole job.

    python tests/benchmarks/card.py OUT --video video.mp4 --truth DATASET
    python tests/benchmarks/card.py OUT --rehearse --video video.mp4      without a card, on tiny sizes

Parts run one after another, each in a process and with a time limit of its own: the tests that compile for a card,
then errors and times of renderer, mapping and stereo, the whole job on card and CPU, and gsplat where it is installed.
Figures are written to OUT/card.json as they come; OUT/card.md has them as tables.
"""

# ruff: noqa: E402 (paths and environment are set before what needs them)

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/benchmarks"), str(ROOT / "tests/pipelines/render")]
if "--rehearse" in sys.argv:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported

from on_card.report import markdown
from on_card.rows import Rows

LIMITS = {"tests": 110.0, "renderer": 90.0, "mapping": 90.0, "stereo": 60.0, "job": 300.0, "gsplat": 45.0}
"""Parts in their order, with the seconds that each may take."""
SLOWER = 4 if "--rehearse" in sys.argv else 1
CARD_SHARE = 0.45
"""Of the whole job's seconds, those that the card may take."""
TESTS = (
    "pipelines/render/test_render_cuda.py", "pipelines/mapping/test_mapping_on_card.py",
    "pipelines/proxy/test_proxy_stereo_on_card.py",
)  # fmt: skip


def run_part(name: str, rows: Rows, options: argparse.Namespace) -> None:
    """Measure one part in this process."""
    if name == "environment":
        from on_card.machine import add_machine

        add_machine(rows)
    elif name == "tests":
        run_tests(rows, options.work)
    elif name == "job":
        from on_card.job import whole_jobs

        on_card = CARD_SHARE * options.seconds
        whole_jobs(
            rows, options.video, options.work, options.truth, {"card": on_card, "cpu": options.seconds - on_card}
        )
    elif name == "gsplat":
        from on_card.peer import beside_gsplat

        beside_gsplat(rows)
    else:
        import on_card.errors as errors
        import on_card.timings as timings

        work: dict[str, tuple[Callable[[Rows], None], ...]] = {
            "renderer": (errors.errors_of_renderer, timings.time_renderer),
            "mapping": (errors.errors_of_mapping, timings.time_mapping),
            "stereo": (errors.errors_of_stereo, timings.time_stereo),
        }
        for task in work[name]:
            with rows.attempt(task.__name__):
                task(rows)


def run_tests(rows: Rows, work: Path) -> None:
    """The kernels' own tests, which compile for a card where there is one."""
    log, start = work / "tests.log", time.perf_counter()
    command = [sys.executable, "-m", "pytest", "-vv", "-p", "no:cacheprovider", "--rootdir", str(ROOT)]
    if "TRITON_INTERPRET" in os.environ:
        command += ["-k", "errors_of_colors or whole_match or lists_are_sorted"]
    with log.open("w") as out:
        code = subprocess.call([*command, *(str(ROOT / "tests" / t) for t in TESTS)], stdout=out, stderr=out, cwd=ROOT)
    count_tests(rows, log, code, time.perf_counter() - start)


def count_tests(rows: Rows, log: Path, code: int | None, seconds: float) -> None:
    """Add what a log of pytest says; code None: it was stopped."""
    text = log.read_text(errors="replace") if log.exists() else ""
    outcomes = re.findall(r"^(\S+::.*?) (PASSED|FAILED|ERROR|SKIPPED)", text, re.MULTILINE)
    failed = [n.rpartition("/")[2] for n, o in outcomes if o in ("FAILED", "ERROR")]
    passed = sum(o == "PASSED" for _, o in outcomes)
    rows.add("tests", exit_code=code, passed=passed, failed=failed, seconds=round(seconds, 1),
             said=re.findall(r"^E  .*", text, re.MULTILINE)[:20] if failed or code else [])  # fmt: skip


def guarded(name: str, rows: Rows, options: argparse.Namespace, seconds: float) -> None:
    """One part in a process of its own, which ends with its time."""
    command = [sys.executable, __file__, str(options.out), "--part", name, "--work", str(options.work)]
    command += ["--seconds", str(seconds), *(["--rehearse"] if options.rehearse else [])]
    command += [
        x for key in ("video", "truth") if getattr(options, key) for x in (f"--{key}", str(getattr(options, key)))
    ]
    start = time.perf_counter()
    process = subprocess.Popen(command, start_new_session=True)
    try:
        code: int | None = process.wait(seconds + 5)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # the part's own group, with all that it has started
        process.wait()
        code = None
        if name == "tests":
            count_tests(rows, options.work / "tests.log", None, seconds)
    rows.add("parts", part=name, exit_code=code, seconds=round(time.perf_counter() - start, 1), limit=round(seconds))


def begin_beside(options: argparse.Namespace) -> list[subprocess.Popen[str]]:
    """What runs beside the first part, which is not timed: the counts of `launches.py`, which needs no card, and small
    runs that leave compiled kernels in their caches."""
    counts = [sys.executable, str(ROOT / "tests/benchmarks/launches.py"), "--json", str(options.out / "launches.json")]
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "", "TRITON_INTERPRET": "1"}
    log = (options.work / "launches.log").open("w")
    begun = [subprocess.Popen(counts, env=environment, stdout=log, stderr=log, text=True)]
    if options.video and "job" in options.only:
        from on_card.job import warm_up

        begun += warm_up(options.video, options.work)
    return begun


def end(processes: list[subprocess.Popen[str]]) -> None:
    """Wait for them, not for long."""
    while processes:
        process = processes.pop()
        try:
            process.wait(45 * SLOWER)
        except subprocess.TimeoutExpired:
            process.kill()


def measure(rows: Rows, options: argparse.Namespace) -> None:
    """All parts that are wanted, as long as there is time."""
    deadline = time.monotonic() + options.seconds
    guarded("environment", rows, options, 40)
    beside = begin_beside(options)
    for name in options.only:
        left = deadline - time.monotonic() - 12
        if left < 15 or (name == "job" and options.video is None):
            rows.add("parts", part=name, exit_code=None, seconds=0, limit=0)
            continue
        guarded(name, rows, options, min(SLOWER * LIMITS[name], left))
        end(beside)
        (options.out / "card.md").write_text(markdown(rows.read()))
    print(markdown(rows.read())[-11_000:])


def main() -> None:
    """Measure all parts, or one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for card.json and card.md")
    parser.add_argument("--video", type=Path, help="of the whole job, which is left out without it")
    parser.add_argument("--truth", type=Path, help="a data set with the truth of that video")
    parser.add_argument("--only", nargs="+", choices=list(LIMITS), default=list(LIMITS))
    parser.add_argument("--seconds", type=float, default=530.0, help="of all parts together")
    parser.add_argument("--rehearse", action="store_true", help="no card: tiny sizes in Triton's interpreter")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--part", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = Rows(options.out)
    if options.part:
        run_part(options.part, rows, options)
        return
    rows.path.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="msgs-slam-card-") as folder:
        options.work = options.work or Path(folder)
        options.work.mkdir(parents=True, exist_ok=True)
        measure(rows, options)


if __name__ == "__main__":
    main()
