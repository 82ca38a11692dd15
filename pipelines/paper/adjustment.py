"""Semantic bundle adjustment (section 3.5): poses, the scale fields of the proxy depths, and the map, together.

A network's depth is off by several per cent, smoothly over an image; that has to come out between views. So each
keyframe's proxy has a smooth scale field (`depth/fields.py`), and its Gaussians move along their rays with it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ..compute.adam import AdamTable
from ..depth.fields import FINE
from ..geometry import se3
from ..geometry.camera import project
from ..global_ba.close import Edges, optimise_pose_graph
from ..mapping.views import View
from ..types import Intrinsics, LoopEdge
from .constants import PAPER, Constants
from .gaussians import Gaussians, scaled_depth, semantic_image, show
from .mapping import RATES, map_loss

Array = NDArray[np.float64]
POSE_RATE, FIELD_RATE = 5e-4, 3e-3
"""Of Adam: radians and scene depths; log scale."""
FIELD_SD, STEP_SD, PRIOR = 0.1, 0.03, 1e-3
"""Of a field's nodes, and of their differences; and the weight of both."""


def pose_term(twist: Tensor, unit: float) -> Tensor:
    """First term of Eq. (25): ‖twist‖² away from where a pose was, translation in units of the scene's depth."""
    return (twist[..., :3] / unit).square().sum() + twist[..., 3:].square().sum()


def local_adjustment(
    view: View, values: Mapping[str, Tensor], pose: Tensor, twist: Tensor, classes: int, unit: float,
    constants: Constants = PAPER,
) -> Tensor:  # fmt: skip
    """Eq. (25): pose term + semantic re-rendering + depth re-rendering of a keyframe at exp(twist) pose."""
    shown = show(values, pose, view, twist)
    truth = semantic_image(view, classes)
    known = truth.sum(-1)
    semantic = ((truth - shown.features[..., 3:]).abs().sum(-1) * known).mean() / 2
    depth = ((constants.nu * view.trust).clamp(max=1) * (view.depth - shown.depth).abs()).mean() / unit
    return pose_term(twist, unit) + constants.xi * semantic + constants.map_depth * depth


def pose_graph(poses: Array, loops: Sequence[LoopEdge], place: Mapping[int, int], depth: float) -> tuple[Array, Array]:
    """First term of Eq. (26): argmin Σ ‖E_i⁻¹ E_j ⊖ E_ij‖²_Σ over neighbours and loops, (N, 4, 4), and scales (N,).

    A rigid graph over similarities with a robust kernel for loops; `depth` is the scene's, for the covariances."""
    n = len(poses)
    first = [*range(n - 1), *(place[e.frame1_id] for e in loops)]
    second = [*range(1, n), *(place[e.frame2_id] for e in loops)]
    motions = [poses[i + 1] @ se3.inverse(poses[i]) for i in range(n - 1)] + [e.frame2_from_frame1 for e in loops]
    sd = np.tile([0.01 * depth] * 3 + [np.radians(0.5)] * 3 + [0.02], (len(first), 1))
    robust = np.arange(len(first)) >= n - 1
    edges = Edges(np.array(first), np.array(second), np.array(motions), np.ones(len(first)), sd, robust)
    return optimise_pose_graph(poses, np.ones(n), edges)


def semantic_residual(view: View, values: Mapping[str, Tensor], pose: Tensor, classes: int) -> Tensor:
    """Second term of Eq. (26): Σ_k ‖S_k - S(E_i, G_k)‖² of a keyframe, the mean over its labelled pixels."""
    truth = semantic_image(view, classes)
    shown = show(values, pose, view).features[..., 3:]
    return ((truth - shown).square().sum(-1) * truth.sum(-1)).mean()


