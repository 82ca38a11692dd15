"""The one error a user is meant to read, and the commands that it names; warnings that say nothing to the user."""

import importlib.metadata
import importlib.util
import os
import re
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_FILTERS = Lock()


class InputError(Exception):
    """Something outside the program is wrong: a file, a setting, a disk.

    The message says what, why and what to do next. The command line prints it without a traceback and ends with
    exit code 1; every other exception is a bug and keeps its traceback.
    """


class SettingError(InputError):
    """A setting cannot be what was asked for: exit code 2, as for an option that does not exist."""


class RecoverableError(InputError):
    """The work done so far is kept, and goes on once what the message names is repaired: rights, a vanished source."""


class DiskFullError(RecoverableError):
    """The disk is full."""


def install_extra(extra: str) -> str:
    """Return the shell command that installs the packages of an extra of this program.

    They are named one by one, since an index of packages may have another program under this one's name.
    """
    try:
        declared = importlib.metadata.requires("msgs-slam") or []
    except importlib.metadata.PackageNotFoundError:  # run from its sources
        return install_command(f".[{extra}]")
    needed = (text.partition(";") for text in declared)
    return install_command(*(name.strip() for name, _, marker in needed if f'"{extra}"' in marker.replace("'", '"')))


def install_command(*requirements: str) -> str:
    """Return the shell command that installs packages beside this program, whatever environment the shell is in.

    A bare `pip` is that of another interpreter, or refused, where this environment is not the active one; `uv` makes
    environments without pip.
    """
    python = shell_word(sys.executable)
    by = f"{python} -m pip install" if importlib.util.find_spec("pip") else f"uv pip install --python {python}"
    return " ".join([by, *map(shell_word, requirements)])


def shell_word(text: str, windows: bool = os.name == "nt") -> str:
    """Return the text as one word of a command for the system's shell; on Windows no path holds a quotation mark."""
    if not windows:
        return shlex.quote(text)
    return text if re.fullmatch(r"[\w:\\/.-]+", text) else f'"{text}"'


@contextmanager
def ignored_warnings(message: str = "", category: type[Warning] = Warning) -> Iterator[None]:
    """Ignore warnings of a category whose text begins with a pattern, in this block.

    The filters are the process's own: two threads that put back what each of them found would leave them changed, so
    one block at a time does it. Keep it short.
    """
    with _FILTERS, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message, category)
        yield
