"""Rows of figures, written to one JSON file as they come: what ends a part early loses none of those before."""

import json
import statistics
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch


class Rows:
    """Lists of rows by name, in OUT/card.json."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "card.json"

    def read(self) -> dict[str, list[dict[str, Any]]]:
        """All rows that there are."""
        return dict(json.loads(self.path.read_text())) if self.path.exists() else {}

    def add(self, name: str, **row: Any) -> None:
        """One more row, written at once."""
        rows = self.read()
        rows.setdefault(name, []).append(row)
        whole = self.path.with_suffix(".partial")
        whole.write_text(json.dumps(rows, indent=1, default=str) + "\n")
        whole.replace(self.path)

    @contextmanager
    def attempt(self, case: str) -> Iterator[None]:
        """Within: an exception becomes a row of failures, and what comes after goes on."""
        try:
            yield
        except Exception:
            print(text := traceback.format_exc(), flush=True)
            self.add("failures", case=case, error=text[-1500:])


def wait(device: str) -> None:
    """Until the card has done all that it was asked for."""
    if device == "cuda":
        torch.cuda.synchronize()


def milliseconds(task: Callable[[], object], device: str, repeats: int, warm: int = 2) -> float:
    """Median time of a task by the clock, the card's work included."""
    times = []
    for _ in range(warm + repeats):
        wait(device)
        start = time.perf_counter()
        task()
        wait(device)
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[warm:])


def first_seconds(task: Callable[[], object], device: str) -> float:
    """Seconds of the first call, which compiles what no earlier process has left in a cache."""
    start = time.perf_counter()
    task()
    wait(device)
    return time.perf_counter() - start
