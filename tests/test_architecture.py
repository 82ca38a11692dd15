"""The shape of the house: imports go one way, help is instant, nothing unsafe is loaded."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FORBIDDEN = {
    "formats": {"pipelines", "msgs_cli", "click", "tqdm"},
    "pipelines": {"msgs_cli", "click", "tqdm"},
    "msgs_cli": set(),
}


FLOORS = (
    {"geometry"}, {"correspondence"}, {"depth"}, {"gaussians"}, {"structure"},
    {"frames", "masks", "proxy"}, {"metres"}, {"tracking"}, {"mapping"}, {"global_ba"}, {"export", "upright"},
    {"evaluation"},
)  # fmt: skip
"""The folders of pipelines/, each above those that it may import; on one floor, those that need each other."""


def imported_packages(path: Path) -> set[str]:
    """Top-level packages and folders of this project that a file imports anywhere."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix("msgs_slam.").split(".")[0] for name in found}


def test_the_program_has_one_import_name() -> None:
    """The folders' bare names work where the repository is the working folder, and in no installed copy."""
    files = [p for room in (*FORBIDDEN, "tests", "docs") for p in (ROOT / room).rglob("*.py")]
    bare = re.compile(rf"^\s*(from|import) ({'|'.join(FORBIDDEN)})\b", re.MULTILINE)
    assert [str(p) for p in files if bare.search(p.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("room", FORBIDDEN)
def test_imports_go_one_way(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    wrong = {str(f.relative_to(ROOT)): imported_packages(f) & FORBIDDEN[room] for f in files}
    assert not {name: bad for name, bad in wrong.items() if bad}


def imported_folders(path: Path) -> set[str]:
    """Folders of pipelines/ that a file imports from anywhere."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{name}" for name in names]
        found |= {n.split(".")[2] for n in names if n.startswith("msgs_slam.pipelines.")}
    return found


def test_every_folder_stands_on_one_floor() -> None:
    folders = {p.parent.name for p in (ROOT / "pipelines").glob("*/__init__.py")}
    assert sorted(name for floor in FLOORS for name in floor) == sorted(folders)


@pytest.mark.parametrize("height", range(len(FLOORS)), ids=lambda h: "+".join(sorted(FLOORS[h])))
def test_no_folder_imports_one_above_it(height: int) -> None:
    above = set().union(*FLOORS[height + 1 :])
    files = [f for folder in FLOORS[height] for f in sorted((ROOT / "pipelines" / folder).rglob("*.py"))]
    wrong = {str(f.relative_to(ROOT)): imported_folders(f) & above for f in files}
    assert not {name: bad for name, bad in wrong.items() if bad}


def test_tests_and_benchmarks_import_what_there_is() -> None:
    """Benchmarks are not run here, and import inside functions: what has moved would show only at their users'."""
    missing = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("msgs_slam.", "tests.")):
                base = ROOT.joinpath(*node.module.removeprefix("msgs_slam.").split("."))
                if not base.with_suffix(".py").is_file() and not base.is_dir():
                    missing.append(f"{path.relative_to(ROOT)}: {node.module}")
    assert not missing


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
UNSAFE_BUT_HERE = {"pipelines/memory.py": {"ctypes"}}
"""It calls one function of the C library that runs anyway, with a number: nothing from outside reaches it."""
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
    "msgs_slam.pipelines.run_folder_names",
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
    assert len(lines) <= 420, f"{len(lines)} lines: split it by noun"
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.FunctionDef):
            # A compiled kernel is one nest of loops: what it calls would have to be compiled and inlined with it.
            most = 110 if any(ast.unparse(d) == "kernel" for d in node.decorator_list) else 80
            length = (node.end_lineno or 0) - node.lineno
            assert length < most, f"{node.name} is {length} lines"
