"""Plain text tables of what a run did."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.records import StageRecord
    from pipelines.status import StageStatus


KEY_FIGURES = {
    "frames": ("frames", "keyframes_placed", "calibration", "focal_px", "focal_sd_px"),
    "proxy": ("depth", "semantics", "metric", "classes"),
    "tracking": ("posed", "keyframes", "lost", "scale", "scale_relative_sd"),
    "mapping": ("gaussians", "keyframe_psnr"),
    "global_ba": ("loops",),
    "export": ("images", "vertices", "faces", "up", "floor"),
}
"""What a person wants to know first; `status -v` says all."""


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Left-aligned columns under a rule."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [header, *rows]
    ]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def status_table(stages: Sequence[StageStatus], everything: bool = False) -> str:
    """One row a stage: state, seconds, peak memory, key figures or all of them."""
    rows = []
    for stage in stages:
        if (record := stage.record) is None:
            rows.append([stage.name, stage.state, "", "", ""])
            continue
        wanted = record.figures if everything else [k for k in KEY_FIGURES[stage.name] if k in record.figures]
        figures = ", ".join(f"{key} {format_figure(record.figures[key])}" for key in wanted)
        rows.append([stage.name, stage.state, f"{record.seconds:.1f}", f"{record.peak_memory_mb:.0f}", figures])
    return format_table(["stage", "state", "seconds", "peak MB", "figures"], rows)


def format_figure(value: Any) -> str:
    """Short text of a figure."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, dict):
        return " ".join(f"{key} {format_figure(v)}" for key, v in value.items()) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def warning_lines(records: dict[str, StageRecord]) -> list[str]:
    """Every degraded result, by stage."""
    return [f"warning ({name}): {text}" for name, record in records.items() for text in record.warnings]
