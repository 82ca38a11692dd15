"""How far results of the card's kernels are from the references': renderer, mapping and stereo."""

from typing import Any

import numpy as np
import reference
import torch
from render_scenes import IMAGES, NAMES, room
from torch import Tensor

import msgs_slam.pipelines.depth.stereo.matching as matching
from msgs_slam.pipelines.depth.stereo import cuda
from msgs_slam.pipelines.depth.stereo.consistency import fuse_depths
from msgs_slam.pipelines.depth.stereo.sweep import refine_inverse_depth, sweep_cost
from msgs_slam.pipelines.depth.stereo.volume import Bands, smooth_cost
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.mapping.cuda_losses import card_loss, color_errors_on_card, fit_exposure_on_card
from msgs_slam.pipelines.mapping.losses import Objective, expose, fit_exposure
from msgs_slam.pipelines.mapping.state import KEYS
from msgs_slam.pipelines.render.api import Rendering, composite, in_view, project_map, render
from msgs_slam.pipelines.system.adam import descend
from on_card.rows import Rows
from on_card.scenes import CARD, CPU, SIZES, StereoScene, mapper, step, stereo_scene, there, world_of
from tests.dense_volumes import of_dense, to_dense
from tests.plain_adam import plain_descend

POSE = se3.exp(torch.tensor([0.03, -0.02, 0.04, 0.01, -0.02, 0.005], dtype=torch.float64))
RELATIVE, FAR, SHARE = 1e-3, 1e-3, 0.02
"""A result agrees by ‖ours - exact‖ ≤ RELATIVE ‖exact‖; one of stereo where at most SHARE of the pixels are FAR off:
rounding decides there whether a pixel is seen, and which of two depths is taken."""
MOVED = 0.02
"""Relative error of what a few visits move: where a gradient is nearly 0 rounding may turn it."""


def agree(rows: Rows, case: str, of: str, ours: Any, exact: Any, limit: float = RELATIVE, pixels: bool = False) -> None:
    """Add a row of errors."""
    mine, theirs = (torch.as_tensor(x).detach().cpu().double() for x in (ours, exact))
    off, size = (mine - theirs).abs(), float(theirs.abs().max())
    relative = float((mine - theirs).norm() / theirs.norm()) if size else float(mine.norm())
    share = float((off > FAR * max(size, 1e-12)).double().mean())
    fine = share <= SHARE if pixels else relative <= limit
    rows.add("errors", case=case, of=of, relative=relative, largest=float(off.max()) / max(size, 1e-12), far=share,
             agrees=bool(fine and size > 0 and torch.isfinite(mine).all()))  # fmt: skip


def errors_of_renderer(rows: Rows) -> None:
    """Compositing, rendering with the pose's gradient, inspection and culling, against the reference in float64."""
    row = SIZES.rows[0]
    with rows.attempt("compositing"):
        _compositing(rows, row, row[3])
    with rows.attempt("compositing of colours"):
        _compositing(rows, row, 0)
    with rows.attempt("rendering"):
        _rendering(rows, row)
    with rows.attempt("inspection"):
        _inspection(rows, row)
    with rows.attempt("culling"):
        _culling(rows, row)


def _projected(row: tuple[int, int, int, int], classes: int) -> list[Tensor]:
    scene = room(*row)
    features = torch.cat([scene.colors, scene.logits[:, :classes]], 1)
    with CPU.used():
        projected = project_map(scene.means, scene.radii, POSE, scene.intrinsics)
    return [x.detach() for x in (*projected, scene.opacities, features)]


def _compositing(rows: Rows, row: tuple[int, int, int, int], classes: int) -> None:
    given, found = _projected(row, classes), []
    for backend, device, kind in (("cuda", CARD.device, torch.float32), (reference, "cpu", torch.float64)):
        leaves = [x.to(device, kind, copy=True).requires_grad_() for x in given]
        image = composite(*leaves, *row[:2], backend=backend)
        images = [getattr(image, name) for name in IMAGES]
        found.append([*images, *torch.autograd.grad(images, leaves, _pulls(images))])
    case = f"composite, {3 + classes} features"
    for of, ours, exact in zip((*IMAGES, *(f"d {name}" for name in NAMES)), *found, strict=True):
        agree(rows, case, of, ours, exact)


