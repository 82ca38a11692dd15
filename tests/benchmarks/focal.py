"""The focal length and k1 of cameras that nobody states, with their deviations, beside COLMAP's two mappers.

    python tests/benchmarks/focal.py                            36 walks by seed and the shared recordings
    python tests/benchmarks/focal.py walk_0-12 whiteroom_2 --json rows.json

All from the same verified pairs, nothing known before, in one thread. Errors of the focal length in per cent of the
true one, ATE of keyframes in centimetres after Sim(3). A walk is one among points on walls and furniture, its features
off by 0.2 to 0.35 pixels and by a slowly drifting error of their place; wrong matches are among them.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
import pycolmap
from numpy.typing import NDArray
from tracking import in_process

from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.geometry.camera import ONE_CAMERA
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.candidates import AdjustedModel, CandidateModels, KeyframeSet
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.matching import VerifiedPair, verify_matches, write_database
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Features

Array = NDArray[np.float64]
SIZE, REACH = (640, 480), 6
BENDS = (0.0, 0.0, 0.0, -0.05, -0.1, -0.2, -0.3, 0.1)
RECORDINGS = {
    "whiteroom": ("video", 525 / 640), "whiteroom_2": ("video", 525 / 640), "staircase": ("video", 525 / 640),
    "replica": ("plain", 0.5), "kitchen": ("video", 525 / 640), "fr1_rpy": ("plain", 517 / 640),
}  # fmt: skip
"""Form, and the true focal length in widths of the image; of the last two the stated ones of a Kinect."""


@dataclass(frozen=True)
class Input:
    """What the mappers get, and the truth: world_from_cam (4, 4) of each view, the focal length in pixels and k1."""

    views: KeyframeSet
    pairs: list[VerifiedPair]
    camera: pycolmap.Camera
    truth: list[Array | None]
    focal: float
    k1: float


def walk(seed: int) -> Input:
    """A walk by seed: how the camera looks, its lens and the room change with it."""
    rng = np.random.default_rng(seed)
    width, height = SIZE
    k1, focal = float(rng.choice(BENDS)), width * rng.uniform(0.6, 1.15)
    lens = pycolmap.Camera.create_from_model_name(1, "RADIAL", focal, width, height)
    k2 = rng.normal() * 0.1 * abs(k1)  # a real lens has no single coefficient
    lens.params = [focal, width / 2, height / 2, k1, k2]
    room = np.array([rng.uniform(3.5, 7), rng.uniform(2.3, 3), rng.uniform(3.5, 7)])
    points, poses = _points(rng, room), _path(rng, room)
    xy, seen, drift = [], [], np.zeros((len(points), 2))
    noise, kept = rng.uniform(0.2, 0.35), rng.uniform(0.5, 0.9)
    for pose in poses:
        local = points @ pose[:3, :3].T + pose[:3, 3]
        ahead = np.flatnonzero((local[:, 2] > 0.4) & (np.abs(local[:, :2]) < 1.5 * local[:, 2:]).all(1))
        ahead = ahead[rng.random(len(ahead)) < kept]
        radius = ((local[ahead, :2] / local[ahead, 2:]) ** 2).sum(1)
        pixels = np.asarray(lens.img_from_cam(local[ahead]))
        inside = ((pixels > 2) & (pixels < [width - 2, height - 2])).all(1)
        inside &= 1 + 3 * k1 * radius + 5 * k2 * radius**2 > 0.05
        mine, pixels = ahead[inside][:900], pixels[inside][:900]
        drift += rng.normal(0, 0.03, drift.shape)
        wild = np.where(rng.random(len(mine)) < 0.1, 3, 1)[:, None]
        xy.append(pixels + rng.normal(0, noise, pixels.shape) * wild + drift[mine])
        seen.append(mine)
    camera = unknown_camera(width, height, 1.2 * width, False)
    pairs = [p for i in range(len(xy)) for j in range(i + 1, min(i + REACH, len(xy) - 1) + 1)
             if (p := _pair(rng, (i, j), seen, xy, camera)) is not None]  # fmt: skip
    keypoints = [np.column_stack([p, np.ones((len(p), 2))]).astype(np.float32) for p in xy]
    features = [Features(k, np.zeros((len(k), 128), np.uint8)) for k in keypoints]
    held = LruSequence(len(features), features.__getitem__, lambda f: f.nbytes, 1e9)
    views = KeyframeSet(held, [k[:, :2].astype(float) for k in keypoints], np.arange(len(xy)) * 10.0, [])
    return Input(views, pairs, camera, list(np.linalg.inv(poses)), focal, k1)


def _points(rng: np.random.Generator, room: Array) -> Array:
    """(P, 3) points on the walls and the floor, their pictures, and boxes that stand about; y points down."""
    width, height, depth = room
    x, y, z = np.diag(room)
    count, out = int(rng.uniform(1500, 5000)), []

    def fill(corner: Array, a: Array, b: Array, share: float) -> None:
        at = rng.uniform(size=(int(count * share), 2))
        out.append(corner + at[:, :1] * a + at[:, 1:] * b)

    for corner, a, b in ((0 * x, x, y), (z, x, y), (0 * x, z, y), (x, z, y), (y, x, z)):
        fill(corner, a, b, rng.uniform(0.02, 0.1))
        for _ in range(rng.integers(1, 5)):
            u, v = rng.uniform(0, 0.7, 2)
            fill(corner + u * a + v * b, a * rng.uniform(0.1, 0.3), b * rng.uniform(0.1, 0.3), 0.06)
    for _ in range(rng.integers(3, 8)):
        size = rng.uniform(0.3, 1.5, 3)
        corner = np.array([rng.uniform(0, width - size[0]), height - size[1], rng.uniform(0, depth - size[2])])
        a, up, b = np.diag(size)
        for at, side, other in ((corner, a, b), (corner, a, up), (corner + b, a, up), (corner, b, up)):
            fill(at, side, other, 0.03)
    return np.concatenate(out)


def _path(rng: np.random.Generator, room: Array) -> Array:
    """(N, 4, 4) cam_from_world of somebody who walks a bent line and looks ahead, aside or at something."""
    count = int(rng.integers(18, 40))
    t, length = np.linspace(0, 1, count), rng.uniform(0.5, 3)
    way = rng.uniform(0, 2 * np.pi) + rng.normal() * (t - 0.5)
    step = length / count * np.column_stack([np.cos(way), 0 * t, np.sin(way)])
    centre = [0.5, 1, 0.5] * room - [0, rng.uniform(1.2, 1.7), 0] + rng.normal(size=3) * [0.4, 0, 0.4]
    centres = centre + np.cumsum(step, 0) - step.sum(0) / 2
    centres[:, 1] += 0.05 * np.sin(t * rng.uniform(3, 12) + rng.uniform(0, 6))
    centres += np.cumsum(rng.normal(0, 0.006, centres.shape), 0)
    centres[:, [0, 2]] = centres[:, [0, 2]].clip(0.3, room[[0, 2]] - 0.3)
    heading, turn = np.pi / 2 - way, rng.uniform(-1.2, 1.2) * rng.choice([0.3, 1])
    look = rng.integers(4)
    if look == 3:
        at = centre + 2 * np.array([np.sin(way[0] + 1), 0, np.cos(way[0] + 1)])
        yaw = np.arctan2(*(at - centres)[:, [0, 2]].T)
    else:
        yaw = (heading + 0.15 * np.sin(5 * t), heading + np.pi / 2 + turn * t, way[0] + 2 * turn * t)[look]
    pitch = rng.normal() * 0.15 + 0.1 * np.sin(t * rng.uniform(3, 9)) + rng.normal(0, 0.01, count)
    roll = rng.normal(0, 0.02, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angles, place in zip(poses, np.column_stack([yaw, pitch, roll]), centres, strict=True):
        (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
        turns = [[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]], [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]
        pose[:3, :3] = np.array(turns[0]) @ turns[1] @ [[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]
        pose[:3, 3] = -pose[:3, :3] @ place
    return poses


def _pair(
    rng: np.random.Generator, pair: tuple[int, int], seen: list[NDArray[Any]], xy: list[Array], camera: pycolmap.Camera
) -> VerifiedPair | None:
    i, j = pair
    _, a, b = np.intersect1d(seen[i], seen[j], return_indices=True)
    wrong = rng.random(len(a)) < 0.06
    b[wrong] = rng.permutation(b[wrong])
    if len(a) < 15:
        return None
    return verify_matches(pair, np.column_stack([a, b]).astype(np.uint32), (xy[i], xy[j]), camera, 0)


def recorded(name: str, work: Path) -> tuple[Input, AdjustedModel | None]:
    """What the stage `frames` gives its mappers of a recording, and what it makes of it."""
    from poses import recordings
    from tracking import COARSE, original_names, prepare

    from msgs_slam.pipelines.reconstruct import reconstruct
    from msgs_slam.pipelines.run.files import FRAMES
    from msgs_slam.pipelines.run.folder import RunFolder
    from msgs_slam.pipelines.run.settings import load_config
    from msgs_slam.pipelines.sfm.driver import StructureFromMotion

    form, widths = RECORDINGS[name]
    case = recordings(work)[name][form]
    source, run = prepare(name, case, work), RunFolder(work / f"{name}.msgs")
    got: list[Any] = []
    plain, plain_run = StructureFromMotion._calibrated, StructureFromMotion.run

    def calibrated(self: StructureFromMotion, views: KeyframeSet, pairs: Any) -> AdjustedModel | None:
        found = plain(self, views, pairs)
        got[1:] = [views, list(pairs), self.camera, found]
        return found

    def run_all(self: StructureFromMotion, keyframe_ids: Any) -> Any:
        got[:] = [list(keyframe_ids)]
        return plain_run(self, keyframe_ids)

    StructureFromMotion._calibrated, StructureFromMotion.run = calibrated, run_all  # type: ignore[method-assign]
    reconstruct(
        source, run, load_config(overrides=["run.threads=1", *COARSE, *case.settings]), SilentProgress(), "frames"
    )
    ids, views, pairs, camera, found = got
    frames = run.load(FRAMES)
    names = original_names(source, frames)
    truth = [case.truth(names[i], frames[i].source_index) for i in ids]
    return Input(views, pairs, camera, truth, widths * camera.width, 0.0), found


def mapped_by_colmap(given: Input, mapper: str, work: Path) -> pycolmap.Reconstruction | None:
    """pycolmap's own mapper on the same pairs, from its own start."""
    work.mkdir()
    database, names = work / "database.db", [f"{i:06d}" for i in range(len(given.views.xy))]
    write_database(database, given.camera, names, given.views.features, given.pairs, ONE_CAMERA.cam_from_rig)
    if mapper == "global":
        wide = pycolmap.GlobalPipelineOptions()
        wide.num_threads = wide.mapper.num_threads = 1
        wide.random_seed = 0
        models = pycolmap.global_mapping(database, work, work, wide)
    else:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = 1
        options.random_seed, options.extract_colors, options.multiple_models = 0, False, False
        models = pycolmap.incremental_mapping(database, work, work, options)
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def figures(model: pycolmap.Reconstruction | None, given: Input) -> dict[str, float]:
    """Error of the focal length, k1, ATE and the number of placed views."""
    if model is None:
        return {}
    params = model.cameras[1].params
    ids = [i for i in sorted(model.reg_image_ids()) if given.truth[i - 1] is not None]
    found = {"error": 100 * (params[0] / given.focal - 1), "k1": params[3], "placed": model.num_reg_images()}
    if len(ids) > 2:
        ours = np.array([model.images[i].projection_center() for i in ids])
        true = np.array([t[:3, 3] for i in ids if (t := given.truth[i - 1]) is not None])
        apart = align_points(ours, true).apply(ours) - true
        found["ate"] = 100 * float(np.sqrt((apart**2).sum(1).mean()))
    return {key: float(value) for key, value in found.items()}


