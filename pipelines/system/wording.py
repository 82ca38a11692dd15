"""Figures and numbers of frames in few words."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...formats.errors import shell_word

MAX_STRETCHES = 8


def quoted(path: Path | str) -> str:
    """A path as a word of a command that can be pasted into a shell."""
    return shell_word(str(path))


def stretches(ids: Iterable[int], limit: int = MAX_STRETCHES) -> str:
    """[1, 2, 3, 7] -> "1-3, 7"; after `limit` of them, how many more there are."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    texts = [f"{r[0]}-{r[-1]}" if len(r) > 1 else str(r[0]) for r in runs[:limit]]
    return ", ".join(texts) + (f" and {len(runs) - limit} more stretches" if len(runs) > limit else "")


def frames_text(ids: Sequence[int]) -> str:
    """[7] -> "frame 7"; [1, 2, 7] -> "frames 1-2, 7"."""
    return f"frame{'s' * (len(ids) != 1)} {stretches(ids)}"


def lost_text(lost: Mapping[str, str]) -> str:
    """Frame → why it is lost, as "12 (too few matches 3-9, 12-16)": all frames of one cause together."""
    causes: dict[str, list[int]] = {}
    for frame, cause in lost.items():
        causes.setdefault(str(cause), []).append(int(frame))
    listed = "; ".join(f"{cause} {stretches(ids)}" for cause, ids in causes.items())
    return f"{len(lost)} ({listed})" if lost else "none"


def figure_text(value: Any, key: str = "") -> str:
    """Short text of a figure of a stage; lost frames together by their cause."""
    if key == "lost" and isinstance(value, dict):
        return lost_text(value)
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, dict):
        return " ".join(f"{name} {figure_text(v)}" for name, v in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(figure_text(v) for v in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown."""
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return lines + ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