def _pulls(images: list[Tensor]) -> list[Tensor]:
    generator = torch.Generator().manual_seed(5)
    return [torch.randn(x.shape, generator=generator).to(x) for x in images]


def _rendering(rows: Rows, row: tuple[int, int, int, int]) -> None:
    found = []
    for backend, place, kind in (("cuda", CARD, torch.float32), (reference, CPU, torch.float64)):
        world, k = world_of(row, place, kind)
        leaves = [*world, POSE.to(place.device, kind, copy=True).requires_grad_()]
        with place.used():
            image = render(*leaves, k, backend=backend)
        images = list(vars(image).values())
        found.append([*images, *torch.autograd.grad(images, leaves, _pulls(images))])
    names = (*vars(image), "d means", "d radii", "d opacities", "d colours", "d pose")
    for of, ours, exact in zip(names, *found, strict=True):
        agree(rows, "render", of, ours, exact)


def _inspection(rows: Rows, row: tuple[int, int, int, int]) -> None:
    import msgs_slam.pipelines.render.cuda as cuda

    found = []
    for module, device, kind in ((cuda, CARD.device, torch.float32), (reference, "cpu", torch.float64)):
        geometry = [x.to(device, kind) for x in _projected(row, 0)[:5]]
        found.append(module.inspect(*geometry, *row[:2], 0.0, None))
    for of, ours, exact in zip(("median depth", "weights' sums", "largest weights"), *found, strict=True):
        agree(rows, "inspect", of, ours, exact, pixels=of == "median depth")


def _culling(rows: Rows, row: tuple[int, int, int, int]) -> None:
    import msgs_slam.pipelines.render.cuda_projection as projection

    scene = room(*row)
    means = scene.means * torch.tensor([3.0, 3.0, 1.0])
    given = (x.to(CARD.device) for x in (means, scene.radii, POSE.float()))
    marks = projection.mark_in_view(*given, scene.intrinsics, 0.01)
    exact = torch.zeros(len(means))
    exact[in_view(means, scene.radii, POSE, scene.intrinsics)] = 1
    agree(rows, "mark_in_view", "marks", marks, exact)


def errors_of_mapping(rows: Rows) -> None:
    """Adam, the loss and its gradients, exposures, and what a few visits do to a map."""
    with rows.attempt("Adam"):
        _adam(rows)
    with rows.attempt("loss"):
        _loss(rows)
    with rows.attempt("visits"):
        _visits(rows)


