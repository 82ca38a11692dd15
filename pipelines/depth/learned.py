"""Depth by a network that a card describes; where it is relative, brought to the unit of the run's points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.sequence import Sequence
from ..networks.card import Card
from ..networks.network_pass import Arrays, NetworkPass, Workplace
from ..networks.outputs import network_depth
from ..networks.session import Network, card_identity
from ..providers import DepthEstimate, DepthProvider
from ..types import Frame
from .fused import depth_at_points

Array = NDArray[np.float64]
_MIN_POINTS = 12
_ENOUGH_POINTS = 40
_NEIGHBOURS = 5
"""A frame with few points of its own takes those of so many neighbours in time on either side too."""


class OnnxDepth(DepthProvider):
    """Depth in metres, frame by frame, whether or not the frame has a pose."""

    metric = True

    def __init__(self, card: Card, place: Workplace) -> None:
        """Opens the network. Raises InputError when it cannot be what the card says."""
        if card.task != "depth":
            raise InputError(f"{card.model}: its card says {card.task}, but proxy.depth needs a network for depth")
        self._network = Network(card, place.threads, place.device)
        self._sequence = place.sequence
        self.name = card.name
        self._tells_focal = card.kind == "points"
        self._frames: list[Frame] = []
        identity = f"{card_identity(card)} {place.sequence.intrinsics}"
        self._pass = NetworkPass(self.name, identity, place, self._compute)

    def precompute(self, frames: list[Frame]) -> None:
        """Run the network; what is on disk stays."""
        self._pass.run(frames)

    def fit(self, frames: list[Frame]) -> None:
        """Run the network over all frames."""
        self.precompute(frames)
        self._frames = frames

    def _compute(self, image: NDArray[np.uint8]) -> Arrays:
        found = network_depth(self._network, image, self._sequence.intrinsics)
        arrays = {"depth": found.depth, "confidence": found.confidence, "invalid": np.array(found.invalid)}
        if found.normals is not None:
            arrays["normals"] = found.normals
        return arrays | ({} if found.focal is None else {"focal": np.array(found.focal)})

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return the network's depth of a frame. Raises InputError when no pixel of it is valid."""
        stored = self._pass.load(frame)
        if not (stored["depth"] > 0).any():
            raise InputError(
                f"{self.name}: frame {frame.name} got no valid depth ({int(stored['invalid'])} of the network's values "
                "are NaN or negative). Check the card, or choose another --depth provider"
            )
        return DepthEstimate(stored["depth"], stored["confidence"], int(stored["invalid"]), stored.get("normals"))

    def figures(self) -> dict[str, Any]:
        """The size of the network's input, and the focal length that its points imply, in pixels of the frames.

        The camera was calibrated from correspondences before; the network's own focal length is a check of that.
        """
        box = self._network.box(self._sequence.intrinsics.width, self._sequence.intrinsics.height)
        figures: dict[str, Any] = {"network_size": [box.box_width, box.box_height]}
        if self._tells_focal and self._frames:
            focals = [float(self._pass.load(f)["focal"]) for f in self._frames]
            enlarge = self._sequence.calibration.intrinsics.width / self._sequence.intrinsics.width
            figures["network_focal_px"] = round(float(np.median(focals)) * enlarge, 1)
        return figures


class AlignedDepth(DepthProvider):
    """A network's relative depth in the unit of the backbone: not metric, but of one scale over the whole video.

    Each frame's values become depth by `scale · v` ("scale"), `scale · v + shift` ("depth") or
    `1 / (scale · v + shift)` ("inverse"), fitted to the triangulated points that it sees.
    """

    metric = False
    shared_state = ("_learned", "_fits")

    def __init__(self, learned: DepthProvider, sequence: Sequence, relative: str) -> None:
        """Raises InputError without a backbone: nothing else gives the frames' scales."""
        if sequence.backbone is None:
            raise InputError(
                f"{learned.name} knows depth only up to scale, and structure from motion found no points to fix it. "
                "Move the camera sideways, or choose a metric network"
            )
        self._learned, self._sequence, self._relative = learned, sequence, relative
        self.name = f"{learned.name}, aligned"
        self._fits: dict[int, tuple[float, float]] = {}
        self._spreads: list[float] = []

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a pose, whose scale is therefore unknown."""
        return [f for f in frames if f.id not in self._sequence.cam_from_world]

    def precompute(self, frames: list[Frame]) -> None:
        """Run the network on these frames."""
        self._learned.precompute(frames)

    def fit(self, frames: list[Frame]) -> None:
        """The network's pass, then scale and shift of every frame."""
        self._learned.fit(frames)
        posed = [f for f in frames if f.id in self._sequence.cam_from_world]
        seen = [depth_at_points(self._sequence, f, self._learned.estimate(f).depth) for f in posed]
        for i, frame in enumerate(posed):
            reach = 0 if len(seen[i][0]) >= _ENOUGH_POINTS else _NEIGHBOURS
            near = seen[max(0, i - reach) : i + reach + 1]
            values, z = (np.concatenate([s[k] for s in near]) for k in (0, 1))
            if len(values) >= _MIN_POINTS:
                self._fits[frame.id] = fit_relative(values, z, self._relative)
                own = to_depth(seen[i][0], self._fits[frame.id], self._relative)
                self._spreads.append(float(np.median(np.abs(own / seen[i][1] - 1))) if len(own) else 1.0)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Depth in the backbone's unit; unknown where the frame's scale is."""
        found = self._learned.estimate(frame)
        if frame.id not in self._fits:
            empty = np.zeros(found.depth.shape, np.float32)
            return DepthEstimate(empty, empty, found.invalid)
        aligned = to_depth(found.depth.astype(np.float64), self._fits[frame.id], self._relative)
        depth = np.where(found.depth > 0, aligned, 0).astype(np.float32)
        return DepthEstimate(depth, np.where(depth > 0, found.confidence, 0).astype(np.float32), found.invalid)

    def figures(self) -> dict[str, Any]:
        """Report the median over frames of the relative error of aligned depth at triangulated points."""
        spread = round(float(np.median(self._spreads)), 5) if self._spreads else None
        return {**self._learned.figures(), "aligned_frames": len(self._fits), "alignment_error": spread}


def fit_relative(values: Array, z: Array, relative: str) -> tuple[float, float]:
    """(scale, shift) that turn values (Q,) into depths z (Q,), by robust least squares on the relative error."""
    target = 1 / z if relative == "inverse" else z
    rows = np.stack([values, np.zeros(len(values)) if relative == "scale" else np.ones(len(values))], 1)
    # Errors count relative to the depth, however far: d(depth) / depth is the same for depth and inverse depth.
    rows = rows / target[:, None]
    weight = np.ones(len(z))
    scale = shift = 0.0
    for _ in range(15):
        root = np.sqrt(weight)
        scale, shift = (float(v) for v in np.linalg.lstsq(rows * root[:, None], root, rcond=None)[0])
        residual = np.abs(rows @ (scale, shift) - 1)
        weight = 1 / (1 + (residual / (2 * np.median(residual) + 1e-9)) ** 2)
    return scale, shift


def to_depth(values: Array, fit: tuple[float, float], relative: str) -> Array:
    """Depth of values; 0 where the fit puts them behind the camera or beyond every distance."""
    linear = fit[0] * values + fit[1]
    known = linear > 1e-6 * max(abs(fit[1]), abs(fit[0]), 1e-12)
    safe = np.where(known, linear, 1)
    return np.where(known, 1 / safe if relative == "inverse" else safe, 0)
