"""Plain text tables of a run, and the last words of a command that has brought one to its end."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..pipelines.system.wording import figure_text
from .output import Output, is_said, say

if TYPE_CHECKING:
    from ..pipelines.run.manifest import StageRecord
    from ..pipelines.status import StageStatus


KEY_FIGURES = {
    "frames": ("frames", "keyframes_placed", "calibration", "focal_px", "focal_sd_px", "gps"),
    "proxy": ("depth", "semantics", "metric", "metres_per_unit", "classes"),
    "tracking": ("posed", "keyframes", "lost", "scale"),
    "mapping": ("gaussians", "keyframe_psnr"),
    "global_ba": ("loops", "images_posed", "keyframe_psnr"),
    "export": ("images", "vertices", "faces", "up", "floor", "gps"),
}
"""What a person wants to know first; `status -v` says all."""


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


def status_table(stages: Sequence[StageStatus], everything: bool = False) -> str:
    """One row a stage: state, seconds, peak memory, key figures or all of them."""
    rows = []
    for stage in stages:
        expected = "" if stage.expected_mb is None else f"{stage.expected_mb:.0f}"
        if (record := stage.record) is None:
            rows.append([stage.name, stage.state_text, "", "", expected, ""])
            continue
        wanted = record.figures if everything else [k for k in KEY_FIGURES[stage.name] if k in record.figures]
        figures = ", ".join(f"{key} {figure_text(record.figures[key], key)}" for key in wanted)
        rows.append(
            [stage.name, stage.state, f"{record.seconds:.1f}", f"{record.peak_memory_mb:.0f}", expected, figures]
        )
    header = ["stage", "state", "seconds", "peak MB", "expected MB", "figures"]
    shown = [n for n in range(len(header)) if n != 4 or (everything and any(row[n] for row in rows))]
    return format_table([header[n] for n in shown], [[row[n] for n in shown] for row in rows], terminal_width())


def scale_lines(root: Path, records: dict[str, StageRecord]) -> list[str]:
    """Return the line about the scale of the world; none before the export has estimated it."""
    from ..pipelines.run.files import METRES
    from ..pipelines.run.folder import RunFolder

    metres = RunFolder(root).find(METRES) if "export" in records else None
    return [] if metres is None else [f"\nScale: {metres.text}"]


def warning_lines(records: dict[str, StageRecord], is_said: Callable[[str], bool] = lambda text: False) -> list[str]:
    """Every degraded result, by stage, that is not said yet."""
    return [f"warning ({n}): {text}" for n, record in records.items() for text in record.warnings if not is_said(text)]


def tell_run(output: Output, root: Path, records: dict[str, Any]) -> None:
    """Say how the run is now, for people unless they want errors only, and for programs."""
    if not output.quiet:
        print_summary(root, records)
    output.tell_result(run=root, **({"export": root / "export"} if "export" in records else {}))


def print_summary(root: Path, records: dict[str, Any]) -> None:
    """Print the table, what is not said yet, and where the results are."""
    from ..pipelines.reconstruct import all_stages
    from ..pipelines.run.folder import RunFolder
    from ..pipelines.status import DONE, StageStatus, about_new_networks

    pass

    say(status_table([StageStatus(name, DONE, record) for name, record in records.items()]))
    for line in warning_lines(records, is_said):
        say(line, err=True)
    for line in scale_lines(root, records):
        say(line)
    if line := about_new_networks(RunFolder(root), all_stages):
        say(f"\n{line}")
    if "export" in records:
        say(f"\nResults: {root / 'export'} (README.txt there says what each file is for)")
        if (page := root / "export" / "map.html").exists():
            say(f"Open in a browser: {page}")