def _adam(rows: Rows) -> None:
    generator, count = torch.Generator().manual_seed(1), SIZES.gaussians
    start = [torch.rand(count, 3, generator=generator) for _ in range(3)]
    chosen = torch.randperm(count, generator=generator)[: count // 2]
    shares, gradient = torch.rand(len(chosen), generator=generator), torch.randn(len(chosen), 3, generator=generator)
    gradient[torch.rand(gradient.shape, generator=generator) < 0.3] = 0
    ours = [x.to(CARD.device, copy=True) for x in start]
    places = (x.to(CARD.device) for x in (gradient, shares, chosen))
    g, s, r = places
    descend(ours[0], g, ours[1], ours[2], 0.1, 6, s, r)
    parts = [x[chosen].double() for x in start]
    plain_descend(parts[0], gradient.double(), parts[1], parts[2], 0.1, 6, shares.double())
    for of, mine, exact in zip(("values", "first moments", "second moments"), ours, parts, strict=True):
        agree(rows, "Adam", of, mine.cpu()[chosen], exact)


def _loss(rows: Rows) -> None:
    with CPU.used():
        optimiser = mapper(CPU)
    view, generator = optimiser.views[1], torch.Generator().manual_seed(3)
    size = view.image.shape[:2]
    features = (view.colors + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)
    depth, silhouette = view.depth + 0.1, 0.9 + 0.1 * torch.rand(size, generator=generator)
    radii = torch.randn(700, generator=generator) - 2.0
    marks, exposure = torch.rand(700, generator=generator) > 0.4, torch.tensor([[0.1, -0.2, 0.05], [0.01, 0.02, -0.1]])
    objective, found = Objective(optimiser.settings, optimiser.unit), []
    for place, kind in ((CARD, torch.float32), (CPU, torch.float64)):
        given = (features, depth, silhouette, radii)
        leaves = [x.to(place.device, kind, copy=True).requires_grad_() for x in given]
        with place.used():
            seen = (there(view, place), exposure.to(place.device, kind), Rendering(*leaves[:3]))
            if place.kernels:
                value = card_loss(objective, *seen, leaves[3], marks.to(place.device))
            else:
                value = objective.of(*seen, leaves[3][marks])
            found.append([value, *torch.autograd.grad(value, leaves)])
    for of, ours, exact in zip(("value", "d colours", "d depth", "d silhouette", "d radii"), *found, strict=True):
        agree(rows, "loss", of, ours, exact)
    own, fitted = there(view, CARD), exposure.to(CARD.device)
    errors = color_errors_on_card(features.to(CARD.device), own, fitted)
    agree(rows, "colour errors", "image", errors, (expose(features, exposure) - view.colors).abs().mean(-1))
    fit_exposure_on_card(Rendering(*(x.to(CARD.device) for x in (features, depth, silhouette))), own, fitted)
    known = silhouette > 0.9
    exact = fit_exposure(features.double(), view.colors.double(), known, exposure.double())
    agree(rows, "exposure", "gains and offsets", fitted, exact)


def _visits(rows: Rows) -> None:
    found = []
    for place in (CARD, CPU):
        with place.used():
            optimiser = mapper(place)
            state = optimiser.state
            before = {k: state.parameters[k].detach().cpu().clone() for k in KEYS}
            for i in range(SIZES.views):
                optimiser.step(step(i, note=True))
            moved = {k: state.parameters[k].detach().cpu() - before[k] for k in KEYS}
            rest = dict(zip(("weights", "errors"), state.parameters.noted.unbind(1), strict=True))
            optimiser.count_labels()
            found.append({**moved, **rest, "classes": state.parameters.class_logits})
    for of, ours in found[0].items():
        agree(rows, f"{2 * SIZES.views} visits", of, ours, found[1][of], limit=MOVED)


def errors_of_stereo(rows: Rows) -> None:
    """Each step of the match, the whole of it, and the comparison of depths, against the CPU's kernels."""
    scene, bands = stereo_scene(), Bands(1)
    with rows.attempt("steps of stereo"):
        _stereo_steps(rows, scene, bands)
    with rows.attempt("match"):
        exact = matching.match_planes(scene.images, scene.planes, bands)
        agree(rows, "stereo", "match", cuda.match_planes(scene.images, scene.planes, CARD.device), exact, pixels=True)
    with rows.attempt("fusing"):
        given = (scene.depth, scene.others, scene.warps, scene.back, 0.01)
        found = (cuda.fuse_depths(*given, CARD.device), fuse_depths(*given, bands))
        for of, ours, theirs in zip(("fused depth", "support", "conflict"), *found, strict=True):
            agree(rows, "stereo", of, ours, theirs, pixels=True)


def _stereo_steps(rows: Rows, scene: StereoScene, bands: Bands) -> None:
    on_card, best = cuda.CudaMatcher.of(scene.images, CARD.device), matching.best_count(len(scene.images.others))
    cost = on_card.cost(scene.planes)
    exact = to_dense(sweep_cost(*scene.images, scene.planes, best, bands))
    agree(rows, "stereo", "costs", cost, exact, pixels=True)
    dense = of_dense(exact)
    smooth = to_dense(smooth_cost(dense, scene.images.image, matching.SMALL_STEP, matching.JUMP, matching.EDGE, bands))
    ours = on_card.smoothed(torch.from_numpy(exact).to(CARD.device), matching.SMALL_STEP)
    agree(rows, "stereo", "smoothed", ours, smooth, pixels=True)
    inverse = (1 / scene.depth + 0.005 * np.random.default_rng(2).standard_normal(scene.depth.shape)).astype(np.float32)
    moves = (0.01, matching.REACH, matching.STIFFNESS, best, bands)
    refined = refine_inverse_depth(*scene.images, inverse, *moves)
    agree(
        rows,
        "stereo",
        "refined",
        on_card.refined(torch.from_numpy(inverse).to(CARD.device), 0.01),
        refined,
        pixels=True,
    )
