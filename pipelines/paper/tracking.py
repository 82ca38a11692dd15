"""The pose of a frame from the map alone, and which keyframes it is mapped with (section 3.3)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..depth.fields import FINE
from ..geometry import se3
from ..geometry.camera import project
from ..mapping.views import View, half_view
from ..proxy.maps import mean_iou
from ..render.api import Rendering
from ..types import VOID, Intrinsics
from .rendering import Gaussians, semantic_image, show
from .rerender import CELL, SAME_SURFACE, SD_DEPTH, Rerendering, Samples, sample
from .uncertainty import PAPER, Constants

Array = NDArray[np.float64]


def overlap(points_in_world: Array, cam_from_world: Array, intrinsics: Intrinsics) -> float:
    """Eq. (10): η_i, the share of a frame's back-projected points (P, 3) that fall into the image of keyframe i."""
    if len(points_in_world) == 0:
        return 0.0
    xy, z = project(points_in_world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], intrinsics)
    inside = (z > 0) & (xy >= 0).all(-1) & (xy < [intrinsics.width, intrinsics.height]).all(-1)
    return float(inside.mean())


def geometric_keyframes(overlaps: Sequence[float], constants: Constants = PAPER) -> list[int]:
    """Eq. (11): KF_geo = {i : η_i > T_geo}, as places in the list."""
    return [i for i, eta in enumerate(overlaps) if eta > constants.eta]


def semantic_keyframes(
    labels: NDArray[np.uint8], others: NDArray[np.uint8], constants: Constants = PAPER
) -> NDArray[np.bool_]:
    """Eq. (12): (K,) which keyframes' label images (K, h, w) agree with this one's (h, w) by mIoU < T_sem.

    So that a frame is mapped with views that show something else too."""
    return np.asarray(mean_iou(labels, others) < constants.t_sem)


def time_weights(ages: NDArray, reliabilities: NDArray, constants: Constants = PAPER) -> Array:
    """Eq. (13): U(t) = ρ exp(-τ(t_now - t)) ω(t) of keyframes of that age (K,), in keyframes, and mean U (K,)."""
    return constants.rho * np.exp(-constants.tau * ages) * depth_certainty(reliabilities, constants)


def depth_certainty(reliabilities: NDArray, constants: Constants = PAPER) -> Array:
    """Eq. (14): ω(t) = exp(-δ · mean(1 - U(D̂_t))) of mean reliabilities (K,).

    Printed with U itself, which would weigh reliable keyframes less."""
    return np.exp(-constants.delta * (1 - np.asarray(reliabilities, np.float64)))


def select_keyframes(
    overlaps: Sequence[float],
    differs: NDArray[np.bool_],
    weights: NDArray,
    rng: np.random.Generator,
    constants: Constants = PAPER,
) -> list[int]:
    """At most 20 places of keyframes, drawn by (13) from those of (11) that pass (12), or of (11) where none do."""
    geometric = geometric_keyframes(overlaps, constants)
    pool = [i for i in geometric if differs[i]] or geometric
    if len(pool) <= constants.most_keyframes:
        return pool
    chances = np.asarray(weights, np.float64)[pool]
    return sorted(rng.choice(pool, constants.most_keyframes, replace=False, p=chances / chances.sum()).tolist())


SMALLEST, LEVELS = 60, 4
"""Sizes that a frame is compared at, each half the next, at most so many and down to this longer side: frames of ten
images a second move by 50 pixels."""
_FEWER = (0, 2, 3, 4)
"""Taken from the width of `CELL`, the whole size first: of small images more of the pixels are drawn."""
_MIN_SEEN = 0.1
"""Share of a frame that has to be covered for a start to be compared with others."""
_MISSED = float(np.log1p((SAME_SURFACE / SD_DEPTH) ** 2))
"""Cost of what the map shows and the frame does not have there: a pose that brings nothing together is not the best."""


@dataclass(frozen=True)
class Tracked:
    """cam_from_world (4, 4) float64; the loss (16) there, and the share of the image that the map covers."""

    cam_from_world: Tensor
    loss: float
    covered: float


def predict(previous: Array, last: Array) -> Array:
    """Eq. (15): E_{t+1} = E_t (E_{t-1}⁻¹ E_t), constant velocity; poses (4, 4) cam_from_world."""
    return last @ (se3.inverse(previous) @ last)


def tracking_loss(shown: Rendering, view: View, semantics: Tensor, unit: float, constants: Constants = PAPER) -> Tensor:
    """Eq. (16): mean over pixels with Sil > T_sil of λ_D U |D̂ - D| + λ_C |I - C| + λ_S |S_gt - S|.

    Depths are in units of the scene's depth; semantics (H, W, K) is S_gt, void pixels count nothing.
    """
    inside = (shown.silhouette.detach() > constants.t_sil).float()
    depth = view.trust * (view.depth - shown.depth).abs() / unit
    color = (view.colors - shown.features[..., :3]).abs().mean(-1)
    known = semantics.sum(-1)
    semantic = (semantics - shown.features[..., 3:]).abs().sum(-1) * known / 2
    terms = constants.track_depth * depth + constants.track_color * color + constants.track_semantic * semantic
    return (view.of_scene(terms) * inside).sum() / inside.sum().clamp(min=1)


