"""Poses on public recordings beside COLMAP's two mappers, run on the same frames, and published figures: one page.

    python tests/benchmarks/public.py                  docs/public.md anew from public.json
    python tests/benchmarks/public.py --measure        run the recordings at hand first, and keep their figures there
    python tests/benchmarks/public.py --parts          run the parts of whole sets at hand until every image is posed
    python tests/benchmarks/public.py --sets DIR       run the whole sets that are in DIR; what is missing is left out

DIR holds the sequences as their data sets unpack: `rgbd_dataset_freiburg1_360` and eight more of TUM RGB-D,
`chess/seq-01` and six more of 7-Scenes, `office0` to `room2` of Replica as NICE-SLAM has them. A sequence that is kept
in --work is not run again. Each is run from its images alone: nothing of the set but the truth, afterwards.

What --measure runs is what `focal.py` runs: structure from motion of the images alone, nothing known of the camera, and
COLMAP's mappers on the same features and verified pairs. Published figures are those of whole sequences, copied from
the tables that are named.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np

from msgs_slam.pipelines.system.wording import markdown_table

DATA = ROOT.parent / "shared" / "data"

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
SETS = {
    "TUM fr1": tuple(
        f"rgbd_dataset_freiburg1_{n}" for n in ("360", "desk", "desk2", "floor", "plant", "room", "rpy", "teddy", "xyz")
    ),
    "7-Scenes": tuple(
        f"{n}/seq-01" for n in ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
    ),
    "Replica": (*(f"office{k}" for k in range(5)), *(f"room{k}" for k in range(3))),
}  # fmt: skip
PARTS = {
    "TUM freiburg1_rpy": ("tum_fr1_rpy", "200 of 723 images"),
    "TUM freiburg1_xyz": ("real/tum_fr1_xyz", "68 of 798 images, every third from 400 on"),
    "7-Scenes red kitchen, one of its sequences": ("kitchen", "150 of 1000 images, every second of the first 300"),
    "Replica office_0, as vMAP has it": ("replica_office0", "81 of 2000 images, every tenth at half size"),
}
"""Part of a sequence → its folder in ../shared/data, and which part it is."""
OTHERS = (
    ("DASH-SLAM", "no: depth network CC BY-NC", "2.67 / 7.0", "6.5 / 8.6", "0.89 / 5.6", "1.02 / 1.02 / 1.07"),
    ("the same, networks under Apache-2.0", "yes", "14.8 to 18.5", "–", "17.9 to 19.0", "–"),
    ("AMB3R", "no licence stated", "3.58 / 23.1", "5.3 / 38.8", "3.8 / 70.2", "1.56 / 2.05 / 2.98"),
    ("VGGT-SLAM 2.0", "its network's licence on request", "3.83 / 24.9", "6.8 / 44.3", "3.0 / 69.8",
     "1.61 / 2.29 / 3.15"),
    ("ViSTA-SLAM", "–", "5.24 / 52.2", "5.5 / 42.9", "10.8 / 27.8", "0.58 / 0.69 / 1.29"),
    ("MASt3R-SLAM", "no: network CC BY-NC-SA", "6.05 / 12.2", "6.6 / 15.0", "4.5 / 9.9", "0.92 / 0.94 / 1.09"),
    ("DA3-Streaming", "–", "10.3 / 16.5", "8.2 / 9.3", "1.9 / 5.7", "0.87 / 0.97 / 1.04"),
    ("DROID-SLAM, focal length by GeoCalib", "–", "13.0 / 24.1", "– / 44.7", "80", "0.99 / 1.32 / 0.74"),
)  # fmt: skip
"""Whole sets, uncalibrated, by one evaluator: evals/benchmarks of github.com/otaviohrg/DA3-SLAM, November 2026."""
_HEAD = """\
# Poses on public recordings

Made by `python tests/benchmarks/public.py`. ATE: root mean square distance of the camera centres from the ground truth
after alignment, in centimetres.

## Whole sets

