"""A person who walks through a room: what she costs, and whether she leaves a ghost.

    python tests/benchmarks/people.py --out DIR [CASE ...] [--frames 30] [--threads 1] [--poses] [--json FILE]
                                       [--set KEY=VALUE ...]

The woman of `people/` is cut out by the person network and pasted, walking to and fro, into `whiteroom` (exact poses
and depth). Cases: clean (without her), networks (found by the networks), masks (the mask she was pasted by given as
--masks, no networks), moving (found by what other keyframes see behind her, no networks), nothing (she is taken for
scene). Needs the recordings in ../shared/data beside the repository.
A case that is done in DIR is not done again. With --poses nothing is mapped, and depth, of which the poses are made
without, is coarse: for the whole walk of 150 frames.

A ghost is what stands in her way and nowhere near a true surface: before what a frame in which she hides it shows, and
farther than 30 cm from every surface of the 150 true depth maps. What of that the clean run has too, within 10 cm, is
no trace of her.
"""

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from msgs_slam.formats.images import read_depth_png, read_rgb, write_grey_png, write_rgb
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.evaluation.views import render_outcome
from msgs_slam.pipelines.geometry.camera import project, unproject_depth
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.masks.people import person_probability
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.networks.session import Network
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import CALIBRATION, FRAMES, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.lens import FramePixels
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Intrinsics

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CAMERA = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0)
STEP = 3
"""Every third frame of whiteroom has a picture and a depth map."""
CASES = ("clean", "networks", "masks", "moving", "nothing")
TURN = 22
"""Frames (of 10 a second) in which she walks to and fro once."""
TALL = 440
APART, BESIDE = 0.3, 0.1
"""Metres from every true surface at which something is none of it, and from another point to be the same. Of the solid
Gaussians of a clean map of 24 frames 614 are farther than 10 cm from every true surface, 59 than 15, 10 than 20, 0 than
30: far walls without parallax."""
COARSE = ["proxy.stereo_side=160", "proxy.max_side=160"]


@dataclass(frozen=True)
class Clip:
    """Names, true depth (N, H, W) in metres, world_from_cam (N, 4, 4), and where the person is (N, H, W)."""

    names: list[str]
    depth: NDArray[np.float32]
    world_from_cam: NDArray[np.float64]
    person: NDArray[np.bool_]


def make_clip(folder: Path, frames: int, network: Network) -> Clip:
    """Writes clean/, crowded/ and masks/ under `folder`."""
    room = DATA / "whiteroom"
    indices = [STEP * i for i in range(frames)]
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)[indices]
    cuts = [cut_out(network, read_rgb(p)) for p in sorted((DATA / "people").glob("*.jpg"))[: min(frames, 60)]]
    depth, person, names = [], [], []
    for n, index in enumerate(indices):
        name = f"{index:06d}.jpg"
        clean = read_rgb(room / "rgb" / name)
        crowded, alpha = paste(clean, *cuts[n % len(cuts)], 0.5 + 0.4 * np.sin(2 * np.pi * n / TURN))
        person.append(alpha > 0.02)
        names.append(f"{index:06d}.png")
        write_rgb(folder / "clean" / names[-1], clean)
        write_rgb(folder / "crowded" / names[-1], crowded)
        write_grey_png(folder / "masks" / names[-1], np.where(person[-1], 0, 255).astype(np.uint8))
        depth.append(read_depth_png(room / "depth" / f"{index:06d}.png").astype(np.float32) / 1000)
    return Clip(names, np.stack(depth), poses, np.stack(person))


