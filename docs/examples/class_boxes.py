"""Export: the box of each class in the upright world, as a table for spreadsheets."""

import csv
import io

import numpy as np

from msgs_slam.formats.atomic import write_text
from msgs_slam.pipelines.export.scene import ExportScene
from msgs_slam.pipelines.run.outcome import map_cloud
from msgs_slam.pipelines.run.target import Target


def write_class_boxes(scene: ExportScene, target: Target) -> None:
    """Write boxes.csv: name, Gaussians, and lowest and highest x, y, z of nine tenths of them.

    A class without Gaussians has no row.
    """
    outcome = scene.outcome
    cloud = map_cloud(outcome)
    rows = [["class", "gaussians", "x0", "y0", "z0", "x1", "y1", "z1"]]
    for label, name in enumerate(outcome.classes.names):
        mine = cloud.means[cloud.class_ids == label] if cloud.class_ids is not None else cloud.means[:0]
        if len(mine):
            low, high = np.quantile(mine, (0.05, 0.95), axis=0)
            rows.append([name, str(len(mine)), *(f"{v:.3f}" for v in (*low, *high))])
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows(rows)
    write_text(target.path("boxes.csv"), table.getvalue())
