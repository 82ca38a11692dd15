"""Output of a command: logs, progress, tables, its result and how it ends, as text or as JSON lines.

`--log-format json`: events of a run as one JSON object a line on stderr, for programs that watch; libraries may print
text there too. Each has `event` and `time` (seconds since 1970): stage, progress, warning, log, stopping, and one of
result, stopped, error at the end.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ..pipelines.system.progress import (
    BEGUN,
    ENDED,
    UP_TO_DATE,
    LineProgress,
    Progress,
    SilentProgress,
    StageEvent,
    is_asked,
    let_libraries_take_signals,
    log,
    soft_stop,
)  # fmt: skip
from ..pipelines.system.wording import quoted

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")
_BAR = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
_WIDTH = 44
"""Of what is before the bar."""
_STOPPING = (
    "Stopping at the next snapshot. Press Ctrl-C again to stop now (what was done since the last snapshot is lost)."
)
_shown: set[str] = set()
"""The warnings shown since logging was set up."""
_SECONDS_BETWEEN = 0.2
_stage: dict[str, Any] = {}
"""The stage that runs."""


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
        handler.addFilter(DuplicateFilter())
        logging.basicConfig(level=level, handlers=[handler], force=True)

    def progress(self, job: str = "") -> Progress:
        """Bars on a terminal, a line a stage in a file or pipe, JSON lines, or nothing; of a `job` among others."""
        if self.quiet:
            return SilentProgress()
        if self.as_json:
            return JsonProgress(job)
        return BarProgress() if sys.stderr.isatty() else LineProgress(job)

    def task_progress(self, name: str) -> Progress:
        """Set logging up anew for a named task of many; returns its progress, lines rather than bars."""
        self.set_up_logging()
        if not self.quiet and not self.as_json:
            return LineProgress(name)
        log.info("%s: begins", name)
        return self.progress(name)

    def report(self, text: str) -> None:
        """Print a line on stderr, or log it as JSON, while the user waits."""
        if self.as_json and not self.quiet:
            write_line("log", level="info", message=text)
        elif not self.quiet:
            say(text, err=True)

    def report_result(self, exit_code: int = 0, /, **paths: Path | list[Path]) -> None:
        """Write the last event of a command that came to its end, for programs: where its results are."""
        if self.as_json and not self.quiet:
            texts = {k: [str(p) for p in v] if isinstance(v, list) else str(v) for k, v in paths.items()}
            write_line("result", **texts, exit_code=exit_code)

    @contextmanager
    def stopping_softly(self, how_to_go_on: str) -> Iterator[None]:
        """End the work in this block at its next snapshot on the first SIGINT, SIGTERM or SIGHUP, at once on the
        second; then the process ends with 128 plus the signal's number, as shells expect. Says `how_to_go_on`, and
        nothing where that is empty: the process that started this one does."""
        try:
            with soft_stop(self._report_stopping if how_to_go_on else lambda number: None):
                yield
        except KeyboardInterrupt as error:
            number = getattr(error, "number", signal.SIGINT)
            if how_to_go_on and self.as_json:
                write_line("stopped", signal=int(number), message=how_to_go_on, exit_code=128 + number)
            elif how_to_go_on:
                say(f"\nStopped. {how_to_go_on}", err=True)
            sys.exit(128 + number)

    def _report_stopping(self, number: int) -> None:
        if self.as_json:
            write_line("stopping", signal=number, message=_STOPPING)
        else:  # not through click: a signal may come while it prints
            os.write(2, f"\n{_STOPPING}\n".encode())


class DuplicateFilter(logging.Filter):
    """Shows a warning once, however often it comes."""

    def __init__(self) -> None:
        super().__init__()
        _shown.clear()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is news."""
        text = record.getMessage()
        is_news = record.levelno != logging.WARNING or text not in _shown
        if record.levelno == logging.WARNING:
            _shown.add(text)
        return is_news


def was_shown(warning: str) -> bool:
    """Whether it has been shown already."""
    return warning in _shown


@contextmanager
def on_sigterm(handler: Any) -> Iterator[None]:
    """Handle SIGTERM (docker stop, systemd) otherwise inside this block. SIG_DFL ends the process at once, without a
    library's stack trace; `signal.default_int_handler` raises KeyboardInterrupt, as Ctrl-C does."""
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
    is_elsewhere = own.stem == "msgs-slam" and own.exists() and (found is None or not own.samefile(found))
    return quoted(own) if is_elsewhere else "msgs-slam"


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


