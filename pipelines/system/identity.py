"""Which code a stage's result was made by: something that cannot be forgotten when the code changes.

The identity is part of a stage's fingerprint. It is a digest of the stage's own sources: its module and all that it
imports in this project, directly or not, but for `PLUMBING`, which says how a stage is run and not what it computes,
and the data beside these modules (weights, tables, pages). A comment counts as a change too: a stage run once too often
does no harm.

Libraries are not part of it: another numpy or COLMAP may give other bytes, and does not make a run out of date.
"""

import functools
import hashlib
import os
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "msgs_slam"
"""The import name of `ROOT`: of the repository in an editable install, of a folder of site-packages in any other."""
_IMPORT = re.compile(rb"^\s*from (\.+)([\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
"""An import inside the project: these are relative. A line of a docstring that looks like one does no harm."""
PLUMBING = frozenset(
    [
        "msgs_slam.pipelines.config",
        "msgs_slam.pipelines.read_config",
        "msgs_slam.pipelines.engine.stages",
        "msgs_slam.pipelines.engine.tasks",
        "msgs_slam.pipelines.system.progress",
        "msgs_slam.pipelines.system.memory",
        "msgs_slam.pipelines.run.manifest",
        "msgs_slam.pipelines.run.ending",
        "msgs_slam.pipelines.system.identity",
        "msgs_slam.formats.errors",
        "msgs_slam.formats.atomic",
        "msgs_slam.formats.reading",
    ]
)


def stage_file(name: str) -> Path:
    """The module of a stage."""
    return ROOT / "pipelines" / name / "stage.py"


@functools.cache
def stage_identity(file: Path) -> str:
    """Digest of the sources of the stage whose module is `file`, as they were when first asked for."""
    return source_digest(file)


def source_digest(file: Path, root: Path = ROOT) -> str:
    """Over the names and contents of `stage_sources` and `data_beside` them; line ends do not count, as git may change
    them."""
    digest = hashlib.sha256()
    sources = stage_sources(file, root)
    rooms = {source.parent for source in sources if source.is_relative_to(root.resolve())}
    files = sources | {data for room in rooms for data in data_beside(room)}
    named = {os.path.relpath(path, root).replace(os.sep, "/"): path for path in files}
    for name, path in sorted(named.items()):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return digest.hexdigest()[:16]


def stage_sources(file: Path, root: Path = ROOT) -> set[Path]:
    """The module and what it imports of this project, directly or not, without importing any of it."""
    found: set[Path] = set()
    waiting = [file.resolve()]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported_files(path, root)
    return found


@functools.cache
def data_beside(folder: Path) -> tuple[Path, ...]:
    """Files of the package data in a room, which its modules read: all that is no Python, but in packages inside."""
    found: list[Path] = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith((".", "__")) or path.suffix == ".py":
            continue
        if path.is_file():
            found.append(path)
        elif path.is_dir() and not (path / "__init__.py").exists():
            found += data_beside(path)
    return tuple(found)


@functools.cache
def _imported_files(path: Path, root: Path) -> tuple[Path, ...]:
    """Files of the modules that a file imports anywhere in it, and of the packages they are in."""
    if not path.is_relative_to(root.resolve()):  # of somebody else: its relative imports lead nowhere here
        return ()
    package = [PACKAGE, *path.relative_to(root.resolve()).parts[:-1]]
    names: set[str] = set()
    for dots, below, imported in _IMPORT.findall(path.read_bytes()):
        module = ".".join([*package[: len(package) - len(dots) + 1], *filter(None, [below.decode()])])
        names |= {module, *(f"{module}.{name.decode()}" for name in re.findall(rb"\w+", imported))}
    inside = {n for n in names if n.startswith(f"{PACKAGE}.")}
    inside |= {n.rsplit(".", k)[0] for n in inside for k in range(1, n.count("."))}
    files = (file for name in sorted(inside - PLUMBING) for file in _files_of(name, str(root)))
    return tuple(Path(file) for file in files if os.path.isfile(file))


def _files_of(name: str, root: str) -> tuple[str, str]:
    base = os.path.join(root, *name.split(".")[1:])
    return f"{base}.py", os.path.join(base, "__init__.py")
