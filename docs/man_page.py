"""Writes msgs-slam.1, the man page of the program, from what its commands say of themselves: python docs/man_page.py"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import click

from msgs_slam.msgs_cli.main import main

PAGE = Path(__file__).with_name("msgs-slam.1")


def man_page() -> str:
    """The page as roff: a section for the program, one for each command."""
    summary, _, rest = (main.help or "").partition("\n\n")
    lines = ['.TH MSGS\\-SLAM 1 "" "" "User Commands"', ".SH NAME", f"msgs\\-slam \\- {roff(summary.rstrip('.'))}"]
    lines += [".SH SYNOPSIS", ".B msgs\\-slam", "\\fICOMMAND\\fR [\\fIOPTIONS\\fR] [\\fIARGUMENTS\\fR]"]
    lines += [".SH DESCRIPTION", *paragraphs(rest), *options(main), *commands(main, "msgs-slam")]
    lines += [
        ".SH EXIT STATUS",
        "0 if all went well, 1 for an input that cannot be used, 2 for a wrong option or setting,",
    ]
    return "\n".join([*lines, "130 after Ctrl\\-C. To resume an interrupted run:", '.BR "msgs\\-slam resume" .']) + "\n"


def commands(group: click.Group, name: str) -> Iterator[str]:
    """A section for each command, and for those below it."""
    for key in group.list_commands(context_of(group)):
        command = group.commands[key]
        usage = " ".join(command.collect_usage_pieces(context_of(command)))
        yield f".SH {roff(f'{name} {key}'.upper())}"
        yield from [
            f".B {roff(f'{name} {key}')}",
            roff(usage),
            *paragraphs(command.help or ""),
            *options(command),
        ]
        if isinstance(command, click.Group):
            yield from commands(command, f"{name} {key}")


def options(command: click.Command) -> Iterator[str]:
    """An entry for each option."""
    for parameter in command.get_params(context_of(command)):
        record = parameter.get_help_record(context_of(command))
        if record and record[1]:
            yield from [".TP", f".B {roff(record[0])}", roff(record[1])]


def context_of(command: click.Command) -> click.Context:
    """A context as on the command line: `-h` is another name of `--help`, of every command."""
    return click.Context(command, **main.context_settings)


def paragraphs(text: str) -> Iterator[str]:
    """Lines of a help text; those after \\b stay as they are."""
    for part in re.split(r"\n\s*\n", text.strip()):
        kept = part.startswith("\b")
        lines = [line.strip() for line in part.strip("\b\n ").splitlines()]
        yield from [".PP", *([".nf"] if kept else []), *map(roff, lines), *([".fi"] if kept else [])]


def roff(text: str) -> str:
    """A line with nothing in it that roff would take for its own."""
    escaped = " ".join(text.splitlines()).replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{escaped}" if escaped[:1] in (".", "'") else escaped


if __name__ == "__main__":
    PAGE.write_text(man_page(), encoding="utf-8")
