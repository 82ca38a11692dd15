"""Files that are either whole or not there."""

import errno
import hashlib
import os
import platform
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import DiskFullError, InputError, RecoverableError
from .reading import opened

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NOT_ALLOWED = {errno.EACCES, errno.EPERM, errno.EROFS}
_NEARLY_FULL_BYTES = 1 << 20
_LONGEST_NAME = 255
_AT_ONCE = 1 << 20


_after_write: list[Callable[[Path], None]] = []
_own_mark: list[str] = []


@contextmanager
def after_each_write(call: Callable[[Path], None]) -> Iterator[None]:
    """Call a function with the path of every file that is written atomically inside this block, in any thread."""
    _after_write.append(call)
    try:
        yield
    finally:
        _after_write.remove(call)


def process_token() -> str:
    """Return a mark of this process, unique among the processes that share a disk, on this machine or another."""
    return f"{machine_token()}-{os.getpid()}"


def machine_token() -> str:
    """Return a mark of this machine, or of the container where it has process ids of its own."""
    counted = ""
    with suppress(OSError):
        counted = os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(f"{platform.node()}{counted}".encode()).hexdigest()[:8]


@contextmanager
def unique_temp_names() -> Iterator[None]:
    """Give temporary files inside this block names that no other process uses, on this machine or another: several may
    write the same file at the same time, and the last rename wins. Files of a killed process remain."""
    _own_mark.append(f"-{process_token()}")
    try:
        yield
    finally:
        _own_mark.pop()


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of the same suffix; rename it to `path` when the block ends well.

    The folder is made when missing. A block that raises leaves `path` as it was and no temporary file behind. The
    temporary name depends on `path` alone, so what a killed process left is overwritten by the next attempt; but in
    `unique_temp_names`.

    Raises DiskFullError when the disk is full, InputError when the folder cannot be written.
    """
    path = Path(path)
    temporary = temporary_of(path)
    try:
        if path.exists() and not path.is_file():  # renaming would take the place of a device
            raise InputError(f"{path} is a folder, a device or a pipe: name a file that may be written")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        for call in _after_write:
            call(path)
    except OSError as error:
        if _concerns_other_file(error, path, temporary):
            raise RecoverableError(
                f"{os.fsdecode(error.filename)}: {error.strerror}, while writing {path.name}: check its rights"
            ) from error
        raise explained(error, path) from error
    finally:
        with suppress(OSError):  # what the block raised says more
            temporary.unlink(missing_ok=True)


def temporary_of(path: Path) -> Path:
    """Return the temporary file that `atomic_path` writes first; a killed process may leave it behind."""
    end = f".tmp{''.join(_own_mark[-1:])}{path.suffix}"
    name = f".{path.stem}{end}"
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = f".{hashlib.sha256(os.fsencode(path.name)).hexdigest()}{end}"
    return path.with_name(name)


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder named as the temporary file of `path`, and remove it; what a killed process left goes."""
    folder = temporary_of(path)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_temporaries(folder: Path) -> None:
    """Remove the temporary files and folders that killed processes have left below a folder."""
    for path in list(folder.rglob(".*.tmp*")):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write a whole file at once, atomically. Raises InputError as `atomic_path` does."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically, line ends as they are; names that are no UTF-8 are escaped. Raises InputError
    as `atomic_path` does."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def copy_file(source: Path, target: Path) -> None:
    """A copy, atomically: what is given away may be edited without changing what it came from. Raises InputError where
    the source cannot be read, and as `atomic_path` does."""
    with opened(source, any_content=True) as file, atomic_path(target) as temporary, temporary.open("wb") as copy:
        shutil.copyfileobj(file, copy, _AT_ONCE)


def _concerns_other_file(error: OSError, path: Path, temporary: Path) -> bool:
    """Whether the system names a file that is read or written beside `path`, and the disk is not full."""
    if not isinstance(error.filename, str | bytes) or error.errno == errno.ENOENT or is_disk_full(error, path.parent):
        return False
    return Path(os.fsdecode(error.filename)) not in (path, temporary, *path.parents)


def explained(error: OSError, path: Path) -> Exception:
    """Return the failure to write `path` in words of the user, where the user can do something about it."""
    if is_disk_full(error, path.parent):
        return DiskFullError(
            f"disk full while writing {path.name} ({error.strerror or 'cut short'}), "
            f"{free_bytes(path.parent) / 1e6:.0f} MB are free in {path.parent}: "
            "free some space (or point the output at another disk), then run the same command again"
        )
    if error.errno in _NOT_ALLOWED:
        return RecoverableError(
            f"cannot write {path}, {error.strerror}: choose another output folder or change its rights"
        )
    if error.errno == errno.ENAMETOOLONG:
        return InputError(f"cannot write {path}: the name is too long for this disk: choose a shorter one")
    if error.errno == errno.ENOENT:
        return RecoverableError(f"cannot write {path}: {error.filename} has vanished, or cannot be made there")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return InputError(f"cannot write {path}, a part of that path is a file: choose another output folder")
    return error


def is_disk_full(error: OSError, folder: Path) -> bool:
    """Whether a write below `folder` failed for want of room (or of quota, or of the largest file allowed)."""
    # numpy's tofile reports a short write without an errno; the disk itself says what happened.
    return error.errno in _NO_ROOM or (error.errno is None and free_bytes(folder) < _NEARLY_FULL_BYTES)


def require_room(folder: Path, needed: int) -> None:
    """Raises DiskFullError where a folder, there or not yet, has no room for so many bytes."""
    if (free := free_bytes(folder)) < needed:
        raise DiskFullError(
            f"{folder} needs at least {needed / 1e6:.0f} MB, and {free / 1e6:.0f} MB are free there: free some space, "
            "or point the output at another disk"
        )


def free_bytes(folder: Path) -> int:
    """Free space on the disk of a folder, whether it exists or not."""
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free