def cut_out(network: Network, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The largest person of a picture (h, w, 3) and its opacity (h, w)."""
    alpha = np.clip((person_probability(network, image) - 0.5) / 0.3, 0, 1).astype(np.float32)
    _, piece, stats, _ = cv2.connectedComponentsWithStats((alpha > 0).astype(np.uint8))
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    x, y, w, h = stats[largest, :4]
    return image[y : y + h, x : x + w], (alpha * (piece == largest))[y : y + h, x : x + w]


def paste(
    image: NDArray[np.uint8], cut: NDArray[np.uint8], alpha: NDArray[np.float32], where: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The cut-out TALL pixels high on the lower border, its middle at `where` of the width; and its opacity (H, W)."""
    height, width = image.shape[:2]
    size = round(cut.shape[1] * TALL / cut.shape[0]), TALL
    cut, alpha = cv2.resize(cut, size, interpolation=cv2.INTER_AREA), cv2.resize(alpha, size)
    left = round(where * width - size[0] / 2)
    first, last = max(left, 0), min(left + size[0], width)
    full = np.zeros((height, width), np.float32)
    full[height - TALL :, first:last] = alpha[:, first - left : last - left]
    over = np.zeros_like(image)
    over[height - TALL :, first:last] = cut[:, first - left : last - left]
    return np.round(image + full[..., None] * (over.astype(np.float32) - image)).astype(np.uint8), full


def run_case(case: str, folder: Path, threads: int, poses: bool, extra: list[str]) -> RunFolder:
    """Reconstruct one case at a small size; without labels, which have no part in this."""
    run = RunFolder(folder / f"{case}.msgs")
    settings = [f"run.threads={threads}", "run.device=cpu", 'proxy.semantics="segments"', "mapping.max_side=320"]
    if case != "networks":
        settings.append('frames.people="keep"')
    if case == "nothing":
        settings.append('proxy.moving="keep"')
    if case == "masks":
        settings.append(f'frames.masks="{folder / "masks"}"')
    # As many visits a keyframe in every case: the least number of all would be shared out among more of them.
    settings += ["mapping.passes=13.4", "mapping.min_iterations=0"]
    source = folder / ("clean" if case == "clean" else "crowded")
    settings += [*(COARSE if poses else []), *extra]
    until = "tracking" if poses else "export"
    reconstruct(source, run, load_config(overrides=settings), SilentProgress(), until)
    return run


def measure_path(case: str, run: RunFolder, clip: Clip) -> tuple[dict[str, Any], Similarity]:
    """Error of the camera's path, what was masked, and the truth's world from the run's."""
    frames, trajectory = run.load(FRAMES), run.load(TRAJECTORY, "tracking")
    rows = [clip.names.index(f.name) for f in frames]
    posed, truth = trajectory.is_posed, clip.world_from_cam[rows][:, :3, 3]
    true_from_ours = align_points(trajectory.centers[posed], truth[posed])
    error = np.linalg.norm(true_from_ours.apply(trajectory.centers[posed]) - truth[posed], axis=1)
    pixels = FramePixels(run.load(CALIBRATION))
    person = [pixels.sample(clip.person[r]) for r in rows]
    row = {
        "case": case,
        "posed": int(posed.sum()),
        "ate_cm": round(100 * float(np.sqrt((error**2).mean())), 3),
        "person_share": round(float(np.mean([p.mean() for p in person])), 3),
    }
    if case in ("networks", "masks", "moving"):
        found = [run.left_out(f) for f in frames]
        if case == "moving":  # looks at keyframes alone
            keyframes = np.flatnonzero(trajectory.is_keyframe)
            found, person = [found[k] for k in keyframes], [person[k] for k in keyframes]
        hit = [float((f & p)[p].mean()) if f is not None else 0.0 for f, p in zip(found, person, strict=True)]
        beside = [float((f & ~p).mean()) for f, p in zip(found, person, strict=True) if f is not None]
        row["person_masked"] = round(float(np.mean(hit)), 3)
        row["masked_beside"] = round(float(np.mean(beside)), 3) if beside else 0.0
    return row, true_from_ours


def measure_map(run: RunFolder, clip: Clip, true_from_ours: Similarity, folder: Path, case: str) -> dict[str, Any]:
    """PSNR where the person is not, and what stands in her way."""
    outcome = load_outcome(run, "cpu")
    pixels = FramePixels(outcome.calibration)
    person = [pixels.sample(clip.person[clip.names.index(f.name)]) for f in outcome.frames]
    keyframes = np.flatnonzero(outcome.trajectory.is_keyframe)
    m = outcome.require_map()
    solid = m.means[m.opacities > 0.3].detach().numpy()
    row = {"psnr_db": round(float(np.mean([background_psnr(outcome, int(k), person[k]) for k in keyframes])), 2)}
    surface = cKDTree(true_surface())
    for name, points in (("gaussians", solid), ("vertices", read_vertices(run))):
        ghost = ghosts(true_from_ours.apply(points), clip, surface)
        file = folder / f"clean_{name}.npy"
        if case == "clean":
            np.save(file, ghost)
        row |= {name: len(points), f"{name}_in_path": len(ghost)}
        if file.exists() and case != "clean":
            row[f"{name}_of_her"] = len(beyond(ghost, np.load(file)))
    picture(outcome, int(keyframes[len(keyframes) // 3]), folder / f"{case}.png")
    return row | {"seconds": {k: round(r.seconds) for k, r in outcome.records.items()}}


def background_psnr(outcome: Outcome, k: int, person: NDArray[np.bool_]) -> float:
    """Of the rendering at frame row `k` where the person, with a rim, is not."""
    rim = cv2.dilate(person.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    frame = outcome.frames[k]
    view = render_outcome(outcome, outcome.trajectory.cam_from_world[k])
    return psnr(view.exposed(outcome.exposure, frame.timestamp), outcome.run.image(frame), ~rim)


def at_same_pixels(folder: Path, cases: list[str]) -> dict[str, float]:
    """PSNR of each finished case at what none of them hides, in the frames that are keyframes of all."""
    outcomes = {c: load_outcome(RunFolder(folder / f"{c}.msgs"), "cpu") for c in cases}
    rows = {
        c: {o.frames[k].name: int(k) for k in np.flatnonzero(o.trajectory.is_keyframe)} for c, o in outcomes.items()
    }
    found: dict[str, list[float]] = {c: [] for c in cases}
    for name in sorted(set.intersection(*map(set, rows.values()))):
        person = read_rgb(folder / "masks" / name)[..., 0] == 0
        hidden = np.zeros_like(person)
        for case, outcome in outcomes.items():
            left_out = outcome.run.left_out(outcome.frames[rows[case][name]])
            hidden |= FramePixels(outcome.calibration).sample(person)
            hidden |= np.bool_(False) if left_out is None else left_out
        for case, outcome in outcomes.items():
            found[case].append(background_psnr(outcome, rows[case][name], hidden))
    return {c: round(float(np.mean(v)), 2) for c, v in found.items()}


def true_surface() -> NDArray[np.float64]:
    """(P, 3) of everything that any frame of the room shows, a point every 3 cm."""
    room = DATA / "whiteroom"
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    cloud = []
    for path in sorted((room / "depth").glob("*.png")):
        depth = np.ascontiguousarray(read_depth_png(path)[1::4, 1::4]).astype(np.float32) / 1000
        world_from_cam = poses[int(path.stem)]
        points = unproject_depth(depth, CAMERA.resized(depth.shape[1], depth.shape[0]))[depth > 0]
        cloud.append(points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])
    together = np.concatenate(cloud)
    return together[np.unique(np.floor(together / 0.03).astype(np.int64), axis=0, return_index=True)[1]]


def ghosts(points: NDArray[np.float64], clip: Clip, surface: cKDTree) -> NDArray[np.float64]:
    """Those of the points (P, 3), in the true world, that are no surface and stand where the person hid something."""
    points = points[surface.query(points, distance_upper_bound=APART)[0] > APART]
    bad = np.zeros(len(points), bool)
    for depth, world_from_cam, person in zip(clip.depth, clip.world_from_cam, clip.person, strict=True):
        cam_from_world = np.linalg.inv(world_from_cam)
        xy, z = project(points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], CAMERA)
        place = np.nan_to_num(xy, nan=-1).astype(int)
        inside = ((place >= 0) & (place < [CAMERA.width, CAMERA.height])).all(1) & (z > 0)
        column, row = place[inside].T
        bad[np.flatnonzero(inside)[(z[inside] < depth[row, column] - APART) & person[row, column]]] = True
    return points[bad]


def beyond(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points that have none of the others within 10 cm."""
    return points if len(others) == 0 else points[cKDTree(others).query(points)[0] > BESIDE]


def read_vertices(run: RunFolder) -> NDArray[np.float64]:
    """(V, 3) of the mesh, in the run's own world."""
    vertices = np.asarray(trimesh.load(run.stage("export") / "mesh.ply", process=False).vertices, np.float64)
    told = json.loads((run.stage("export") / "world.json").read_text())["exported_from_run"]
    return (vertices - told["translation"]) / told["scale"] @ np.array(told["rotation"])


def picture(outcome: Outcome, k: int, path: Path) -> None:
    """The frame and the map from its place, side by side."""
    frame = outcome.frames[k]
    view = render_outcome(outcome, outcome.trajectory.cam_from_world[k])
    both = [outcome.run.image(frame), view.exposed(outcome.exposure, frame.timestamp)]
    write_rgb(path, np.concatenate(both, axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("cases", nargs="*", default=CASES[:3])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--poses", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    given = parser.parse_args()
    out = given.out.resolve()
    os.environ["MSGS_SLAM_CACHE"] = str(out / "cache")
    store = ModelStore.open()
    store.take(DATA / "models", store.with_needed([]))
    clip = make_clip(out, given.frames, Network(store.card(store.get("person")), given.threads, "cpu"))
    rows = []
    for case in given.cases:
        run = run_case(case, out, given.threads, given.poses, given.settings)
        row, true_from_ours = measure_path(case, run, clip)
        rows.append(row if given.poses else row | measure_map(run, clip, true_from_ours, out, case))
        print(json.dumps(rows[-1]), flush=True)
    if not given.poses and len(given.cases) > 1:
        rows.append({"psnr_db_at_same_pixels": at_same_pixels(out, given.cases)})
        print(json.dumps(rows[-1]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
