"""Views beside the path: what one sees who steps half a metre aside and turns by 20 degrees.

    python -m tests.benchmarks.rooms video DIR --set choose --rooms 3         or walk: made rooms hold such views
    msgs-slam reconstruct DIR/video/SEED/video.mp4 SEED.msgs
    python tests/benchmarks/beside.py SEED.msgs=DIR/video/SEED ... [--sheet FOLDER]

Each view is placed by the run's pose of the frame that it is beside, at the scale of the whole path, and drawn with the
true camera. "seen": PSNR of the pixels that show what the path saw; gain and offset of each channel are fitted.
"covered": share of these where the map is. "keyframes", "between": PSNR of the views on the path, as `evaluate`.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.evaluation.truth import absolute_error, match_by_time
from msgs_slam.pipelines.evaluation.views import render_outcome, sheet, view_map
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome, spread_sample

ON_PATH = 24
"""Views on the path of each kind."""
Picture = NDArray[np.uint8]


def measure(run: Path, truth: Path, target: Path | None) -> dict[str, float]:
    """Figures of a run; a sheet of its views."""
    outcome, sequence = load_outcome(RunFolder(run)), open_sequence(truth)
    if sequence.camera is None:
        raise SystemExit(f"{truth}: no camera is known")
    rows, values, covered = [], [], []
    for image, seen, pose in beside_views(outcome, truth):
        view = view_map(outcome.require_map(), outcome.label_of_channel, sequence.camera, pose)
        drawn = fitted(view.color, image, seen)
        values.append(psnr(drawn, image, seen))
        covered.append(float((view.coverage[seen] > 0.5).mean()))
        rows.append([image, np.where(seen[..., None], drawn, drawn // 3), np.where(seen[..., None], image, image // 3)])
    if target is not None:
        target.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target / f"{run.stem}.png"), sheet(rows, ["true", "drawn", "seen"])[..., ::-1])
    return {
        "views": len(values),
        "seen": float(np.mean(values)),
        "covered": float(np.mean(covered)),
        **on_path(outcome),
    }


def beside_views(outcome: Outcome, truth: Path) -> list[tuple[Picture, NDArray[np.bool_], NDArray[np.float64]]]:
    """Image (h, w, 3), the pixels that the path saw, and cam_from_world (4, 4) in the run's world of each view."""
    t = outcome.trajectory
    matched = match_by_time(t.timestamps, open_sequence(truth))
    known = np.flatnonzero(t.is_posed & matched.has_pose)
    scale = absolute_error(t.centers[known], matched.world_from_cam[known, :3, 3], with_scale=True).alignment.scale
    poses = np.loadtxt(truth / "beside" / "poses.txt").reshape(-1, 4, 4)
    views = []
    for k, pose in enumerate(poses):
        rgba = cv2.imread(str(truth / "beside" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        nearest = known[np.abs(matched.world_from_cam[known, :3, 3] - pose[:3, 3]).sum(1).argmin()]
        step = np.linalg.inv(matched.world_from_cam[nearest]) @ pose
        step[:3, 3] /= scale
        seen = rgba[..., 3] > 0
        if seen.mean() > 0.3:
            views.append((rgba[..., 2::-1], seen, np.linalg.inv(t.world_from_cam[nearest] @ step)))
    return views


def fitted(color: NDArray[np.float32], image: Picture, seen: NDArray[np.bool_]) -> Picture:
    """The drawn image with the gain and offset of each channel that come nearest to the true one."""
    out = np.empty(image.shape)
    for c in range(3):
        a = np.column_stack([color[seen, c], np.ones(seen.sum())])
        gain, offset = np.linalg.lstsq(a, image[seen, c].astype(float), rcond=None)[0]
        out[..., c] = color[..., c] * gain + offset
    return np.round(np.clip(out, 0, 255)).astype(np.uint8)


def on_path(outcome: Outcome) -> dict[str, float]:
    """Mean PSNR at keyframes and at frames between them."""
    t = outcome.trajectory
    found = {}
    for name, rows in (("keyframes", t.is_keyframe), ("between", t.is_posed & ~t.is_keyframe)):
        values = []
        for row in spread_sample(np.flatnonzero(rows).tolist(), ON_PATH):
            drawn = render_outcome(outcome, t.cam_from_world[row]).exposed(outcome.exposure, t.timestamps[row])
            values.append(psnr(drawn, outcome.run.image(outcome.frames[row])))
        found[name] = float(np.mean(values)) if values else float("nan")
    return found


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="RUN.msgs=TRUTH")
    parser.add_argument("--sheet", type=Path, metavar="FOLDER", help="leave a picture of each run's views")
    given = parser.parse_args()
    found = []
    for case in given.cases:
        run, _, truth = case.partition("=")
        found.append(measure(Path(run), Path(truth), given.sheet))
        print(f"{Path(run).stem}: " + "  ".join(f"{k} {v:.4g}" for k, v in found[-1].items()), flush=True)
    print("mean: " + "  ".join(f"{k} {np.mean([f[k] for f in found]):.4g}" for k in found[0]))


if __name__ == "__main__":
    main()
