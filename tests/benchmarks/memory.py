"""The memory that `status` expects of each stage, and plans with, beside what finished runs have needed at their peak.

    python tests/benchmarks/memory.py RUN.msgs RUN.msgs ...

A row for each stage of each run, by its manifest; then for each stage the median of needed over expected, and what
the first number of `NEEDS` (pipelines/system/memory.py) would be for a median of 1. Ends with 1 where a median is more
than a quarter off. Of a run that was resumed a stage's peak is that of another process: made in one go they count.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np

from msgs_slam.pipelines.run.folder import RunFolder, load_records, load_settings
from msgs_slam.pipelines.status import expected_mb
from msgs_slam.pipelines.system.memory import NEEDS

MOST_OFF = 0.25


def rows_of(run: RunFolder) -> list[tuple[str, float, float]]:
    """Stage, MB expected and MB needed of every finished stage."""
    config, records = load_settings(run), load_records(run)
    expected = {stage: expected_mb(stage, run, config) for stage in records if stage in NEEDS}
    return [(stage, mb, records[stage].peak_memory_mb) for stage, mb in expected.items() if mb is not None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    found: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for folder in parser.parse_args().runs:
        for stage, expected, needed in rows_of(RunFolder(folder)):
            print(f"{folder.name:30} {stage:10} expected {expected:6.0f}  needed {needed:6.0f}")
            found[stage].append((expected, needed))
    is_off = False
    for stage, pairs in found.items():
        expected, needed = np.array(pairs).T
        ratio, least = float(np.median(needed / expected)), NEEDS[stage][0] + float(np.median(needed - expected))
        is_off |= abs(ratio - 1) > MOST_OFF
        print(f"{'median of ' + str(len(pairs)):30} {stage:10} needed/expected {ratio:.2f}, least {least:.0f}")
    sys.exit(int(is_off))


if __name__ == "__main__":
    main()
