"""Numbers of frames in few words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

MOST_STRETCHES = 8


def stretches(ids: Iterable[int], most: int = MOST_STRETCHES) -> str:
    """[1, 2, 3, 7] -> "1-3, 7"; after `most` of them, how many more there are."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    texts = [f"{r[0]}-{r[-1]}" if len(r) > 1 else str(r[0]) for r in runs[:most]]
    return ", ".join(texts) + (f" and {len(runs) - most} more stretches" if len(runs) > most else "")


def lost_text(lost: Mapping[str, str]) -> str:
    """Frame → why it is lost, as "12 (too few matches 3-9, 12-16)": all frames of one cause together."""
    causes: dict[str, list[int]] = {}
    for frame, cause in lost.items():
        causes.setdefault(str(cause), []).append(int(frame))
    listed = "; ".join(f"{cause} {stretches(ids)}" for cause, ids in causes.items())
    return f"{len(lost)} ({listed})" if lost else "none"
