"""Words that readers of English, or of the field, stumble over: they may not come back into what a user reads."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest

from msgs_slam.msgs_cli.main import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

BANNED = {
    r"leaves? (it|--\w+) away": "omit, turn off",
    r"(nothing|which nothing) joins": "disconnected component",
    r"how (it|they) lies? to": "the transform from … to",
    r"what .{1,20} earns|earned nothing": "contributes, made no measurable difference",
    r"\bto mend\b|\bmends\b": "fix",
    r"\barticle('s)?\b": "paper",
    r"as \w+ left it": "after …",
    r"after a stop\b": "resume an interrupted run",
    r"\b(is|are|an?) guess(es|ed)?\b": "estimate",
    r"says? of itself": "metadata",
    r"\bwithout a line\b": "without internet access",
    r"is no part of the scene": "mask, ignored",
    r"\bstand-ins?\b": "say what was used instead",
    r"\bpromises\b": "declares",
    r"once more: at once": "press Ctrl-C again to stop now",
    r"\bpictures?\b": "image",
    r"by its name: expected": "unsupported extension",
    r"\bplain (monocular )?video in\b": "turn an ordinary video into",
    r"Nothing is rescaled": "coordinates are not rescaled",
    r"of what is mapped": "map extent",
    r"[Tt]ype:? `?msgs-slam": "run `msgs-slam`",
    r"\bunsure\b": "uncertain",
    r"[\d…] %(?![(\w])": "28%",
    r"\bgoes on (where|with)|\bgo on where": "continues, resumes",
    r"to look at and to send": "easy to share",
    r"hardly an? (frame|image)": "almost no",
}
"""Regular expression → what to write instead."""

MAY_STAY = ("corners or pictures in view", "picture painting poster")
"""Pictures on a wall."""


def prose(page: Path) -> str:
    """A page without code, links' targets and names of files."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.sub(r"`[^`\n]*`|\]\([^)]*\)|<!--.*?-->", "", text)


def texts_of_code() -> Iterator[tuple[str, str]]:
    """(where, text) of messages and labels: what is no docstring and has a space."""
    for room in ("msgs_cli", "pipelines", "formats"):
        for path in sorted((ROOT / room).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            silent = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
            silent |= {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in n.values}
            for node in ast.walk(tree):
                if id(node) in silent:
                    continue
                if isinstance(node, ast.JoinedStr):
                    text = "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    text = node.value
                else:
                    continue
                if " " in text:
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", text


def texts_of_help(command: click.Command, name: str) -> Iterator[tuple[str, str]]:
    yield name, command.help or ""
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            yield f"{name} {parameter.opts[0]}", f"{parameter.metavar or ''} {parameter.help or ''}"
    for below in command.commands.values() if isinstance(command, click.Group) else ():
        yield from texts_of_help(below, f"{name} {below.name}")


def test_every_command_shows_an_example() -> None:
    commands = [(name, text) for name, text in texts_of_help(main, "msgs-slam") if " -" not in name]
    groups = {"msgs-slam", "msgs-slam models"}
    assert len(commands) > 15
    assert [name for name, text in commands if name not in groups and f"Example: {name}" not in text] == []


def texts_of_pages() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        yield str(page.relative_to(ROOT)), prose(page)
    for path in sorted((ROOT / "pipelines" / "export" / "page").iterdir()):
        if path.suffix != ".css":
            yield str(path.relative_to(ROOT)), "\n".join(re.findall(r">[^<>{}]+<|\"[^\"]* [^\"]*\"", path.read_text()))


@cache
def every_text() -> list[tuple[str, str]]:
    return [*texts_of_code(), *texts_of_help(main, "msgs-slam"), *texts_of_pages()]


@pytest.mark.parametrize("banned", BANNED)
def test_words_that_may_not_come_back(banned: str) -> None:
    assert len(every_text()) > 800
    found = [
        f"{where}: …{text[max(0, m.start() - 40) : m.end() + 30]!r}"
        for where, text in every_text()
        for m in re.finditer(banned, text, re.IGNORECASE)
        if not any(stay in text for stay in MAY_STAY)
    ]
    assert found == [], f"better: {BANNED[banned]}"


NO_PATHS = {
    "model.name",
    "name",
    "text",
    "EXTRACTOR",
    "model.family",
    "source",
    "kind",
    "export.kind",
    "s.name",
    "first",
}
"""Names of networks and words of the program's own."""


def unquoted_in_commands(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, expression) of what stands in a command that a message suggests and is not quoted for the shell."""
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.JoinedStr)):
        before = ""
        for value in node.values:
            if isinstance(value, ast.Constant):
                before += str(value.value)
                continue
            assert isinstance(value, ast.FormattedValue)
            is_in_command = re.search(r"msgs-slam [a-z]+ [^`\n]*$", before) and not re.search(r"\. [^`]*$", before)
            shown = ast.unparse(value.value)
            if is_in_command and shown not in NO_PATHS and "quoted(" not in shown:
                yield node.lineno, shown
            before += "…"


def test_paths_in_suggested_commands_are_quoted() -> None:
    """A command with the name "my room.msgs" in it can be pasted."""
    wrong = ast.parse('f"{a} is bad. Run `msgs-slam resume {run.root}`, not {b}"')
    assert list(unquoted_in_commands(wrong)) == [(1, "run.root")]
    found = [
        f"{path.relative_to(ROOT)}:{line} {shown}"
        for room in ("msgs_cli", "pipelines", "formats")
        for path in sorted((ROOT / room).rglob("*.py"))
        for line, shown in unquoted_in_commands(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert found == []


NOT_IN_NAMES = {"told", "looks", "looking", "picked", "alone", "beside", "nobody", "who"}


def test_names_are_in_the_terms_of_the_field() -> None:
    """Words of prose say nothing in the name of a function, class, argument or variable; one name for one thing."""
    own_name: dict[str, list[str]] = {}
    odd = []
    for path in (p for room in ("msgs_cli", "pipelines", "formats") for p in sorted((ROOT / room).rglob("*.py"))):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                own_name.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
        stored = (n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store))
        defined = (n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.ClassDef))
        given = (n.arg for n in ast.walk(tree) if isinstance(n, ast.arg))
        for name in {path.stem, *stored, *defined, *given}:
            if NOT_IN_NAMES & set(re.sub("([A-Z])", r"_\1", name).lower().split("_")):
                odd.append(f"{path.relative_to(ROOT)}: {name}")
    twice = {name: where for name, where in own_name.items() if len(where) > 1 and name not in TWINS}
    assert (odd, twice) == ([], {})


TWINS = {
    "class_weights", "composite", "depth_ratio", "inspect", "list_tiles", "match_planes", "fuse_depths", "project",
    "render_all",  # the same step by numba and by Triton, or of one image and by a backend
    "render",  # the command and the function that a program calls
    "run",  # of every stage
}  # fmt: skip
