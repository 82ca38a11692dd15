"""Output of a command: logs, progress, its result and how it ends, as text or as JSON lines."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .json_lines import JsonHandler, JsonProgress, write_line

if TYPE_CHECKING:
    from ..pipelines.system.progress import Progress

_STOPPING = (
    "Stopping at the next snapshot. Press Ctrl-C again to stop now (what was done since the last snapshot is lost)."
)
_said: set[str] = set()
"""The warnings shown since logging was set up."""


def verbosity_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add -q, -v and --log-format to a command, which is given an `output` instead; its logging is set up."""

    @wraps(command)
    def run(quiet: bool, verbose: bool, log_format: str, **others: Any) -> None:
        if quiet and verbose:
            raise click.UsageError("-q and -v exclude each other")
        output = Output(quiet, verbose, log_format == "json")
        output.set_up_logging()
        command(output=output, **others)

    with_format = click.option(
        "--log-format", type=click.Choice(["text", "json"]), default="text",
        help="json: progress, logs and errors on stderr as one JSON object a line.",
    )(run)  # fmt: skip
    with_verbose = click.option("-v", "--verbose", is_flag=True, help="Log what is decided and why.")(with_format)
    return click.option("-q", "--quiet", is_flag=True, help="Print errors only.")(with_verbose)


@dataclass(frozen=True)
class Output:
    """Amount and form of what a command prints: errors only, or what is decided and why, too; text or JSON lines."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False

    def set_up_logging(self) -> None:
        """Send logs to stderr: warnings, or everything, or errors only."""
        level = logging.ERROR if self.quiet else logging.INFO if self.verbose else logging.WARNING
        handler: logging.Handler = JsonHandler() if self.as_json else TextHandler()
        handler.addFilter(SaidOnce())
        logging.basicConfig(level=level, handlers=[handler], force=True)

    def progress(self, job: str = "") -> Progress:
        """Bars on a terminal, a line a stage in a file or pipe, JSON lines, or nothing; of a `job` among others."""
        from ..pipelines.system.progress import LineProgress, SilentProgress
        from .progress import BarProgress

        if self.quiet:
            return SilentProgress()
        if self.as_json:
            return JsonProgress(job)
        return BarProgress() if sys.stderr.isatty() else LineProgress(job)

    @property
    def options(self) -> tuple[str, ...]:
        """The options of a command by which a process started for this one prints the same."""
        more = ("-q",) if self.quiet else ("-v",) if self.verbose else ()
        return (*more, "--log-format", "json") if self.as_json else more

    def task_progress(self, name: str) -> Progress:
        """Set logging up anew for a named task of many; returns its progress, lines rather than bars."""
        from ..pipelines.system.progress import LineProgress, log

        self.set_up_logging()
        if not self.quiet and not self.as_json:
            return LineProgress(name)
        log.info("%s: begins", name)
        return self.progress(name)

    def tell(self, text: str) -> None:
        """Print a line on stderr, or log it as JSON, for people who wait."""
        if self.as_json and not self.quiet:
            write_line("log", level="info", message=text)
        elif not self.quiet:
            say(text, err=True)

    def tell_result(self, exit_code: int = 0, /, **paths: Path | list[Path]) -> None:
        """Write the last event of a command that came to its end, for programs: where its results are."""
        if self.as_json and not self.quiet:
            texts = {k: [str(p) for p in v] if isinstance(v, list) else str(v) for k, v in paths.items()}
            write_line("result", **texts, exit_code=exit_code)

    @contextmanager
    def stopping_softly(self, how_to_go_on: str) -> Iterator[None]:
        """End the work in this block at its next snapshot on the first SIGINT, SIGTERM or SIGHUP, at once on the
        second; then the process ends with 128 plus the signal's number, as shells expect. Says `how_to_go_on`, and
        nothing where that is empty: the process that started this one does."""
        from ..pipelines.system.stopping import soft_stop

        try:
            with soft_stop(self._tell_stopping if how_to_go_on else lambda number: None):
                yield
        except KeyboardInterrupt as error:
            number = getattr(error, "number", signal.SIGINT)
            if how_to_go_on and self.as_json:
                write_line("stopped", signal=int(number), message=how_to_go_on, exit_code=128 + number)
            elif how_to_go_on:
                say(f"\nStopped. {how_to_go_on}", err=True)
            sys.exit(128 + number)

    def _tell_stopping(self, number: int) -> None:
        if self.as_json:
            write_line("stopping", signal=number, message=_STOPPING)
        else:  # not through click: a signal may come while it prints
            os.write(2, f"\n{_STOPPING}\n".encode())


class SaidOnce(logging.Filter):
    """Shows a warning once, however often it comes."""

    def __init__(self) -> None:
        super().__init__()
        _said.clear()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is news."""
        text = record.getMessage()
        is_news = record.levelno != logging.WARNING or text not in _said
        if record.levelno == logging.WARNING:
            _said.add(text)
        return is_news


def is_said(warning: str) -> bool:
    """Whether it has been shown already."""
    return warning in _said


@contextmanager
def on_sigterm(handler: Any) -> Iterator[None]:
    """Handle SIGTERM (docker stop, systemd) otherwise inside this block. SIG_DFL ends the process at once, without a
    library's stack trace; `signal.default_int_handler` raises KeyboardInterrupt, as Ctrl-C does."""
    from ..pipelines.system.stopping import let_libraries_take_signals

    let_libraries_take_signals()
    before = signal.signal(signal.SIGTERM, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


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


def program() -> str:
    """Return the word that starts this program in the user's shell: its path where it is not on the PATH."""
    own, found = Path(sys.argv[0]), shutil.which("msgs-slam")
    is_elsewhere = own.name == "msgs-slam" and own.exists() and (found is None or not own.samefile(found))
    return shlex.quote(str(own)) if is_elsewhere else "msgs-slam"


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
