"""gsplat's rasteriser beside this project's at equal Gaussians, sizes and features, where it is installed."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.types import Intrinsics
from on_card.rows import Rows, first_seconds, milliseconds
from on_card.scenes import CARD, SIZES, world_of


def beside_gsplat(rows: Rows) -> None:
    """Colours and depth of every room, forward and with gradients of positions, radii, opacities and colours."""
    try:
        from gsplat import __version__, rasterization
    except ImportError as error:
        rows.add("gsplat", of=f"not installed: {error}")
        return
    for row in SIZES.rows:
        case = f"{row[0]}x{row[1]}, {row[2]}"
        with rows.attempt(f"gsplat, {case}"):
            leaves, k = world_of(row, CARD)
            tasks: dict[str, Callable[[], tuple[Tensor, Tensor]]] = {
                "msgs-slam": lambda leaves=leaves, k=k: _ours(leaves, k),
                f"gsplat {__version__}": lambda leaves=leaves, k=k: _theirs(rasterization, leaves, k, False),
                f"gsplat {__version__}, packed": lambda leaves=leaves, k=k: _theirs(rasterization, leaves, k, True),
            }
            shown = {}
            for name, draw in tasks.items():
                first = first_seconds(lambda draw=draw, leaves=leaves: _gradient(draw, leaves), CARD.device)
                shown[name] = draw()[0].detach()
                torch.cuda.reset_peak_memory_stats()
                before = torch.cuda.memory_allocated()
                both = milliseconds(
                    lambda draw=draw, leaves=leaves: _gradient(draw, leaves), CARD.device, SIZES.repeats
                )
                peak = (torch.cuda.max_memory_allocated() - before) / 1e6
                with torch.no_grad():
                    forward = milliseconds(draw, CARD.device, SIZES.repeats)
                off = (shown[name] - shown["msgs-slam"]).abs()
                rows.add("gsplat", case=case, of=name, forward_ms=forward, both_ms=both, peak_mb=round(peak, 1),
                         first_seconds=round(first, 2), mean_difference=float(off.mean()))  # fmt: skip


def _gradient(draw: Callable[[], tuple[Tensor, Tensor]], leaves: list[Tensor]) -> tuple[Tensor, ...]:
    images = draw()
    return torch.autograd.grad(images, leaves, [torch.ones_like(x) for x in images])


def _ours(leaves: list[Tensor], k: Intrinsics) -> tuple[Tensor, Tensor]:
    image = render(*leaves, torch.eye(4, dtype=torch.float64), k)
    return image.features, image.depth


def _theirs(rasterization: Any, leaves: list[Tensor], k: Intrinsics, packed: bool) -> tuple[Tensor, Tensor]:
    """Expected depth, as ours: the depth sum over the silhouette."""
    means, radii, opacities, colors = leaves
    turned = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    matrix = means.new_tensor([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])[None]
    image, _, _ = rasterization(
        means, turned, radii[:, None].expand(-1, 3), opacities, colors, torch.eye(4, device=means.device)[None], matrix,
        k.width, k.height, render_mode="RGB+ED", eps2d=0.0, packed=packed,
    )  # fmt: skip
    return image[0, ..., :3], image[0, ..., 3]