def measure(name: str, work: Path) -> dict[str, Any]:
    """One row, of a walk or a recording."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    if name.startswith("walk_"):
        given = walk(int(name.removeprefix("walk_")))
        (snapshots := work / f"{name}_ours").mkdir()
        candidates = CandidateModels(
            config=FramesConfig(overlap=REACH), camera=given.camera, is_fixed=False, snapshots=Snapshots(snapshots),
            progress=SilentProgress(), seed=0,
        )  # fmt: skip
        found = candidates._calibrated(given.views, given.pairs)
    else:
        given, found = recorded(name, work)
    row: dict[str, Any] = {"views": len(given.views.xy), "k1": given.k1, "ours": figures(found and found.model, given)}
    if found is not None:
        row["ours"]["sd"] = 100 * found.focal_sd / given.focal
    return row | {
        m: figures(mapped_by_colmap(given, m, work / f"{name}_{m}"), given) for m in ("global", "incremental")
    }


def print_row(name: str, row: dict[str, Any]) -> None:
    """One line of the table in README.md."""
    if "failed" in row:
        print(f"| {name} | {row['failed']} |", flush=True)
        return
    ours = row["ours"]
    cells = {
        key: [f"{f[key]:.3f}" if key in f else "–" for f in (ours, row["global"], row["incremental"])]
        for key in ("error", "ate", "k1")
    }
    first = f"{name} ({int(ours.get('placed', 0))} of {row['views']}) | {row['k1']:g}, {cells['k1'][0]}"
    focal = f"{cells['error'][0]} ± {ours.get('sd', 0):.3f} | {', '.join(cells['error'][1:])}"
    print(f"| {first} | {focal} | {', '.join(cells['ate'])} |", flush=True)


def print_sums(rows: dict[str, dict[str, Any]]) -> None:
    """How many are within two deviations, and how the errors compare."""
    whole = [r for r in rows.values() if r.get("ours")]
    within = sum(abs(r["ours"]["error"]) <= 2 * r["ours"]["sd"] for r in whole)
    print(f"\nwithin two deviations: {within} of {len(whole)} that have a model, of {len(rows)}")
    both = [r for r in whole if r["global"] or r["incremental"]]
    for key in ("error", "ate"):
        ours = np.array([abs(r["ours"].get(key, np.nan)) for r in both])
        better = np.array([min(abs(r[m].get(key, np.inf)) for m in ("global", "incremental")) for r in both])
        print(f"{key}: median {np.nanmedian(ours):.3f}, of COLMAP's better mapper in each {np.median(better):.3f}; "
              f"more than 1.2 times that: {int((ours > 1.2 * better).sum())} of {len(both)}")  # fmt: skip


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="walk_FIRST-END or recording", default=["walk_0-36", *RECORDINGS])
    parser.add_argument("--json", type=Path)
    arguments, names, rows = parser.parse_args(), [], {}
    for name in arguments.names:
        first, dash, end = name.removeprefix("walk_").partition("-")
        names += [f"walk_{k}" for k in range(int(first), int(end))] if dash else [name]
    print("| (keyframes) | k1, found | focal length | COLMAP global, incremental | ATE ours, global, incremental |")
    print("| --- | --- | --- | --- | --- |")
    for name in names:
        with tempfile.TemporaryDirectory() as work:
            rows[name] = in_process(measure, name, Path(work))
        print_row(name, rows[name])
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1))
    print_sums(rows)


if __name__ == "__main__":
    main()
