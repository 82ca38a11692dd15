"""A written file is whole or not there, and failures speak to the user."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from msgs_slam.formats.atomic import atomic_path, copy_file, write_bytes, write_text
from msgs_slam.formats.errors import DiskFullError, InputError, RecoverableError
from msgs_slam.formats.reading import opened

REPO = Path(__file__).resolve().parents[2]


def test_writes_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "a.bin"
    write_bytes(path, b"first")
    write_bytes(path, b"second")
    assert path.read_bytes() == b"second"
    write_text(path.with_suffix(".txt"), "Grüße\n")
    assert path.with_suffix(".txt").read_bytes() == "Grüße\n".encode()
    assert sorted(p.name for p in path.parent.iterdir()) == ["a.bin", "a.txt"]


def test_failed_block_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def write_half(folder: Path) -> None:
        with atomic_path(path) as temporary:
            assert (temporary.suffix, temporary.parent) == (path.suffix, path.parent)
            temporary.write_text("half of the n")
            (folder / "not there").read_text()

    with pytest.raises(RecoverableError):
        write_half(tmp_path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_killed_writer_leaves_the_old_file_and_is_cleaned_by_the_next(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    program = (
        "import os, signal, sys; from pathlib import Path; from msgs_slam.formats.atomic import atomic_path\n"
        "with atomic_path(Path(sys.argv[1])) as t:\n"
        "    t.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], cwd=REPO, check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2
    write_text(path, "new")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["new"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk_is_explained(tmp_path: Path, code: int) -> None:
    with pytest.raises(DiskFullError, match=r"disk full while writing a\.bin"), atomic_path(tmp_path / "a.bin"):
        raise OSError(code, "no")
    assert list(tmp_path.iterdir()) == []


def _limit_file_size() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))


def test_a_write_that_really_stops_half_way(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from msgs_slam.formats.atomic import write_bytes\n"
        "from msgs_slam.formats.errors import *\n"
        "try: write_bytes(Path(sys.argv[1]), b'x' * 5000)\n"
        "except InputError as e: print(e); sys.exit(1)"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "a.bin")]
    done = subprocess.run(command, cwd=REPO, check=False, capture_output=True, text=True, preexec_fn=_limit_file_size)
    assert done.returncode == 1, done.stderr
    assert "disk full" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("I am a file")
    with pytest.raises(InputError, match="choose another output folder"):
        write_bytes(tmp_path / "out" / "a.bin", b"x")


def test_what_vanishes_while_it_is_copied_is_named(tmp_path: Path) -> None:
    gone = pytest.raises(RecoverableError, match=r"cannot write .*a\.bin: .*gone\.jpg has vanished")
    with gone, atomic_path(tmp_path / "a.bin") as temporary:
        shutil.copyfile(tmp_path / "gone.jpg", temporary)
    assert list(tmp_path.iterdir()) == []


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="weird") as caught, atomic_path(tmp_path / "a.bin"):
        raise OSError(errno.EIO, "weird")
    assert not isinstance(caught.value, InputError)


def test_the_file_that_the_system_refuses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = tmp_path / "source.jpg", tmp_path / "out" / "target.jpg"
    with pytest.raises(InputError, match=r"no such file: .*source\.jpg"):
        copy_file(source, target)
    source.write_bytes(b"picture")
    real = os.open

    def refusing(path: Path, *words: int, **more: int) -> int:
        if Path(path) == source:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, *words, **more)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refusing)
        with pytest.raises(InputError, match=r"cannot read .*source\.jpg: permission denied"):
            copy_file(source, target)
    copy_file(source, target)
    assert target.read_bytes() == b"picture"

    def write(code: int, name: str | None) -> None:
        with opened(source):
            raise OSError(code, os.strerror(code), name)

    with pytest.raises(OSError, match="target"):  # the caller's own fault, not of what it reads
        write(errno.EACCES, str(target))
    with pytest.raises(OSError, match="No space"):
        write(errno.ENOSPC, None)
    with pytest.raises(InputError, match=r"cannot read .*source\.jpg: Input/output error"):
        write(errno.EIO, None)
    with pytest.raises(DiskFullError), atomic_path(target):
        raise OSError(errno.ENOSPC, "No space left on device", str(source))
    with pytest.raises(RecoverableError, match=r"source\.jpg: Permission denied, while"), atomic_path(target):
        raise PermissionError(errno.EACCES, "Permission denied", str(source))
