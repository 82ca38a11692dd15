"""`msgs-slam doctor`: what is installed, and what to do about what is not."""

import sys
from pathlib import Path

import click

from .text import say


@click.command()
def doctor() -> None:
    """Say what this machine has for the program, a line each, with the fix where something is missing.

    Exit code 1 where something would keep a reconstruction from running.
    """
    from ..pipelines.doctor import BAD, examine

    findings = examine(Path("."))
    width = max(len(f.name) for f in findings)
    for f in findings:
        say(f"{f.state:4}  {f.name:{width}}  {f.text}")
        if f.fix:
            say(f"{'':4}  {'':{width}}  fix: {f.fix}")
    if any(f.state == BAD for f in findings):
        sys.exit(1)
