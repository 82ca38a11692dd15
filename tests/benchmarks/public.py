"""Poses on public recordings beside COLMAP's two mappers, run on the same frames, and published figures: one page.

    python tests/benchmarks/public.py                  docs/public.md anew from public.json
    python tests/benchmarks/public.py --measure        run the recordings at hand first, and keep their figures there

What is run is what `focal.py` runs: structure from motion of the images alone, nothing known of the camera, and
COLMAP's mappers on the same features and verified pairs. Published figures are those of whole sequences, copied from
the tables that are named.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from msgs_slam.pipelines.system.wording import markdown_table

KEPT, PAGE = Path(__file__).with_suffix(".json"), ROOT / "docs" / "public.md"
MAST3R, VGGT = (
    "[arXiv:2412.12392](https://arxiv.org/abs/2412.12392)",
    "[arXiv:2505.12549](https://arxiv.org/abs/2505.12549)",
)
FORMER = "[arXiv:2509.16909](https://arxiv.org/abs/2509.16909), table 3"
DASH = "the benchmark tables of DASH-SLAM's repository, after Sim(3)"
GIVEN, FOUND = "given", "unknown"


class Published(NamedTuple):
    """A figure from a table of somebody's: ATE RMSE in metres as printed."""

    program: str
    camera: str
    ate: float
    source: str


class DataSet(NamedTuple):
    """A recording: its name in `focal.py`, what of the sequence is run here, and what others report of the whole."""

    title: str
    name: str
    here: str
    published: tuple[Published, ...]
    own: tuple[tuple[str, str, float], ...] = ()
    """Of `tracking.py --colmap`, where COLMAP has its own features and sequential pairs: ATE in centimetres."""


DATA_SETS = (
    DataSet(
        "Replica, office 0", "replica",
        "81 images, every tenth of the first 801, at half size (600x340)",
        (
            Published("DROID-SLAM", GIVEN, 0.003, FORMER),
            Published("MASt3R-SLAM", FOUND, 0.0320, DASH),
            Published("VGGT-SLAM", FOUND, 0.042, FORMER),
            Published("DASH-SLAM", FOUND, 0.0093, DASH),
        ),
    ),
    DataSet(
        "TUM RGB-D, freiburg1_rpy", "fr1_rpy",
        "200 of its 723 images, 160 to 359; the camera hardly moves",
        (
            Published("DROID-SLAM", GIVEN, 0.026, f"{MAST3R}, table 1"),
            Published("DROID-SLAM", FOUND, 0.056, f"{MAST3R}, table 1"),
            Published("MASt3R-SLAM", GIVEN, 0.027, f"{MAST3R}, table 1"),
            Published("MASt3R-SLAM", FOUND, 0.041, f"{MAST3R}, table 1"),
            Published("VGGT-SLAM", FOUND, 0.030, f"{VGGT}, table 2"),
            Published("DASH-SLAM", FOUND, 0.0201, DASH),
        ),
        (
            ("MSGS-SLAM, all picked", "67 of 67 images", 1.16),
            ("COLMAP, incremental, own features", "the same 67 images", 2.05),
        ),
    ),
    DataSet(
        "7-Scenes, red kitchen", "kitchen",
        "the first 300 images of one sequence, as a video; its ground truth is good to one or two centimetres",
        (
            Published("DROID-SLAM", GIVEN, 0.040, f"{VGGT}, table 1"),
            Published("DROID-SLAM", FOUND, 0.080, f"{VGGT}, table 1"),
            Published("MASt3R-SLAM", GIVEN, 0.041, f"{VGGT}, table 1"),
            Published("MASt3R-SLAM", FOUND, 0.074, f"{VGGT}, table 1"),
            Published("VGGT-SLAM", FOUND, 0.058, f"{VGGT}, table 1"),
            Published("DASH-SLAM", FOUND, 0.0408, DASH),
        ),
        (
            ("MSGS-SLAM, every second image", "150 of 150 images", 3.38),
            ("COLMAP, global, own features", "the same 150 images", 3.68),
            ("COLMAP, incremental, own features", "the same 150 images", 3.74),
        ),
    ),
)  # fmt: skip
_HEAD = """\
# Poses on public recordings

Made by `python tests/benchmarks/public.py`. ATE: root mean square distance of the camera centres from the ground truth
after one Sim(3) alignment, in centimetres; none where less than half of the keyframes are posed.

The first three rows of each table were run here on the same images ({machine}, {date}): structure
from motion of the keyframes from the images alone, and COLMAP's two mappers on the same features and verified pairs,
from their own start. Without a focal length the incremental one stops at three keyframes on two of them; from images to
poses, with its own features, it does not, and the rows below say what it reaches then. The others are what papers
report of **whole** sequences, live and with a GPU: another task on other images. They say where this program
stands, not which one is better. DROID-SLAM with an unknown camera gets its focal length from a network.
"""


def page(kept: dict[str, Any]) -> str:
    """The page of the kept figures."""
    parts = [_HEAD.format(**kept)]
    for data in DATA_SETS:
        parts += [f"## {data.title}", f"Here: {data.here}.", "\n".join(markdown_table(
            ("program", "camera", "posed", "ATE, cm", "source"), [*_measured(kept["rows"][data.name]), *_told(data)]
        ))]  # fmt: skip
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _measured(row: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for key, program in (("ours", "MSGS-SLAM"), ("global", "COLMAP, global"), ("incremental", "COLMAP, incremental")):
        found = row[key]
        placed = int(found.get("placed", 0))
        ate = f"{found['ate']:.2f}" if "ate" in found and 2 * placed >= row["views"] else "–"
        yield program, FOUND, f"{placed} of {row['views']} keyframes", ate, "run here"


def _told(data: DataSet) -> Iterator[tuple[str, ...]]:
    for program, posed, ate in data.own:
        yield program, FOUND, posed, f"{ate:.2f}", "run here, `tracking.py --colmap`"
    for p in data.published:
        yield p.program, p.camera, "whole sequence", f"{100 * p.ate:.1f}", p.source


def measured() -> dict[str, Any]:
    """Run the recordings of DATA_SETS, each in a process of its own."""
    from focal import measure
    from tracking import in_process

    rows = {}
    for data in DATA_SETS:
        with tempfile.TemporaryDirectory() as work:
            rows[data.name] = in_process(measure, data.name, Path(work))
    return rows


def main() -> None:
    """Parse, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="run the recordings at hand")
    parser.add_argument("--machine", default="two CPU cores", help="what it is, for the page")
    arguments = parser.parse_args()
    if arguments.measure:
        kept = {"machine": arguments.machine, "date": f"{date.today():%B %Y}", "rows": measured()}
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    PAGE.write_text(page(json.loads(KEPT.read_text())), encoding="utf-8")


if __name__ == "__main__":
    main()
