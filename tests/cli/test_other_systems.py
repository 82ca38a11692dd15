"""What can be held of Windows and macOS from here: the program's whole way without POSIX, and names for their disks."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest
from cli_runs import QUICK, FinishedRun, elsewhere
from test_kill_and_resume import digests

from msgs_slam.formats.errors import shell_word
from msgs_slam.formats.reading import leads_out
from msgs_slam.pipelines.run.lock import SOFT_LOCK

CHECKOUT = Path(__file__).resolve().parents[2]
AS_WINDOWS = CHECKOUT / "tests" / "as_windows.py"
RESERVED = re.compile(r'[<>:"/\\|?*\x00-\x1f]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)
ONLY_LINUX = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="tells open files by /proc")
Python = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def windows(tmp_path: Path) -> Python:
    """Python as on Windows, and so in the processes that it starts."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(f"import runpy\nrunpy.run_path({str(AS_WINDOWS)!r})['pretend']()\n")
    places = elsewhere(tmp_path) | {"PYTHONPATH": str(site), "PYTHONWARNDEFAULTENCODING": "1"}

    def call(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *map(str, words)]
        return subprocess.run(command, env=places, capture_output=True, text=True, check=False)

    return call


@ONLY_LINUX
def test_without_posix_the_program_does_all_and_with_the_same_bytes(
    finished_run: FinishedRun, windows: Python, tmp_path: Path
) -> None:
    videos, run = tmp_path / "videos", tmp_path / "runs" / "room.msgs"
    videos.mkdir()
    shutil.copy(finished_run.video, videos)

    def call(*words: object) -> str:
        done = windows("-m", "msgs_slam", *words)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    call("batch", videos, "--out", run.parent, *(x for s in QUICK for x in ("--set", s)), "-q")
    assert digests(run) == digests(finished_run.folder)
    call("resume", run, "--redo", "global_ba", "-q")  # finished folders give way to new ones
    assert digests(run) == digests(finished_run.folder)
    call("evaluate", run, "--truth", finished_run.truth, "-q")
    call("report", run, "-q")
    call("render", run, tmp_path / "here" / "room.avi", "-q")
    call("export", run, "--only", "spz", "-q")
    assert "export" in call("status", run)
    assert (run / "report.html").is_file()
    assert not (run / SOFT_LOCK).exists(), "the lock of a disk without locks is not given back"
    names = [path.relative_to(run) for path in run.rglob("*")]
    assert not [name for name in names if any(RESERVED.search(part) for part in name.parts)]
    assert len({str(name).casefold() for name in names}) == len(names)


@ONLY_LINUX
@pytest.mark.parametrize(
    ("script", "error"),
    [
        ("import fcntl", "No module named 'fcntl'"),
        ("exec('import os; os.setsid()', {'__name__': 'msgs_slam.x'})", "no attribute 'setsid'"),
        ("import os; os.mkdir('a'); f = open('a/b', 'w'); os.replace('a', 'c')", "it is open"),
        ("import os; os.mkdir('a'); os.mkdir('b'); os.replace('a', 'b')", "Access is denied"),
        ("f = open('a', 'w'); f.write('\\n'); f.close(); 1 / (len(open('a', 'rb').read()) - 2)", "division by zero"),
    ],
)
def test_what_stands_for_windows_refuses_what_windows_does(
    windows: Python, script: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert error in windows("-c", script).stderr.splitlines()[-1]


def test_the_package_is_whole_where_git_makes_no_links(tmp_path: Path) -> None:
    """Git for Windows writes a text file in the place of each."""
    for name in ("formats", "msgs_cli", "pipelines"):
        shutil.copytree(CHECKOUT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "msgs_slam").mkdir()
    for path in (CHECKOUT / "msgs_slam").iterdir():
        if path.is_symlink():
            (tmp_path / "msgs_slam" / path.name).write_text(os.readlink(path))
        elif path.is_file():
            shutil.copy(path, tmp_path / "msgs_slam")
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE", "docs/msgs-slam.1"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(CHECKOUT / name, tmp_path / name)
    made = {}
    for checkout, out in ((tmp_path, tmp_path / "without"), (CHECKOUT, tmp_path / "with")):
        command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", tmp_path, "build_py", "--build-lib", out]
        subprocess.run([*map(str, command)], cwd=checkout, check=True, capture_output=True)
        made[out.name] = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert made["without"] == made["with"]
    assert {"msgs_slam/formats/ply.py", "msgs_slam/pipelines/depth/completion/weights.npz"} < made["with"]


def test_names_in_commands_are_quoted_as_each_shell_reads_them() -> None:
    names = ("C:\\runs\\room.msgs", "my room.msgs", "a&b.mp4", "it's.mp4")
    assert [shell_word(n, windows=True) for n in names] == [names[0], *(f'"{n}"' for n in names[1:])]
    assert [shlex.split(shell_word(n, windows=False)) for n in names] == [[n] for n in names]


@pytest.mark.parametrize(("name", "out"), [("a\\b.jpg", False), ("..\\b.jpg", True), ("c:b.jpg", True), ("\\b", True)])
def test_no_name_leads_out_of_its_folder_on_windows(name: str, out: bool) -> None:
    assert leads_out(PureWindowsPath(name)) == out
    assert leads_out(PurePosixPath("/b"))
    assert not leads_out(PurePosixPath("a/c:b.jpg"))
