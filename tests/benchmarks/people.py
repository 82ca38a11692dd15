"""A person who walks through a room: what she costs, and whether she leaves a ghost.

    python tests/benchmarks/people.py --out DIR [CASE ...] [--frames 30] [--threads 1] [--json FILE]

The woman of `people/` is cut out by the person network and pasted, walking to and fro, into `whiteroom` (exact poses
and depth). Cases: clean (without her), networks (found by the networks), masks (the mask she was pasted by given as
--masks, no networks), nothing (she is taken for scene). Needs the recordings in ../shared/data beside the repository.
A case that is done in DIR is not done again.
"""

from __future__ import annotations

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

from formats.images import read_depth_png, read_rgb, write_grey_png, write_rgb
from pipelines.config import load_config
from pipelines.evaluation.image_quality import psnr
from pipelines.evaluation.measure import render_outcome
from pipelines.frames.source_pixels import FramePixels
from pipelines.geometry.alignment import align_points
from pipelines.geometry.camera import project
from pipelines.outcome import Outcome, load_outcome
from pipelines.progress import SilentProgress
from pipelines.proxy.models.registry import ModelStore
from pipelines.proxy.networks.person import person_probability
from pipelines.proxy.networks.session import Network
from pipelines.reconstruct import reconstruct
from pipelines.run_folder import RunFolder
from pipelines.types import Intrinsics

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CAMERA = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0)
STEP = 3
"""Every third frame of whiteroom has a picture and a depth map."""
CASES = ("clean", "networks", "masks", "nothing")
TURN = 22
"""Frames (of 10 a second) in which she walks to and fro once."""
TALL = 440
IN_FRONT = 0.9
"""Nearer than this part of the true depth, at its smallest within a few pixels, is free space."""


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


def run_case(case: str, folder: Path, threads: int) -> RunFolder:
    """Reconstruct one case at a small size; without labels, which have no part in this."""
    run = RunFolder(folder / f"{case}.msgs")
    settings = [f"run.threads={threads}", "run.device=cpu", 'proxy.semantics="segments"', "mapping.max_side=320"]
    if case != "networks":
        settings.append('frames.people="keep"')
    if case == "masks":
        settings.append(f'frames.masks="{folder / "masks"}"')
    source = folder / ("clean" if case == "clean" else "crowded")
    reconstruct(source, run, load_config(overrides=settings), SilentProgress())
    return run


def measure(case: str, run: RunFolder, clip: Clip, folder: Path) -> dict[str, Any]:
    """One row: error of the path, PSNR where the person is not, and what stands in the free space she walks through."""
    outcome = load_outcome(run, "cpu")
    rows = [clip.names.index(f.name) for f in outcome.frames]
    posed = outcome.trajectory.is_posed
    truth = clip.world_from_cam[rows][:, :3, 3]
    ours = outcome.trajectory.centers
    true_from_ours = align_points(ours[posed], truth[posed])
    error = np.linalg.norm(true_from_ours.apply(ours[posed]) - truth[posed], axis=1)
    found = [outcome.run.left_out(f) for f in outcome.frames]
    pixels = FramePixels(outcome.calibration)
    person = [pixels.sample(clip.person[r]) for r in rows]
    keyframes = np.flatnonzero(outcome.trajectory.is_keyframe)
    m = outcome.require_map()
    solid = m.means[m.opacities > 0.3].detach().numpy()
    mesh = read_vertices(run)
    row = {
        "case": case,
        "posed": int(posed.sum()),
        "ate_cm": round(100 * float(np.sqrt((error**2).mean())), 3),
        "psnr_db": round(float(np.mean([background_psnr(outcome, int(k), person[k]) for k in keyframes])), 2),
        "person_share": round(float(np.mean([p.mean() for p in person])), 3),
        "gaussians": len(m.means),
        "gaussians_in_path": in_free_space(true_from_ours.apply(solid), clip),
        "vertices": len(mesh),
        "vertices_in_path": in_free_space(true_from_ours.apply(mesh), clip),
        "seconds": {k: round(r.seconds) for k, r in outcome.records.items()},
    }
    if case in ("networks", "masks"):
        hit = [float((f & p)[p].mean()) if f is not None else 0.0 for f, p in zip(found, person, strict=True)]
        row["person_masked"] = round(float(np.mean([hit[k] for k in keyframes])), 3)
        beside = [float((f & ~p).mean()) for f, p in zip(found, person, strict=True) if f is not None]
        row["masked_beside"] = round(float(np.mean(beside)), 3) if beside else 0.0
    picture(outcome, int(keyframes[len(keyframes) // 3]), folder / f"{case}.png")
    return row


def background_psnr(outcome: Outcome, k: int, person: NDArray[np.bool_]) -> float:
    """Of the rendering at frame row `k` where the person, with a rim, is not."""
    rim = cv2.dilate(person.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    frame = outcome.frames[k]
    view = render_outcome(outcome, outcome.trajectory.cam_from_world[k])
    return psnr(view.exposed(outcome.exposure, frame.timestamp), outcome.run.image(frame), ~rim)


def in_free_space(points: NDArray[np.float64], clip: Clip) -> int:
    """How many points (P, 3), in the true world, lie where the person stood before a frame and nothing is in truth."""
    bad = np.zeros(len(points), bool)
    for depth, world_from_cam, person in zip(clip.depth, clip.world_from_cam, clip.person, strict=True):
        cam_from_world = np.linalg.inv(world_from_cam)
        nearest = cv2.erode(depth, np.ones((9, 9), np.uint8))  # the depth beside a step may be that of either side
        xy, z = project(points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], CAMERA)
        place = np.nan_to_num(xy, nan=-1).astype(int)
        inside = ((place >= 0) & (place < [CAMERA.width, CAMERA.height])).all(1) & (z > 0)
        column, row = place[inside].T
        ahead = (z[inside] < IN_FRONT * nearest[row, column]) & person[row, column]
        bad[np.flatnonzero(inside)[ahead]] = True
    return int(bad.sum())


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
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    out = given.out.resolve()
    os.environ["MSGS_SLAM_CACHE"] = str(out / "cache")
    store = ModelStore.open()
    store.take(DATA / "models", store.with_needed([]))
    clip = make_clip(out, given.frames, Network(store.card(store.get("person")), given.threads, "cpu"))
    rows = []
    for case in given.cases:
        rows.append(measure(case, run_case(case, out, given.threads), clip, out))
        print(json.dumps(rows[-1]), flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
