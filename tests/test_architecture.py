"""The shape of the house: imports go one way, help is instant, nothing unsafe is loaded."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FORBIDDEN = {
    "formats": {"pipelines", "msgs_cli", "click", "tqdm"},
    "pipelines": {"msgs_cli", "click", "tqdm"},
    "msgs_cli": set(),
}


FLOORS = (
    {"config", "types"}, {"geometry", "providers", "system"}, {"networks", "render", "sfm"}, {"depth"},
    {"labels", "run"}, {"mapping", "source"}, {"masks", "scene"}, {"export", "frames", "proxy"},
    {"evaluation", "reconstruct", "tracking"}, {"global_ba"}, {"paper"},
)  # fmt: skip
"""The rooms of pipelines/: its folders and its flat files, each above all that it imports."""
MOST_FLAT = 4


def names_imported_by(node: ast.AST, path: Path) -> set[str]:
    """Absolute names that an import statement in a file asks for, as in `msgs_slam.formats.errors.InputError`."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    folders = path.relative_to(ROOT).parts[:-1]
    package = folders if folders[0] == "msgs_slam" else ("msgs_slam", *folders)
    above = package[: len(package) - node.level + 1] if node.level else ()
    return {".".join([*above, *filter(None, [node.module]), alias.name]) for alias in node.names}


