"""Makes a process of Python what it would be on Windows, as far as another system can show it: `pretend()`.

POSIX modules are not there for anybody; calls and constants that Windows lacks are not there for this program, though
for libraries, which are built for this system; a file that is open can be neither removed nor replaced, nor can a
folder above it; text is written with \\r\\n where nothing else is asked for, and only in a stated encoding.
"""

import builtins
import importlib.abc
import io
import os
import shutil
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import psutil  # noqa: F401  its build for Windows does without what is refused here

REFUSED = {"fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
MISSING = {
    os: {
        "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "chown", "fchmod", "fork", "forkpty", "getegid",
        "geteuid", "getgid", "getloadavg", "getpgid", "getuid", "kill", "killpg", "mkfifo", "nice", "posix_fadvise",
        "posix_fallocate", "pread", "pwrite", "sched_getaffinity", "setpgid", "setsid", "statvfs", "sync", "sysconf",
        "sysconf_names", "uname", "wait",
    },
    signal: {"SIGALRM", "SIGHUP", "SIGKILL", "SIGQUIT", "SIGUSR1", "SIGUSR2", "alarm", "pause", "setitimer"},
}  # fmt: skip


class Refusing(importlib.abc.MetaPathFinder):
    """Finds no POSIX module."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name in REFUSED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def without(module: ModuleType, names: set[str]) -> None:
    """Take these names of a module from the program; libraries keep them."""

    class Lacking(ModuleType):
        def __getattribute__(self, name: str) -> Any:
            if name in names and sys._getframe(1).f_globals.get("__name__", "").startswith("msgs_slam"):
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
            return super().__getattribute__(name)

    module.__class__ = Lacking


def open_files() -> set[str]:
    """Paths of what this process has open or mapped."""
    found = set()
    for entry in os.listdir("/proc/self/fd"):
        try:
            found.add(os.readlink(f"/proc/self/fd/{entry}"))
        except OSError:  # that of the listing itself
            continue
    lines = Path("/proc/self/maps").read_bytes().decode(errors="surrogateescape").splitlines()
    return found | {line.split(maxsplit=5)[5] for line in lines if line.count("/")}


def guarded(call: Callable[..., Any], paths: int) -> Callable[..., Any]:
    """The call, refused where one of its first `paths` arguments is open, or a file below it, or is a folder in the
    place of another."""

    def guard(*arguments: Any, **more: Any) -> Any:
        names = [os.path.realpath(os.fsdecode(path)) for path in arguments[:paths]]
        files = open_files()
        if held := [f for f in files for name in names if f == name or f.startswith(f"{name}/")]:
            raise PermissionError(13, "The process cannot access the file: it is open", held[0])
        if len(names) > 1 and os.path.isdir(names[1]):
            raise PermissionError(13, "Access is denied", names[1])
        return call(*arguments, **more)

    return guard


def with_windows_line_ends(opening: Callable[..., Any]) -> Callable[..., Any]:
    """`open`, whose text gets \\r\\n unless `newline` says otherwise."""

    def opens(file: Any, mode: str = "r", *arguments: Any, **more: Any) -> Any:
        if "b" not in mode and set(mode) & set("wax") and len(arguments) < 4 and more.get("newline") is None:
            more["newline"] = "\r\n"
        return opening(file, mode, *arguments, **more)

    return opens


def pretend() -> None:
    """Make of this process one on Windows."""
    for name in REFUSED:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, Refusing())
    for module, names in MISSING.items():
        without(module, names)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]  # rmtree by paths, as there
    for name, paths in {"rename": 2, "replace": 2, "remove": 1, "unlink": 1, "rmdir": 1}.items():
        setattr(os, name, guarded(getattr(os, name), paths))
    builtins.open = io.open = with_windows_line_ends(io.open)
    assert sys.flags.warn_default_encoding, "start with PYTHONWARNDEFAULTENCODING=1"
    warnings.filterwarnings("error", category=EncodingWarning, module="msgs_slam")
