"""Figures by the protocol of older papers, for comparison with their tables alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.evaluation.measure import KEYFRAMES, Measured
from msgs_slam.pipelines.evaluation.trajectory_error import absolute_error
from msgs_slam.pipelines.evaluation.truth import MatchedTruth
from msgs_slam.pipelines.outcome import Outcome

NOTE = (
    'legacy figures, comparable with papers that use SplaTAM\'s script and with nothing else: its "ATE RMSE" is the '
    "mean distance between the translations of world-to-camera matrices, which depends on where the origin lies"
)


def legacy_cells(outcome: Outcome, matched: MatchedTruth, measured: Measured | None) -> dict[str, Any]:
    """Both trajectories begin at the identity; then the mean distance of cam_from_world translations after a rigid
    alignment; PSNR over keyframes at their own poses."""
    rows = np.flatnonzero(outcome.trajectory.is_placed & matched.has_pose)
    if len(rows) < 3:
        return {"note": NOTE, "missing": "fewer than three frames have both poses"}
    estimate = outcome.trajectory.cam_from_world[rows]
    truth = np.linalg.inv(matched.world_from_cam[rows])
    estimate, truth = (np.asarray(p @ np.linalg.inv(p[0]), np.float64) for p in (estimate, truth))
    cells: dict[str, Any] = {"note": NOTE}
    cells |= _ate(estimate[:, :3, 3], truth[:, :3, 3]) if outcome.metric else {"missing": "the run has no metric scale"}
    if measured is not None:
        cells["keyframe psnr"] = measured.images().get(KEYFRAMES, {}).get("psnr")
    return cells


def _ate(translations: NDArray, true_translations: NDArray) -> dict[str, Any]:
    try:
        error = absolute_error(translations, true_translations, with_scale=False)
    except ValueError as problem:
        return {"missing": str(problem)}
    return {"ate as they call it, m": error.statistics.mean}
