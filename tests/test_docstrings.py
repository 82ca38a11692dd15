"""Public docstrings begin with a verb (functions) or say what the thing is (classes, properties, modules)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEFERRING = re.compile(r"(Of|What|As|How|Where|That|Those|In|From|The same)\b")
"""Words that begin a clause without its subject: a reader of `help()` has nothing to hang it on."""
LEAST_WORDS = 4
LEFT = 13
"""Such docstrings still in the code. Lower it when some are rewritten; it may not rise."""


def public_docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, docstring) of a module, and of its classes and functions that are reached by public names alone."""

    def below(body: list[ast.stmt]) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name[0] != "_":
                yield node
                yield from below(node.body) if isinstance(node, ast.ClassDef) else ()

    for node in (tree, *below(tree.body)):
        if text := ast.get_docstring(node):
            yield getattr(node, "lineno", 1), text


def says_nothing(text: str) -> bool:
    return bool(DEFERRING.match(text)) or len(text.split()) < LEAST_WORDS


def test_docstrings_that_lack_a_subject_can_only_become_fewer() -> None:
    found, seen = [], 0
    for room in ("formats", "pipelines", "msgs_cli"):
        for path in sorted((ROOT / room).rglob("*.py")):
            for line, text in public_docstrings(ast.parse(path.read_text(encoding="utf-8"))):
                seen += 1
                if says_nothing(text):
                    found.append(f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}")
    assert seen > 1500
    assert len(found) <= LEFT, "begin with a verb, or say what the thing is:\n" + "\n".join(found)


def test_what_counts_as_a_docstring_without_a_subject() -> None:
    assert all(
        map(says_nothing, ("Of two images.", "What `save` has written, if anything.", "Some windows.", "As `find`."))
    )
    assert not any(
        map(says_nothing, ("Return the mean of two images.", "Offsets of the rows, (R,).", "Inner node of a tree."))
    )


NAMED = re.compile(r"`+(?:msgs_slam\.)?((?:pipelines|formats|msgs_cli)(?:\.[a-z_0-9]+)+)")


def exists(dotted: str) -> bool:
    """Whether a dotted name is of a module or folder, or of something that one mentions."""
    path = ROOT.joinpath(*dotted.split("."))
    if path.is_dir() or path.with_suffix(".py").is_file():
        return True
    above = path.parent
    file = above.with_suffix(".py") if above.with_suffix(".py").is_file() else above / "__init__.py"
    return file.is_file() and re.search(rf"\b{path.name}\b", file.read_text(encoding="utf-8")) is not None


def test_modules_that_code_names_are_there() -> None:
    assert exists("pipelines.sfm.rolling")
    assert exists("pipelines.system.jit.kernel")
    assert not exists("pipelines.structure.rolling")
    found = {
        (str(path.relative_to(ROOT)), name)
        for room in ("formats", "pipelines", "msgs_cli", "msgs_slam")
        for path in (ROOT / room).glob("**/*.py")
        for name in NAMED.findall(path.read_text(encoding="utf-8"))
    }
    assert len(found) > 5
    assert {f"{path}: {name}" for path, name in found if not exists(name)} == set()
