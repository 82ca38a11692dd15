"""The models of a long recording's windows: the camera that they determine together, and their connected components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pycolmap
from numpy.typing import NDArray

from .rolling import Readout
from .seams import remove_keyframes
from .windows import Joined

Array = NDArray[np.float64]
_SUREST_PX = 1e-3
"""No window is surer of its focal length."""


@dataclass
class WindowModels:
    """`parts`: the windows joined one to the next; where one has no model, or shares too little with the one before, a
    new part begins. For each window its camera's parameters (P,), the standard deviation of the focal length, the
    readout and the number of observations."""

    parts: list[Joined] = field(default_factory=list)
    cameras: list[Array] = field(default_factory=list)
    focal_sds: list[float] = field(default_factory=list)
    readouts: list[Readout] = field(default_factory=list)
    observations: list[int] = field(default_factory=list)

    def add(self, model: pycolmap.Reconstruction, first: int, focal_sd: float, readout: Readout) -> None:
        """Add the model of the next window, whose images are counted from `first`."""
        if not self.parts or not self.parts[-1].add(model, first):
            self.parts.append(Joined())
            self.parts[-1].add(model, first)
        self.cameras.append(np.array(model.cameras[1].params))
        self.focal_sds.append(focal_sd)
        self.readouts.append(readout)
        self.observations.append(model.compute_num_observations())

    def calibrate(self, camera: pycolmap.Camera) -> float:
        """Set the camera to the mean of all windows', weighted by the variance of each focal length. Returns the mean's
        standard deviation: from those of the windows, and from the spread between them."""
        weights = 1 / np.maximum(self.focal_sds, _SUREST_PX) ** 2
        camera.params = np.average(self.cameras, axis=0, weights=weights).tolist()
        focal = np.array([c[0] for c in self.cameras])
        apart = np.average((focal - camera.params[0]) ** 2, weights=weights) / len(focal)
        return float(np.sqrt(1 / weights.sum() + apart))

    def readout(self) -> Readout:
        """Return the mean of all windows', weighted by observations: a start for that of the whole."""
        first, second = np.average(self.readouts, axis=0, weights=self.observations).tolist()
        return first, second

    def complaint(self, windows: int) -> str:
        """Return a warning about what has not become one model, "" where everything has."""
        failed = windows - len(self.cameras)
        if len(self.parts) == 1 and not failed:
            return ""
        return (
            f"structure from motion of a long recording in {windows} windows: {failed} gave no model, and the others "
            f"form {len(self.parts)} disconnected components. The largest is the run, others become pieces. A larger "
            "run.memory_mb makes windows larger, up to 500 keyframes"
        )

    def largest(self) -> Joined:
        """Return the part with most keyframes, the first of equal ones."""
        return max(self.parts, key=lambda part: len(part.poses))

    def others(
        self, camera: pycolmap.Camera, xy: Sequence[Array], whole: pycolmap.Reconstruction, least: int
    ) -> list[pycolmap.Reconstruction]:
        """Return the other parts with at least `least` keyframes that `whole` does not have, without those it has."""
        found, placed = [], set(whole.reg_image_ids())
        for part in self.parts:
            if part is not self.largest() and len(part.poses.keys() - placed) >= least:
                model = part.model(camera, xy)
                remove_keyframes(model, [i - 1 for i in sorted(part.poses.keys() & placed)])
                placed |= part.poses.keys()
                found.append(model)
        return found