def imported_packages(path: Path) -> set[str]:
    """Top-level packages and folders of this project that a file imports anywhere."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = {name for node in ast.walk(tree) for name in names_imported_by(node, path)}
    return {name.removeprefix("msgs_slam.").split(".")[0] for name in found}


def test_imports_inside_the_folders_are_relative() -> None:
    """So that whoever follows imports by the folders (editors, readers of a repository) arrives."""
    files = [p for room in (*FORBIDDEN, "msgs_slam") for p in (ROOT / room).rglob("*.py")]
    trees = {p: ast.parse(p.read_text(encoding="utf-8")) for p in files}
    absolute = {
        f"{path}:{node.lineno}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if (isinstance(node, ast.Import) and any(a.name.split(".")[0] == "msgs_slam" for a in node.names))
        or (isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").split(".")[0] == "msgs_slam")
    }
    assert not absolute


def test_the_program_has_one_import_name() -> None:
    """The folders' bare names work where the repository is the working folder, and in no installed copy."""
    files = [p for room in (*FORBIDDEN, "tests", "docs") for p in (ROOT / room).rglob("*.py")]
    bare = re.compile(rf"(?:^\s*|n)(?:from|import) (?:{'|'.join(FORBIDDEN)})\b(?!['`])", re.MULTILINE)  # in strings too
    assert [str(p) for p in files if bare.search(p.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("room", FORBIDDEN)
def test_imports_go_one_way(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    wrong = {str(f.relative_to(ROOT)): imported_packages(f) & FORBIDDEN[room] for f in files}
    assert not {name: bad for name, bad in wrong.items() if bad}


def modules() -> dict[str, Path]:
    """Import name of every file below pipelines/."""
    files = sorted((ROOT / "pipelines").rglob("*.py"))
    return {
        ".".join(("msgs_slam", *f.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): f for f in files
    }


def imported_modules(path: Path, known: Iterable[str]) -> set[str]:
    """Those of `known` that a file imports anywhere in it, in a function too; for annotations alone does not count."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    checks = [n for n in ast.walk(tree) if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test)]
    idle = {id(inner) for check in checks for statement in check.body for inner in ast.walk(statement)}
    found: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in idle:
            continue
        for name in names_imported_by(node, path):
            found.add(name if name in known else name.rpartition(".")[0])
    return found & set(known)


def room_of(module: str) -> str:
    """The folder or flat file of pipelines/."""
    return module.split(".")[2]


def test_every_file_stands_on_one_floor() -> None:
    rooms = {room_of(m) for m in modules() if m.count(".") >= 2}
    assert sorted(name for floor in FLOORS for name in floor) == sorted(rooms)
    flat = [p for p in (ROOT / "pipelines").glob("*.py") if p.name != "__init__.py"]
    assert len(flat) <= MOST_FLAT, "a newcomer opens these first: the others have a folder"


@pytest.mark.parametrize("height", range(len(FLOORS)), ids=lambda h: "+".join(sorted(FLOORS[h])))
def test_no_room_imports_one_beside_or_above_it(height: int) -> None:
    """Lazy imports count too: so no two rooms import each other, nor any more of them in a circle."""
    known = modules()
    below = {name for floor in FLOORS[:height] for name in floor}
    wrong = {}
    for module, path in known.items():
        if module.count(".") >= 2 and (room := room_of(module)) in FLOORS[height]:
            rooms = {room_of(m) for m in imported_modules(path, known) if m.count(".") >= 2}
            wrong[module] = rooms - below - {room}
    assert not {name: bad for name, bad in wrong.items() if bad}


def test_no_two_folders_import_each_other() -> None:
    """A folder inside another one counts as a folder of its own; the flat files stand on floors."""
    known = {module: path for module, path in modules().items() if path.parent != ROOT / "pipelines"}
    folders = {module: path.parent.relative_to(ROOT).as_posix() for module, path in known.items()}
    pairs = {(folders[m], folders[other]) for m, path in known.items() for other in imported_modules(path, known)}
    assert not sorted((a, b) for a, b in pairs if a < b and (b, a) in pairs)


def test_no_file_imports_itself_by_a_detour() -> None:
    known = modules()
    waiting = {m: imported_modules(path, known) - {m} for m, path in known.items()}
    while free := [m for m, needs in waiting.items() if not needs & waiting.keys()]:
        for module in free:
            del waiting[module]
    assert not sorted(waiting), "these are on a circle, or import one"


def test_tests_and_benchmarks_import_what_there_is() -> None:
    """Benchmarks are not run here, and import inside functions: what has moved would show only at their users'."""
    missing = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("msgs_slam.", "tests.")):
                base = ROOT.joinpath(*node.module.removeprefix("msgs_slam.").split("."))
                if not base.with_suffix(".py").is_file() and not base.is_dir():
                    missing.append(f"{path.relative_to(ROOT)}: {node.module}")
                elif gone := {alias.name for alias in node.names} - names_of(base):
                    missing.append(f"{path.relative_to(ROOT)}: {node.module} has no {sorted(gone)}")
    assert not missing


@cache
def names_of(base: Path) -> set[str]:
    """What can be imported from the module or package whose path without suffix is `base`."""
    inside = {p.stem for p in base.iterdir()} if base.is_dir() else set()
    file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    if not file.is_file():
        return inside
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            inside.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            inside.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            inside |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
    return inside


def test_nothing_is_unpickled() -> None:
    for room in FORBIDDEN:
        for path in (ROOT / room).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            assert "pickle" not in imported_packages(path), path
            assert "allow_pickle=True" not in text, path
            assert "weights_only=False" not in text, path
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == "torch.load":
                    assert any(k.arg == "weights_only" for k in node.keywords), f"{path}:{node.lineno}"
                if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.load":
                    assert any(k.arg == "allow_pickle" for k in node.keywords), f"{path}:{node.lineno}"


UNSAFE_IMPORTS = {"subprocess", "pty", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml", "ctypes"}
UNSAFE_BUT_HERE = {
    "pipelines/system/machine.py": {"ctypes"},
    "pipelines/evaluation/html.py": {"subprocess"},
    "formats/video_streams.py": {"subprocess"},
    "formats/datasets/calibration.py": {"yaml"},
}
"""The first calls one function of the C library that runs anyway, with a number; the second starts this program again,
in the same Python and without a shell; the third prints a report of ours by the browser of this machine, without a
shell: nothing from outside reaches them. The fourth opens a video that OpenCV has open already in a second Python, to
hear FFmpeg's errors: without a shell, with the same containers allowed. The last
has yaml.SafeLoader, which makes plain values only."""
UNSAFE_CALLS = re.compile(r"eval|exec|compile|__import__|os\.(system|popen|exec\w+|spawn\w+|posix_spawn\w*|fork)")


@pytest.mark.parametrize("room", FORBIDDEN)
def test_no_other_program_and_no_text_is_run(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        allowed = UNSAFE_BUT_HERE.get(path.relative_to(ROOT).as_posix(), set())
        assert not imported_packages(path) & UNSAFE_IMPORTS - allowed, path
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                assert not UNSAFE_CALLS.fullmatch(ast.unparse(node.func)), f"{path}:{node.lineno}"
                assert not any(k.arg == "shell" for k in node.keywords), f"{path}:{node.lineno}"


HELP_OF_EVERY_COMMAND = """
import sys
before = set(sys.modules)
import click
from click.testing import CliRunner
from msgs_slam.msgs_cli.main import main

def ask(command, words):
    result = CliRunner().invoke(main, [*words, "--help"])
    assert result.exit_code == 0 and "Usage" in result.output, words
    for name, below in getattr(command, "commands", {}).items():
        ask(below, [*words, name])

ask(main, [])
loaded = {name for name in set(sys.modules) - before if name.partition(".")[0] not in sys.stdlib_module_names}
print(*(name if name.startswith("msgs_slam") else name.partition(".")[0] for name in loaded))
"""
LIGHT = {
    "click", "msgs_slam", "msgs_slam.formats", "msgs_slam.formats.errors", "msgs_slam.pipelines",
    "msgs_slam.pipelines.config", "msgs_slam.pipelines.export", "msgs_slam.pipelines.export.kinds",
    "msgs_slam.pipelines.system", "msgs_slam.pipelines.system.progress", "msgs_slam.pipelines.system.wording",
}  # fmt: skip
"""All that the help may load beside the standard library and the command line's own modules."""


def test_help_of_every_command_loads_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", HELP_OF_EVERY_COMMAND], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert "msgs_slam.msgs_cli.models" in loaded
    assert {name for name in loaded if not name.startswith("msgs_slam.msgs_cli")} == LIGHT


@pytest.mark.parametrize("path", sorted(p for room in FORBIDDEN for p in (ROOT / room).rglob("*.py")), ids=str)
def test_files_stay_readable(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 450, f"{len(lines)} lines: split it by noun"
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.FunctionDef):
            # A compiled kernel is one nest of loops: what it calls would have to be compiled and inlined with it.
            most = 110 if any(ast.unparse(d).endswith("kernel") for d in node.decorator_list) else 60
            length = (node.end_lineno or 0) - node.lineno
            assert length <= most, f"{node.name} is {length} lines"


RUN_PATHS = {"root", "stage", "partial", "piece"}
"""Of a `RunFolder`: what a name read from a file of the run could be joined to."""


def is_of_run(node: ast.AST, named: set[str]) -> bool:
    """Whether an expression is a folder of a run; `named`: variables that are."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Attribute) and node.func.attr in RUN_PATHS
    if isinstance(node, ast.Name):
        return node.id in named
    return isinstance(node, ast.Attribute) and node.attr == "root" and "run" in ast.unparse(node.value).lower()


def joins_to_a_run(tree: ast.AST) -> Iterable[int]:
    """Lines that join a name to a folder of a run, or to a variable that is one in the same function, by `/`,
    `joinpath`, `with_name` or `Path(...)`."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Module)):
        inside = list(ast.walk(function))
        given = [n for n in inside if isinstance(n, ast.Assign) and is_of_run(n.value, set())]
        is_module = isinstance(function, ast.Module)
        named = {t.id for n in given for t in n.targets if isinstance(t, ast.Name) and not is_module}
        for node in inside:
            held: list[ast.AST] = []
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                is_shown = isinstance(node.left, ast.Name) and isinstance(node.right, ast.Constant)
                held = [] if is_shown else [node.left]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                held = [node.func.value] if node.func.attr in ("joinpath", "with_name") else []
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) > 1:
                held = [node.args[0]] if node.func.id in ("Path", "RunFolder") else []
            yield from (node.lineno for part in held if is_of_run(part, named))  # type: ignore[attr-defined]


def test_names_are_joined_to_a_run_by_the_run_alone() -> None:
    """`RunFolder.path` refuses names and links that lead out of the run, which may be from anybody."""
    for text in (
        "run.root / name", "run.stage('a') / name", "Path(self.run.root, name)", "run.root.joinpath(name)",
        "def f():\n    folder = run.stage('a')\n    return folder / name",
    ):  # fmt: skip
        assert list(joins_to_a_run(ast.parse(text))), text
    assert not list(joins_to_a_run(ast.parse("run.path(name), folder / name, root / 'x', run.root.parent")))
    files = [p for room in ("pipelines", "msgs_cli") for p in (ROOT / room).rglob("*.py")]
    trees = {p.relative_to(ROOT).as_posix(): ast.parse(p.read_text(encoding="utf-8")) for p in files}
    assert [f"{name}:{line}" for name, tree in trees.items() for line in joins_to_a_run(tree)] == []
