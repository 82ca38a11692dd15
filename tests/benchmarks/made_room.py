"""A made room as a data set with exact truth, for rooms that no constant was chosen on.

    python tests/benchmarks/made_room.py classroom DIR [--frames 100] [--laps 0.33]
    msgs-slam reconstruct DIR/rgb --out RUN.msgs && msgs-slam evaluate RUN.msgs --truth DIR

640x480, 10 frames a second, noise of 1.5 grey levels, a little motion blur. 100 frames take 4 CPU minutes.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.benchmarks.worlds import LAYOUTS
from tests.world import ClipOptions, make_world, write_sequence


def main() -> None:
    """Parse, render, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("layout", choices=sorted(LAYOUTS))
    parser.add_argument("target", type=Path, metavar="DIR")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--laps", type=float, default=0.33)
    given = parser.parse_args()
    options = ClipOptions(given.frames, 640, 480, laps=given.laps, noise=1.5, shutter=0.3)
    write_sequence(given.target, make_world(given.layout), options)


if __name__ == "__main__":
    main()