Mean ATE of nine sequences of TUM RGB-D freiburg1, seven of 7-Scenes (seq-01) and eight of Replica, camera unknown:
after a similarity (Sim(3)) / after rotation and translation alone (SE(3)), where a program's own metres count. The
figures of the others are from the [tables of DASH-SLAM's repository](https://github.com/otaviohrg/DA3-SLAM) (November
2026), where one evaluator ran all of them on GPUs. A dash: not found there, or a licence that we have not looked up.

{sets}

`python tests/benchmarks/public.py --sets DIR` runs whole sets, where they have been downloaded, and `--parts` the parts
that we have. {parts}

## Beside COLMAP

ATE after one Sim(3); none where less than half of the keyframes are posed. The first three rows of each table were run
here on the same images ({machine}, {date}): structure
from motion of the keyframes from the images alone, and COLMAP's two mappers on the same features and verified pairs,
from their own start. Without a focal length the incremental one stops at three keyframes on two of them; from images to
poses, with its own features, it does not, and the rows below say what it reaches then. The others are what papers
report of **whole** sequences, live and with a GPU: another task on other images. They say where this program
stands, not which one is better. DROID-SLAM with an unknown camera gets its focal length from a network.
"""

_RUN_HERE = """\
Each from its images alone until all are posed, with the three small networks. Metres: estimated over true metres
per unit, with the stated standard deviation, and by how many of these it is off (if honest, below 2 in 19 of 20)."""


def page(kept: dict[str, Any]) -> str:
    """The page of the kept figures."""
    sequences: dict[str, Any] = kept["sequences"]
    parts = [_HEAD.format(**kept, sets=_sets(sequences), parts=_sequences(sequences))]
    for data in DATA_SETS:
        parts += [f"### {data.title}", f"Here: {data.here}.", "\n".join(markdown_table(
            ("program", "camera", "posed", "ATE, cm", "source"), [*_measured(kept["rows"][data.name]), *_told(data)]
        ))]  # fmt: skip
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _sets(sequences: dict[str, Any]) -> str:
    """Means of whole sets: ours where all of a set have been run, then the others'."""
    cells, scales = [], []
    for names in SETS.values():
        rows = [sequences[name] for name in names if name in sequences]
        is_whole = len(rows) == len(names)
        means = [np.mean([row[key] for row in rows]) if is_whole else None for key in ("sim3_cm", "se3_cm", "scale")]
        cells.append(f"{means[0]:.2f} / {means[1]:.1f}" if is_whole else "parts only, below")
        scales.append(f"{means[2]:.2f}" if is_whole else "–")
    ours = ("MSGS-SLAM", "yes", *cells, " / ".join(scales) if set(scales) != {"–"} else "–")
    header = ("program", "may be used commercially", *SETS, "mean scale")
    return "\n".join(markdown_table(header, [ours, *OTHERS]))


def _sequences(sequences: dict[str, Any]) -> str:
    """What was run here, sequence by sequence."""
    if not sequences:
        return "Of no sequence the metres have been measured so yet; paths of three parts are below."
    rows = [
        (
            name.removeprefix("rgbd_dataset_"), row["part"] or "whole", f"{row['posed']} of {row['frames']}",
            f"{row['sim3_cm']:.2f}", f"{row['se3_cm']:.1f}", f"{row['scale']:.2f} ± {row['sd']:.0%}",
            f"{row['deviations']:.1f}", f"{row['cpu_seconds']:.0f}",
        )
        for name, row in sorted(sequences.items())
    ]  # fmt: skip
    header = ("sequence", "images", "posed", "Sim(3), cm", "SE(3), cm", "metres", "deviations", "CPU s")
    return "\n".join([_RUN_HERE, "", *markdown_table(header, rows)])


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


def measure_sequence(folder: Path, run_folder: Path, settings: Sequence[str] = ()) -> dict[str, Any]:
    """From the images alone until every one is posed: errors in centimetres, estimated over true metres per unit with
    its stated relative deviation, and CPU seconds."""
    from tracking import PLAIN, errors, original_names, run_stages_timed

    from msgs_slam.formats.datasets import open_sequence
    from msgs_slam.pipelines.geometry.se3 import align_points
    from msgs_slam.pipelines.networks.registry import metric_card
    from msgs_slam.pipelines.run.files import FRAMES, TRAJECTORY
    from msgs_slam.pipelines.run.folder import RunFolder
    from msgs_slam.pipelines.run.settings import load_config
    from msgs_slam.pipelines.scene.metres import find_metres

    sequence = open_sequence(folder)
    images = run_folder.with_suffix(".images")
    images.mkdir(parents=True, exist_ok=True)
    for path in sequence.image_paths:
        if not (images / path.name).exists():
            (images / path.name).symlink_to(path.resolve())
    run = RunFolder(run_folder)
    _, seconds = run_stages_timed(images, run, load_config(overrides=[*PLAIN, "run.threads=1", *settings]), "tracking")
    frames, trajectory = run.load(FRAMES), run.load(TRAJECTORY, "tracking")
    assert sequence.world_from_cam is not None
    true = dict(zip((p.name for p in sequence.image_paths), sequence.world_from_cam, strict=True))
    truth = [p if np.isfinite(p := true[name]).all() else None for name in original_names(images, frames)]
    row = errors(trajectory.cam_from_world, trajectory.is_posed, truth, False)
    metres, _ = find_metres(run, trajectory, True, metric_card())
    assert metres is not None
    known = [k for k, pose in enumerate(truth) if pose is not None and trajectory.is_posed[k]]
    ours, wanted = trajectory.centers[known], np.array([truth[k][:3, 3] for k in known])
    scale = metres.per_unit / align_points(ours, wanted).scale
    apart = align_points(metres.per_unit * ours, wanted, False).apply(metres.per_unit * ours) - wanted
    return {key: row[key] for key in ("posed", "frames", "sim3_cm")} | {
        "se3_cm": 100 * float(np.sqrt((apart**2).sum(1).mean())), "scale": scale, "sd": metres.relative_sd,
        "deviations": abs(math.log(scale)) / metres.relative_sd,
        "cpu_seconds": sum(spent["cpu"] for spent in seconds.values()),
    }  # fmt: skip


def run_sequences(folders: dict[str, tuple[Path, str]], work: Path, kept: dict[str, Any]) -> None:
    """Run sequences in processes of their own and keep each row as it comes; name → (folder, which part it is)."""
    from tracking import in_process

    for name, (folder, part) in folders.items():
        row = in_process(measure_sequence, folder, work / f"{name.replace('/', '_')}.msgs")
        print(name, row, flush=True)
        if "failed" not in row:
            kept["sequences"][name] = {"part": part, **{k: _short(v) for k, v in row.items()}}
            KEPT.write_text(json.dumps(kept, indent=1) + "\n")


def _short(value: float) -> float:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    """Parse, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="run the recordings at hand")
    parser.add_argument("--parts", action="store_true", help="run the parts of sequences at hand")
    parser.add_argument("--sets", type=Path, metavar="DIR", help="run the whole sequences that are in DIR")
    parser.add_argument("--work", type=Path, help="keep the runs there; one that is finished is not made again")
    parser.add_argument("--machine", default="two CPU cores", help="what it is, for the page")
    arguments = parser.parse_args()
    kept = json.loads(KEPT.read_text())
    if arguments.measure:
        kept |= {"machine": arguments.machine, "date": f"{date.today():%B %Y}", "rows": measured()}
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    folders = {name: (DATA / where, part) for name, (where, part) in PARTS.items()} if arguments.parts else {}
    if arguments.sets:
        names = chain.from_iterable(SETS.values())
        folders = {name: (arguments.sets / name, "") for name in names if (arguments.sets / name).is_dir()}
        print(f"{len(folders)} sequences of {sum(map(len, SETS.values()))} are in {arguments.sets}")
    with tempfile.TemporaryDirectory() as scratch:
        run_sequences(folders, arguments.work or Path(scratch), kept)
    PAGE.write_text(page(json.loads(KEPT.read_text())), encoding="utf-8")


if __name__ == "__main__":
    main()