@torch.no_grad()
def track_pose(
    gaussians: Gaussians, view: View, starts: list[Tensor], classes: int, unit: float, constants: Constants = PAPER
) -> Tracked:  # fmt: skip
    """Minimise (16) from the best of the starts (4, 4), on images of growing size.

    The map is drawn at the pose so far, and what it shows there is moved into the frame by steps of Gauss and Newton
    (`rerender`), with the frame's scale field for a further unknown; then it is drawn anew. The paper's descent by Adam
    draws the map at each step, and between images that turn by ten degrees it ends elsewhere: a turn looks much like
    a shift, and the loss falls along both.
    """
    weights = replace(
        constants, map_depth=constants.track_depth, map_color=constants.track_color, xi=constants.track_semantic
    )
    problem = _Problem(gaussians, view, classes, unit, weights)
    top = len(problem.frame) - 1
    found = [problem.moved(start, range(top, max(top - 2, -1), -1)) for start in starts]
    pose, _ = min(found, key=lambda pair: pair[1])
    for level in range(top - 1, 0, -1):
        pose, _ = problem.moved(pose, (level, level - 1))
    shown = show(problem.seen_from(pose), pose, view)
    loss = float(tracking_loss(shown, view, semantic_image(view, classes), unit, constants))
    return Tracked(pose, loss, float((shown.silhouette > constants.t_sil).float().mean()))


class _Problem:
    """A frame at all sizes, and the map that is moved into it."""

    def __init__(self, gaussians: Gaussians, view: View, classes: int, unit: float, weights: Constants) -> None:
        self.gaussians, self.view, self.classes, self.unit, self.weights = gaussians, view, classes, unit, weights
        self.frame = [self._sample(v, level) for level, v in enumerate(_sizes(view))]

    def seen_from(self, pose: Tensor) -> dict[str, Tensor]:
        rows = self.gaussians.in_view(pose, self.view.intrinsics)
        return {k: v.detach()[rows] for k, v in self.gaussians.table.values.items()}

    def moved(self, start: Tensor, levels: range | tuple[int, int]) -> tuple[Tensor, float]:
        """The pose after steps on these sizes with what the map shows at the start, and the cost of the last."""
        shown = show(self.seen_from(start), start, self.view)
        inside = shown.silhouette > self.weights.t_sil
        if float(inside.float().mean()) < _MIN_SEEN:
            return start, np.inf
        views, weights = _sizes(self._as_view(shown, inside)), self.weights
        is_blind = not bool((self.view.depth > 0).any())
        if is_blind:  # what lies before what is not known: colours alone decide
            weights = replace(weights, map_depth=0.0)
        poses, fields, free = np.stack([start.numpy()] * 2), np.zeros((2, FINE.size)), np.array([False, True])
        for level in levels:
            drawn, frame = self._sample(views[level], level), self.frame[level]
            frame = replace(frame, log_depth=drawn.log_depth) if is_blind else frame
            problem = Rerendering([drawn, frame], poses, fields, free, free, [(0, 1)], self.unit, poses, weights)
            problem = problem.minimised(self.weights.track_iterations // 2)
            poses = problem.poses
        share = len(problem.drawn(0, 1).rows) / max(len(drawn.depth), 1)
        cost = share * problem.cost() + (1 - share) * _MISSED if share else _MISSED
        return torch.from_numpy(poses[1]), cost

    def _as_view(self, shown: Rendering, inside: Tensor) -> View:
        """What the map shows, as if it had been seen there."""
        labels = torch.full_like(self.view.channels, VOID)
        if self.classes:
            labels = torch.where(inside, shown.features[..., 3:].argmax(-1).to(torch.uint8), labels)
        return replace(
            self.view, image=(shown.features[..., :3].clamp(0, 1) * 255).round().to(torch.uint8), channels=labels,
            depth=torch.where(inside, shown.depth, torch.zeros(())), reliability=inside.to(torch.uint8) * 255,
            scene=None,
        )  # fmt: skip

    def _sample(self, view: View, level: int) -> Samples:
        return sample(view, self.classes, self.weights, CELL - _FEWER[level])


def _sizes(view: View) -> list[View]:
    """The view at all sizes, the whole first."""
    views = [view]
    while len(views) < LEVELS and max(views[-1].image.shape[:2]) >= 2 * SMALLEST:
        views.append(half_view(views[-1]))
    return views