class BarProgress:
    """Bars with the stage, counts, the time left of each and, at its end, of the whole job."""

    def __init__(self) -> None:
        self._event: StageEvent | None = None

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and show how many are done. A bar that ends early is full, for nothing is left to do, but for
        one that a signal ends."""
        from tqdm import tqdm

        title = f"{self._event.title} " if self._event else ""
        with tqdm(total=total, desc=f"{title}{label}".ljust(_WIDTH), mininterval=0.2, dynamic_ncols=True,
                  bar_format=_BAR) as bar:  # fmt: skip
            try:
                for item in items:
                    yield item
                    self._show_left(bar)
                    bar.update()
            finally:
                if not is_asked():
                    bar.total = bar.n
                bar.refresh()

    def _show_left(self, bar: tqdm) -> None:
        if self._event is not None:
            bar.set_postfix_str(self._event.left_text.removeprefix("; ").replace("left", "to the end"), refresh=False)

    def stage(self, event: StageEvent) -> None:
        """Say which stage begins, and how long one that has ended took."""
        from tqdm import tqdm

        self._event = event if event.state == BEGUN else None
        if event.state == ENDED:
            tqdm.write(f"{event.title} done in {event.seconds:.0f} s{event.left_text}", file=sys.stderr)
        elif event.state == UP_TO_DATE:
            tqdm.write(f"{event.title} up to date", file=sys.stderr)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]], width: int = 0) -> str:
    """Left-aligned columns under a rule; the last one is wrapped to a table of `width` characters, 0 = as it is."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    before = sum(widths[:-1]) + 2 * (len(widths) - 1)
    if width:
        widths[-1] = min(widths[-1], max(width - before, 20))
    lines = []
    for row in [header, *rows]:
        start = "".join(cell.ljust(w + 2) for cell, w in zip(row[:-1], widths[:-1], strict=True))
        last = textwrap.wrap(row[-1], widths[-1]) if width else [row[-1]]
        lines += [(start + (last[0] if last else "")).rstrip(), *(" " * before + more for more in last[1:])]
    return "\n".join([lines[0], "  ".join("-" * w for w in widths), *lines[1:]])


def terminal_width() -> int:
    """Characters a line of the terminal, 0 where the output goes into a file or pipe."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 0


class Interrupted(click.ClickException):
    """A command that keeps nothing of what it was at was stopped."""

    exit_code = 128 + signal.SIGINT


def write_line(event: str, **values: Any) -> None:
    """{"event": ..., "time": seconds since 1970, ...}, in one piece whatever else is written."""
    sys.stderr.write(json.dumps({"event": event, "time": round(time.time(), 3), **values}) + "\n")
    sys.stderr.flush()


class JsonProgress:
    """{"event": "stage", "name", "index", "of", "state", ...} and {"event": "progress", "label", "done", "total"}, of
    these at most five a second and one at each end; with {"job"} where it is one of several."""

    def __init__(self, job: str = "") -> None:
        self._job = {"job": job} if job else {}

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items, and write a progress line every so often."""
        done, said = 0, 0.0
        self._report(label, 0, total)
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - said > _SECONDS_BETWEEN:
                said = time.monotonic()
                self._report(label, done, total)
        self._report(label, done, total, ended=True)

    def _report(self, label: str, done: int, total: int | None, **more: Any) -> None:
        write_line("progress", **self._job, **_stage, label=label, done=done, total=total, **more)

    def stage(self, event: StageEvent) -> None:
        """Write a line for the start or the end of a stage."""
        _stage.clear()
        if event.state == BEGUN:
            _stage.update(stage=event.name, index=event.index, of=event.of)
        left = event.left()
        values: dict[str, Any] = {"name": event.name, "index": event.index, "of": event.of, "state": event.state}
        if event.seconds:
            values |= {"seconds": round(event.seconds, 2), "figures": event.figures}
        write_line("stage", **self._job, **values, seconds_left=None if left is None else round(left))


class JsonHandler(logging.Handler):
    """{"event": "warning", "message"}, or {"event": "log", "level", "message"}."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record of the log as one line."""
        if record.levelno == logging.WARNING:
            write_line("warning", **_stage, message=record.getMessage())
        else:
            write_line("log", level=record.levelname.lower(), message=record.getMessage())


def is_asked_for(arguments: Iterable[str]) -> bool:
    """Whether a command line asks for JSON lines; seen before it is parsed, for errors in it are reported so."""
    words = list(arguments)
    given = [b for a, b in pairwise(words) if a == "--log-format"]
    given += [w.partition("=")[2] for w in words if w.startswith("--log-format=")]
    return given[-1:] == ["json"]


@contextmanager
def json_outcome() -> Iterator[None]:
    """Report how the command in this block ends as a JSON line. Always ends with SystemExit."""
    code = 0
    try:
        yield
    except click.exceptions.Exit as ended:
        code = ended.exit_code
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    except (click.Abort, KeyboardInterrupt, Interrupted) as error:
        code = Interrupted.exit_code
        write_line("stopped", signal=int(signal.SIGINT), message=str(error), exit_code=code)
    except click.ClickException as error:
        code = error.exit_code
        write_line("error", message=error.format_message(), exit_code=code)
    except Exception as error:
        code = 1
        trace = "".join(traceback.format_exception(error))
        write_line("error", message=f"{type(error).__name__}: {error}", exit_code=code, traceback=trace)
    sys.exit(code)
