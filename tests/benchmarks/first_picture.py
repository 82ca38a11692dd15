"""The wide picture at the top of the README: a frame of a run, and map, classes and mesh from the same place.

python tests/benchmarks/first_picture.py RUN.msgs docs/pictures/wide.jpg [--frame 12]
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.evaluation.views import label_picture, render_outcome
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.scene.world import WORLD
from tests.benchmarks.textured_mesh import Light

WIDTH = 400
"""Pixels of one of the four."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--frame", type=int, help="a row of the run's frames; default: the middle one")
    args = parser.parse_args()
    strip = first_picture(load_outcome(RunFolder(args.run)), args.frame)
    cv2.imwrite(str(args.target), strip, [cv2.IMWRITE_JPEG_QUALITY, 88])


def first_picture(outcome: Outcome, row: int | None = None) -> NDArray[np.uint8]:
    """All four, BGR, of a row of the run's frames; of the middle one where none is named."""
    row = row if row is not None else len(outcome.frames) // 2
    panels = {"video": outcome.run.image(outcome.frames[row]), **drawn(outcome, row)}
    strip = np.concatenate([titled(name, picture) for name, picture in panels.items()], axis=1)
    return cv2.cvtColor(strip, cv2.COLOR_RGB2BGR)


def drawn(outcome: Outcome, row: int) -> dict[str, NDArray[np.uint8]]:
    """Map, classes and mesh as the camera of that frame sees them."""
    cam_from_world = outcome.trajectory.cam_from_world[row]
    view = render_outcome(outcome, cam_from_world)
    world = WORLD.read(outcome.run.file("export", "world.json"))
    mesh = Light(outcome.run.file("export", "mesh.glb"), world.gltf_from_exported)
    moved = outcome.moved(world.exported_from_run).trajectory.cam_from_world[row]
    color, covered = mesh.draw(moved, outcome.calibration.intrinsics)
    surface = np.where(covered[..., None], np.round(255 * color.clip(0, 1)), 255).astype(np.uint8)
    return {
        "Gaussian map": view.exposed(outcome.exposure, outcome.frames[row].timestamp),
        "classes": label_picture(view.labels, outcome.classes.colors),
        "textured mesh": surface,
    }


def titled(name: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """At `WIDTH`, with its name in the corner and a gap on the right."""
    size = (WIDTH, round(WIDTH * picture.shape[0] / picture.shape[1]))
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if picture.shape[1] > WIDTH else cv2.INTER_CUBIC)
    for thickness, shade in ((3, (0, 0, 0)), (1, (255, 255, 255))):
        cv2.putText(resized, name, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.62, shade, thickness, cv2.LINE_AA)
    return np.pad(resized, ((0, 0), (0, 4), (0, 0)), constant_values=255)


if __name__ == "__main__":
    main()
