"""The pose of a frame from the map alone (section 3.3)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..compute.adam import AdamTable
from ..geometry import se3
from ..mapping.views import View, halved
from ..render.api import Rendering, moved
from .constants import PAPER, Constants
from .gaussians import Gaussians, semantic_image, show

LEVELS, SMALLEST = 3, 60
"""Sizes that a frame is compared at, each half the next, down to this width: frames of ten pictures a second move by 30
pixels, and of still smaller images the best pose is a wrong one."""
_RATES = ((0.06, 0.004), (0.1, 0.01), (0.15, 0.03))
"""First and last rate on each, the whole size first: in coordinates in which the loss is about half the square of the
distance. The paper's 3e-3, of a twist, is the same for all six numbers."""
_DIFFERENCE, _FLOOR = 2e-3, 0.02
"""Of twists for differences, in radians and scene depths; and the smallest residual that is divided by."""
_ROUNDS = (1, 2, 4)
"""Of the paper's number of steps on each size, the whole first; (25) goes on from there."""
_PATIENCE = 6
"""Steps without a lower loss after which a size is done."""


@dataclass(frozen=True)
class Tracked:
    """cam_from_world (4, 4) float64; the loss (16) there, and the share of the image that the map covers."""

    cam_from_world: Tensor
    loss: float
    covered: float


def predict(previous: Tensor, last: Tensor) -> Tensor:
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


def track(
    gaussians: Gaussians, view: View, starts: list[Tensor], classes: int, unit: float, seed: int,
    constants: Constants = PAPER,
) -> Tracked:  # fmt: skip
    """Minimise (16) by Adam from the best of the starts (4, 4), on images of growing size.

    Smaller images see fewer and larger Gaussians: one in four at half the size, of twice the radius.
    """
    views = [view]
    while len(views) < LEVELS and views[-1].intrinsics.width >= 2 * SMALLEST:
        views.append(halved(views[-1]))
    problems = [_Problem(gaussians, v, starts, classes, unit, level, seed, constants) for level, v in enumerate(views)]
    pose = min(starts, key=lambda start: problems[-1].loss(start))
    for level in reversed(range(len(views))):
        pose, loss = _converge(problems[level], pose, constants.track_iterations, level)
    with torch.no_grad():
        shown = problems[0].show(pose, None)
    return Tracked(pose, loss, float((shown.silhouette > constants.t_sil).float().mean()))


class _Problem:
    """The Gaussians around the starts, thinned for a size, and what they are compared with."""

    def __init__(
        self, gaussians: Gaussians, view: View, starts: list[Tensor], classes: int, unit: float, level: int, seed: int,
        constants: Constants,
    ) -> None:  # fmt: skip
        seen = [gaussians.in_view(start, view.intrinsics) for start in starts]
        rows = torch.unique(torch.cat(seen))
        picked = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[: -(-len(rows) // 4**level)]
        rows = rows[picked.sort().values]
        self.values = {k: v.detach()[rows] for k, v in gaussians.table.values.items()}
        self.values["log_radii"] = self.values["log_radii"] + level * math.log(2)
        self.view, self.unit, self.constants = view, unit, constants
        self.semantics = semantic_image(view, classes)

    def show(self, pose: Tensor, twist: Tensor | None) -> Rendering:
        return show(self.values, pose, self.view, twist)

    def of(self, pose: Tensor, twist: Tensor | None) -> Tensor:
        shown = self.show(pose, twist)
        seen = (shown.silhouette.detach() > self.constants.t_sil).float().mean()
        loss = tracking_loss(shown, self.view, self.semantics, self.unit, self.constants)
        return loss if seen > 0.1 else loss + 10  # nothing to compare is no good pose

    @torch.no_grad()
    def basis(self, pose: Tensor) -> Tensor:
        """(6, 6) twists along which the loss is equally curved: a turn looks much like a shift, and Adam, which knows
        the axes alone, would stay in the valley between them."""
        scales = torch.tensor([self.unit] * 3 + [1.0] * 3) * _DIFFERENCE
        here = self._residuals(pose)
        columns = [(self._residuals(moved(pose, row)) - here) / scales[i] for i, row in enumerate(torch.diag(scales))]
        jacobian = torch.stack(columns).double()
        weights = 1 / here.abs().clamp(min=_FLOOR).double()
        normal = (jacobian * weights) @ jacobian.T / len(here)
        normal = normal + torch.diag(1e-3 * normal.diagonal() + 1e-9)
        return torch.linalg.inv(torch.linalg.cholesky(normal)).T.float()

    def _residuals(self, pose: Tensor) -> Tensor:
        """(4 H W,) colours and depths of (16), each by its weight, where the map is seen."""
        shown, c = self.show(pose, None), self.constants
        inside = (shown.silhouette > c.t_sil).float()
        depth = c.track_depth * self.view.trust * (shown.depth - self.view.depth) / self.unit
        color = c.track_color / 3 * (shown.features[..., :3] - self.view.colors)
        return (self.view.of_scene(torch.cat([color, depth[..., None]], -1)) * inside[..., None]).reshape(-1)

    @torch.no_grad()
    def loss(self, pose: Tensor) -> float:
        return float(self.of(pose, None))


def _converge(problem: _Problem, pose: Tensor, steps: int, level: int) -> tuple[Tensor, float]:
    """Rounds of the paper's number of steps, as long as one lowers the loss by a fiftieth."""
    loss = math.inf
    for _ in range(_ROUNDS[level]):
        before = loss
        pose, loss = _descend(problem, pose, steps, _RATES[level])
        if loss > 0.98 * before:
            break
    return pose, loss


def _descend(problem: _Problem, start: Tensor, steps: int, rates: tuple[float, float]) -> tuple[Tensor, float]:
    """Adam in the coordinates of `basis`, its rate falling from the first to the last; the best pose seen, its loss."""
    basis = problem.basis(start)
    table, best, waited = AdamTable({"y": torch.zeros(6)}), (start, math.inf), 0
    for step in range(steps):
        twist = basis @ table.values["y"]
        loss = problem.of(start, twist)
        if float(loss.detach()) < best[1]:
            best, waited = (moved(start, twist.detach().double()), float(loss.detach())), 0
        elif (waited := waited + 1) > _PATIENCE:
            break
        (gradient,) = torch.autograd.grad(loss, table.values["y"])
        table.step({"y": gradient}, {"y": rates[0] * (rates[1] / rates[0]) ** (step / max(steps - 1, 1))})
    return best