@dataclass
class Adjustment:
    """Unknowns of (26) beside the map's: poses (N, 4, 4) float64 moved by twists (N, 6), log scale fields (N, nodes).

    The Gaussians are bound to their anchors: in_cam (M, 3) is where each lies in its keyframe's camera while the
    keyframe's field is 0; rows (M,) which keyframe that is; nodes and weights (M, 4) its place in the field.
    """

    gaussians: Gaussians
    poses: Tensor
    table: AdamTable
    in_cam: Tensor
    rows: Tensor
    nodes: Tensor
    weights: Tensor
    unit: float

    @staticmethod
    def of(gaussians: Gaussians, ids: Sequence[int], poses: Tensor, camera: Intrinsics, unit: float) -> "Adjustment":
        """Bind the map to keyframes (N,) at their poses; a Gaussian of no keyframe goes with the one before it."""
        known = np.array(ids)
        rows = torch.from_numpy(np.clip(np.searchsorted(known, gaussians.anchors.numpy(), side="right") - 1, 0, None))
        in_cam = _transformed(poses.float()[rows], gaussians.table.values["means"].detach())
        xy, _ = project(in_cam.double().numpy(), camera)
        basis = FINE.at(np.nan_to_num(xy), camera.width, camera.height)
        table = AdamTable({"twist": torch.zeros(len(ids), 6), "field": torch.zeros(len(ids), FINE.size)})
        nodes, weights = torch.from_numpy(basis.nodes), torch.from_numpy(basis.weights).float()
        return Adjustment(gaussians, poses, table, in_cam, rows, nodes, weights, unit)

    def means(self, which: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        """(n, 3) centres of the Gaussians `which` (n,) by the twists and fields of their anchors."""
        anchor = self.rows[which]
        logs = (values["field"].reshape(-1)[anchor[:, None] * FINE.size + self.nodes[which]] * self.weights[which]).sum(
            1
        )
        world_from_cam = se3.inverse(self.moved(values["twist"])).float()
        return _transformed(world_from_cam[anchor], self.in_cam[which] * torch.exp(logs)[:, None])

    def moved(self, twists: Tensor) -> Tensor:
        """(N, 4, 4) float64 the poses after the twists."""
        return se3.exp(twists.double()) @ self.poses

    def scales(self, field: Tensor, view: View) -> Tensor:
        """(H, W) the scale that a field (nodes,) gives the pixels of a view."""
        grid = field.reshape(1, 1, FINE.rows, FINE.columns)
        size = (view.intrinsics.height, view.intrinsics.width)
        return torch.exp(functional.interpolate(grid, size, mode="bilinear", align_corners=True)[0, 0])

    def visit(self, index: int, view: View, classes: int, rate: float, constants: Constants = PAPER) -> float:
        """Second term of Eq. (26), for one keyframe: a step of Adam on (18) by its pose, the anchors' poses and fields,
        and the map; the first keyframe stays. Returns the loss."""
        unknown = self.table.values
        with torch.no_grad():
            pose = self.moved(unknown["twist"])[index]
        which = self.gaussians.in_view(pose, view.intrinsics)
        values = self.gaussians.leaves(which)
        drawn = {**values, "means": self.means(which, unknown)}
        pose = se3.exp(unknown["twist"][index].double()) @ self.poses[index]
        scaled = scaled_depth(view, self.scales(unknown["field"][index], view))
        shown = show(drawn, pose, scaled)
        loss = map_loss(shown, scaled, values["log_radii"], classes, self.unit, constants)
        loss = loss + PRIOR * field_prior(unknown["field"][index])
        leaves = [v for k, v in values.items() if k != "means"] + [unknown["twist"], unknown["field"]]
        found = torch.autograd.grad(loss, leaves, allow_unused=True)
        own = dict(zip([k for k in values if k != "means"], found[:-2], strict=True))
        twist, field = found[-2].clone(), found[-1]
        twist[0] = 0
        self.gaussians.table.step(own, {k: r * rate for k, r in RATES.items() if k != "means"}, rows=which)
        self.table.step({"twist": twist, "field": field}, {"twist": POSE_RATE * rate, "field": FIELD_RATE * rate})
        with torch.no_grad():
            self.gaussians.table.values["means"].detach()[which] = self.means(which, unknown)
        return float(loss.detach())

    @property
    def field(self) -> Tensor:
        """(N, rows, columns) the fields by now."""
        return self.table.values["field"].detach().reshape(-1, FINE.rows, FINE.columns)

    @torch.no_grad()
    def settle(self) -> None:
        """Put every Gaussian where twists and fields say, those too that no view has shown since."""
        everything = torch.arange(len(self.rows))
        self.gaussians.table.values["means"].detach()[:] = self.means(everything, self.table.values)


def field_prior(field: Tensor) -> Tensor:
    """Cost of a field (nodes,): of nodes away from 0, and of steps between neighbours."""
    grid = field.reshape(FINE.rows, FINE.columns)
    steps = torch.cat([grid.diff(dim=0).reshape(-1), grid.diff(dim=1).reshape(-1)])
    return (grid / FIELD_SD).square().mean() + (steps / STEP_SD).square().mean()


def _transformed(motions: Tensor, points: Tensor) -> Tensor:
    return torch.einsum("nij,nj->ni", motions[:, :3, :3], points) + motions[:, :3, 3]


def adjust(
    adjustment: Adjustment, views: Callable[[int], View], count: int, classes: int, passes: int, seed: int,
    begin: int = 0, after: Callable[[int], None] = lambda done: None,
    in_order: Callable[[list[int]], Iterable[int]] = iter, constants: Constants = PAPER,
) -> None:  # fmt: skip
    """Eq. (26): every keyframe visited `passes` times in random order, at a falling rate; `after` each pass."""
    for number in range(begin, passes):
        order = np.random.default_rng([seed, number]).permutation(count).tolist()
        for k, index in enumerate(in_order(order)):
            adjustment.visit(index, views(index), classes, 0.05 ** ((number + k / count) / passes), constants)
        after(number + 1)
