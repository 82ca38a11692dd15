"""Text for the terminal: control characters are escaped, and nothing is dropped silently."""

import logging
import os
import sys
from typing import Any

import click


def printable(text: str) -> str:
    """The text with control characters and lone surrogates, as names of files may hold them, written out as \\x1b."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def say(text: Any = "", err: bool = False) -> None:
    """Print one line, made safe for the terminal."""
    click.echo(printable(str(text)), err=err)


class TextHandler(logging.Handler):
    """Logs on stderr, above a bar where one is shown, without what a terminal would obey."""

    def emit(self, record: logging.LogRecord) -> None:
        """One line, and the traceback where there is one."""
        text = printable(logging.Formatter("%(levelname)s: %(message)s").format(record))
        if sys.stderr.isatty():
            from tqdm import tqdm

            tqdm.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)


def prepare_streams() -> None:
    """Files and pipes get UTF-8 whatever the system's code page says; a terminal shows "?" for what it lacks."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            if stream.isatty():
                stream.reconfigure(errors="replace")
            else:
                stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def flush_output() -> None:
    """Raises OSError where what was printed could not be written (a full disk behind `>`)."""
    try:
        sys.stdout.flush()
    except OSError:
        # Python tries again when it ends, and would complain a second time.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise
