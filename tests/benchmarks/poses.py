"""Camera poses of every recording at hand in each form a user could give it, beside the last figures of each.

    python tests/benchmarks/poses.py                       all, structure from motion alone (`--until frames`)
    python tests/benchmarks/poses.py fr1_rpy office_loop   all forms of some
    python tests/benchmarks/poses.py --until tracking      every frame
    python tests/benchmarks/poses.py --colmap tum_fr1_xyz  pycolmap's two mappers on the same frames as well
    python tests/benchmarks/poses.py --update              keep the figures as the last ones, in poses.json

Forms: `video`; `plain`, its pictures alone; `set`, the data set that it is, with the camera that its files state;
`given`, plain with --poses of the truth, each 5 cm and 3 degrees off, every tenth missing and one absurd. Errors are
RMSE after Sim(3): centres in centimetres, rotations in degrees; `scale`, the largest ratio of the scales of two
stretches of the path; the focal length's error in per cent and in its own deviations; reprojection error; readout.
Seconds are of CPU, in one thread. The truth of kitchen is good to a centimetre or two; office_loop has none: how much
was placed, and how many of the pairs agree. Behind each row stand the mapper and the mechanisms of `mechanisms.py` that
acted. Whether networks mask people is a matter of those that are installed (MSGS_SLAM_CACHE).
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from msgs_slam.pipelines.run.files import BACKBONE, FRAMES, TRAJECTORY

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
from numpy.typing import NDArray
from tracking import (
    COARSE,
    DATA,
    PLAIN,
    Case,
    Truth,
    cases,
    in_process,
    of_set,
    original_names,
    prepare,
    rows_of,
    run_stages_timed,
    with_colmap,
)

Array = NDArray[np.float64]
LAST = Path(__file__).with_suffix(".json")
FORMS = ("video", "plain", "set", "given")
METRES, DEGREES = 0.05, 3.0
MADE = ("corridor", "classroom", "turn", "fast", "kitchen_twice", "two_rooms", "corridor_half_blank", "corridor_blank")
REAL = {
    "kinect_office": 15.0, "lab_monitor": 10.0, "realsense_workplace_2": 15.0, "sun3d_cubicles_1": 30.0,
    "tum_fr1_xyz": 10.0, "tum_fr3_teddy": 15.0,
}  # fmt: skip
"""Recordings by real cameras, and how many images they took a second."""


def real_truth(name: str) -> Truth:
    """Poses of a recording in `real`, by the number in the name of an image; without any where they are unknown."""
    path = DATA / "real" / name / "poses.txt"
    poses = rows_of(path) if path.exists() else np.zeros((0, 4, 4))

    def look_up(image: str, index: int) -> Array | None:
        row = int(Path(image).stem) if image else index
        return poses[row] if row < len(poses) and np.isfinite(poses[row]).all() else None

    return look_up


def true_focal(name: str, size: tuple[int, int]) -> float | None:
    """Focal length in pixels of images of this size that the recording's own calibration states, where it has one."""
    path = DATA / "real" / name / "intrinsics.txt"
    if path.exists():
        fx, fy, _, _, width, _ = np.loadtxt(path)[:6]
        return float((fx + fy) / 2 * size[0] / width)
    return FOCALS[name] * size[0] if name in FOCALS else None


FOCALS = {
    "kitchen": 525 / 640, "kitchen_long": 525 / 640, "fr1_rpy": 517 / 640, "replica": 300 / 600,
    "whiteroom": 525 / 640, "whiteroom_2": 525 / 640, "staircase": 525 / 640,
}  # fmt: skip
"""In widths of the image."""


def recordings(work: Path) -> dict[str, dict[str, Case]]:
    """All of them by name, and each one's cases by form."""
    known = cases(work)
    rpy, office = DATA / "tum_fr1_rpy", DATA / "office_loop" / "rgb"
    found = {
        "fr1_rpy": {"plain": known["fr1_rpy"], "set": Case(rpy, (), of_set(rpy))},
        "kitchen": {
            "video": known["kitchen_video"], "plain": known["kitchen"],
            "set": Case(DATA / "kitchen", (), of_set(DATA / "kitchen")),
        },
        "replica": {
            "plain": known["replica"],
            "set": Case(DATA / "replica_office0", (), of_set(DATA / "replica_office0")),
        },
        "whiteroom": {
            "video": known["whiteroom_video"],
            "set": Case(DATA / "whiteroom", (), of_set(DATA / "whiteroom")),
        },
        "phone_desk": {"plain": known["phone_desk"]},
        "office_loop": {"plain": Case(office, PLAIN, lambda *_: None)},
        "house_portrait": {"video": known["house_portrait"]},
        "bedroom": {"video": known["bedroom"]},
        "kitchen_long": {"video": known["kitchen_long"]},
        "people": {"plain": Case(DATA / "people", PLAIN, lambda *_: None)},
        **{name: {"plain": known[name]} for name in MADE},
    }  # fmt: skip
    for name in ("whiteroom_2", "staircase"):
        truth = rows_of(DATA / name / "traj.txt")
        step = lambda _, index, poses=truth: poses[index] if index < len(poses) else None  # noqa: E731
        found[name] = {"video": Case(DATA / name / "video.mp4", (), step)}
        found[name]["set"] = Case(DATA / name, (), of_set(DATA / name))
    for name, rate in REAL.items():
        folder = DATA / "real" / name
        found[name] = {
            "plain": Case(folder / "rgb", PLAIN, real_truth(name)),
            "video": Case(folder / "rgb", (), real_truth(name), rate=rate),
        }
    for name in ("replica", "fr1_rpy", "corridor_half_blank", "corridor_blank"):
        found[name]["given"] = found[name]["plain"]
    return found


def disturbed(world_from_cam: Array) -> Array:
    """Poses as another program might have them, in metres: see the top of this file."""
    from msgs_slam.pipelines.geometry import se3

    rng = np.random.default_rng(0)
    axis = rng.normal(size=(len(world_from_cam), 3))
    turns = np.radians(DEGREES) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    out = world_from_cam @ se3.exp(np.column_stack([np.zeros_like(turns), turns]))
    out[:, :3, 3] += rng.normal(0, METRES / np.sqrt(3), (len(out), 3))
    out[len(out) // 3, :3, 3] += 30.0
    out[5::10] = np.nan
    return np.asarray(out)


def write_given(source: Path, case: Case, path: Path) -> Path:
    """The disturbed truth of a folder's pictures as a JSON list."""
    from msgs_slam.formats.image_folder import list_images
    from msgs_slam.formats.textfile import write_json

    names = [p.name for p in list_images(source)]
    truth = [case.truth(n, i) for i, n in enumerate(names)]
    poses = disturbed(np.array([np.full((4, 4), np.nan) if t is None else t for t in truth]))
    poses = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    rows = [{"name": n, "transform": p.tolist()} for n, p in zip(names, poses, strict=True) if np.isfinite(p).all()]
    write_json(path, rows)
    return path


def measure(name: str, form: str, work: Path, settings: list[str], until: str) -> dict[str, Any]:
    """One row: the stages run, the poses compared."""
    from mechanisms import watched

    from msgs_slam.pipelines.run.folder import RunFolder
    from msgs_slam.pipelines.run.settings import load_config

    case = recordings(work)[name][form]
    source = prepare(name, case, work)
    more = [f'frames.poses="{write_given(source, case, work / f"{name}_given.json")}"'] if form == "given" else []
    run = RunFolder(work / f"{name}_{form}.msgs")
    config = load_config(overrides=["run.threads=1", *COARSE, *case.settings, *more, *settings])
    acting: set[str] = set()
    with watched(acting):
        records, seconds = run_stages_timed(source, run, config, until)
    frames = run.load(FRAMES)
    figures = records["frames"].figures
    row = {
        "frames": len(frames), "keyframes": figures["keyframes"], "placed": figures["keyframes_placed"],
        "agreeing": figures["pairs_agreeing"], "mapper": figures["mapper"], "focal": figures["focal_px"],
        "calibration": figures["calibration"], "reprojection": figures["reprojection_px"],
        "readout_ms": round(1000 * figures["readout_seconds"], 1),
        "seconds": round(sum(s["cpu"] for s in seconds.values()), 1),
        "warnings": [w for r in records.values() for w in r.warnings], "acting": sorted(acting),
    }  # fmt: skip
    ids, poses = _poses(run, until)
    row["posed"] = len(ids)
    originals = original_names(source, frames) if form != "set" else [""] * len(frames)
    truth = [case.truth(originals[i], frames[i].source_index) for i in ids]
    focal = true_focal(name, (figures["width"], figures["height"]))
    if focal is not None and form in ("plain", "video"):
        row["focal_off"] = round(100 * (figures["focal_px"] / focal - 1), 2)
        row["focal_deviations"] = round(abs(figures["focal_px"] - focal) / max(figures["focal_sd_px"], 1e-9), 1)
    return row | compare(poses, truth)


def measure_colmap(name: str, form: str, work: Path, mapper: str) -> dict[str, Any]:
    """The same of pycolmap's mapper on the frames of the run that `measure` left."""
    case = recordings(work)[name][form]
    source, key = prepare(name, case, work), f"{name}_{form}"
    poses, placed, truth, spent, model = with_colmap(source, case, work / f"{key}.msgs", work / f"{key}_colmap", mapper)
    row = {
        "posed": int(placed.sum()), "placed": int(placed.sum()), "keyframes": len(placed), "mapper": f"COLMAP {mapper}",
        "agreeing": math.nan, "warnings": [], "acting": [], "seconds": round(spent[1], 1),
    }  # fmt: skip
    if model is None:
        return row
    camera = next(iter(model.cameras.values()))
    row |= {"reprojection": round(model.compute_mean_reprojection_error(), 3), "focal": camera.mean_focal_length()}
    if (focal := true_focal(name, (camera.width, camera.height))) is not None:
        row["focal_off"] = round(100 * (row["focal"] / focal - 1), 2)
    return row | compare(poses[placed], [t for t, known in zip(truth, placed, strict=True) if known])


def _poses(run: Any, until: str) -> tuple[list[int], Array]:
    """Frame ids and cam_from_world of what is posed: keyframes after structure from motion, every frame after that."""
    if until == "frames":
        backbone = run.find(BACKBONE)
        return [int(i) for i in backbone.frame_ids], backbone.cam_from_world
    trajectory = run.load(TRAJECTORY, until)
    return np.flatnonzero(trajectory.is_posed).tolist(), trajectory.cam_from_world[trajectory.is_posed]


def compare(cam_from_world: Array, truth: list[Array | None]) -> dict[str, float]:
    """ATE and its worst in centimetres, and rotations in degrees, where there is a truth."""
    from msgs_slam.pipelines.geometry import se3
    from msgs_slam.pipelines.geometry.se3 import align_points, best_rotation

    known = [k for k, t in enumerate(truth) if t is not None]
    if len(known) < 3:
        return {}
    ours, theirs = se3.inverse(cam_from_world[known]), np.array([truth[k] for k in known])
    apart = align_points(ours[:, :3, 3], theirs[:, :3, 3]).apply(ours[:, :3, 3]) - theirs[:, :3, 3]
    axes = [p[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3) for p in (ours, theirs)]
    turns = np.tile(np.eye(4), (len(known), 1, 1))
    turns[:, :3, :3] = theirs[:, :3, :3].transpose(0, 2, 1) @ best_rotation(*axes) @ ours[:, :3, :3]
    return {
        "ate_cm": round(100 * float(np.sqrt((apart**2).sum(1).mean())), 3),
        "worst_cm": round(100 * float(np.linalg.norm(apart, axis=1).max()), 3),
        "local_scale": round(local_scale(ours[:, :3, 3], theirs[:, :3, 3]), 3),
        "degrees": round(float(np.degrees(np.sqrt((se3.rotation_angle(turns) ** 2).mean()))), 3),
    }


def local_scale(ours: Array, theirs: Array) -> float:
    """By what factor the scale of stretches of the path differs at most, of a twelfth of the path each."""
    from msgs_slam.pipelines.geometry.se3 import align_points

    step = max(4, len(ours) // 12)
    stretches = [slice(k, k + step) for k in range(0, len(ours) - step + 1, step)]
    extent = np.linalg.norm(np.ptp(theirs, axis=0))
    moving = [s for s in stretches if np.linalg.norm(np.ptp(theirs[s], axis=0)) > 0.03 * extent]
    scales = [align_points(ours[s], theirs[s]).scale for s in moving]
    return float(max(scales) / max(min(scales), 1e-9)) if scales else 1.0


COLUMNS = (
    "placed", "ATE cm", "last", "best", "worst", "degrees", "scale", "focal %", "devs", "px", "ms", "agree", "CPU s",
    "mapper, acting",
)  # fmt: skip


def print_row(name: str, row: dict[str, Any], last: dict[str, Any]) -> None:
    """Today's figures, with the last ones beside."""
    if "failed" in row:
        print(f"{name:30} {row['failed']}", flush=True)
        return
    cells = [
        f"{row['placed']}/{row['keyframes']}", row.get("ate_cm", "-"), last.get("ate_cm", "-"),
        last.get("best_cm", "-"), row.get("worst_cm", "-"), row.get("degrees", "-"), row.get("local_scale", "-"),
        row.get("focal_off", "-"), row.get("focal_deviations", "-"), row.get("reprojection", "-"),
        row.get("readout_ms", "-"), f"{row['agreeing']:.3f}", f"{row['seconds']:.0f}",
    ]  # fmt: skip
    print(f"{name:30}" + "".join(f"{c!s:>9}" for c in cells) + f"   {row['mapper']}, {row['acting']}", flush=True)
    for warning in row["warnings"]:
        print(f"{'':30} {warning[:150]}", flush=True)


def with_best(row: dict[str, Any], last: dict[str, Any]) -> dict[str, Any]:
    """The row to keep, with the least ATE that the recording ever had in this form."""
    kept = {k: v for k, v in row.items() if k != "warnings"}
    known = [before[name] for before, name in ((row, "ate_cm"), (last, "ate_cm"), (last, "best_cm")) if name in before]
    return kept | ({"best_cm": min(known)} if known else {})


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", metavar="RECORDING[:FORM]")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--until", choices=("frames", "tracking"), default="frames")
    parser.add_argument("--update", action="store_true")
    parser.add_argument("--colmap", action="store_true", help="pycolmap's two mappers on the same frames, too")
    parser.add_argument("--keep", type=Path, help="folder for the runs, which a second call then takes up again")
    arguments = parser.parse_args()
    last = json.loads(LAST.read_text()) if LAST.exists() else {}
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.keep or Path(temporary)
        work.mkdir(exist_ok=True)
        print(f"{'recording':30}" + "".join(f"{c:>9}" for c in COLUMNS))
        for wanted in arguments.recordings or list(recordings(work)):
            name, _, only = wanted.partition(":")
            for form in [f for f in FORMS if f in recordings(work)[name] and only in ("", f)]:
                key = f"{name} {form} {arguments.until}"
                row = in_process(measure, name, form, work, arguments.set, arguments.until)
                print_row(f"{name} {form}", row, last.get(key, {}))
                if arguments.update and "failed" not in row:
                    last[key] = with_best(row, last.get(key, {}))
                    LAST.write_text(json.dumps(dict(sorted(last.items())), indent=1) + "\n")
                for mapper in ("incremental", "global") if arguments.colmap else ():
                    print_row(f"{name} {form} COLMAP", in_process(measure_colmap, name, form, work, mapper), {})


if __name__ == "__main__":
    main()
