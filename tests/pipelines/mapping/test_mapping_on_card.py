"""Mapping by Triton's kernels against the same by torch's own functions: on a card, else in Triton's interpreter."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

ON_CARD = torch.cuda.is_available()
if not ON_CARD:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install '.[cuda-check]'")

from msgs_slam.pipelines.config import MappingConfig  # noqa: E402
from msgs_slam.pipelines.mapping import cuda_losses, growth, losses  # noqa: E402
from msgs_slam.pipelines.mapping.cuda_losses import (  # noqa: E402
    card_loss,
    color_errors_on_card,
    fit_exposure_on_card,
)
from msgs_slam.pipelines.mapping.losses import Objective, expose, fit_exposure  # noqa: E402
from msgs_slam.pipelines.mapping.optimise import (  # noqa: E402
    MapOptimiser,
    Step,
    optimise_map,
)
from msgs_slam.pipelines.mapping.state import (  # noqa: E402
    KEYS,
    OptimiserState,
)
from msgs_slam.pipelines.mapping.views import MappingInput, View  # noqa: E402
from msgs_slam.pipelines.render import cuda  # noqa: E402
from msgs_slam.pipelines.render.api import Rendering  # noqa: E402
from msgs_slam.pipelines.system import gpu  # noqa: E402
from msgs_slam.pipelines.types import VOID, Intrinsics  # noqa: E402
from tests.card_builds import build  # noqa: E402

DEVICE = "cuda" if ON_CARD else "cpu"
EXPOSURE = torch.tensor([[0.1, -0.2, 0.05], [0.01, 0.02, -0.1]])
UNIT = 2.0


@pytest.fixture(autouse=True)
def kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter takes the tensors of the CPU: float32 ones go to the kernels, as those of a card would."""
    monkeypatch.setattr(gpu, "supports_triton", lambda example: example.dtype == torch.float32)
    if not ON_CARD:  # the interpreter takes as long for a small step as for a large one
        monkeypatch.setattr(cuda, "TILE", 32)
        monkeypatch.setattr(cuda, "STEP_BACK", 32)
        monkeypatch.setattr(cuda_losses, "_BLOCK", 4096)


def made_view(size: tuple[int, int], classes: int, masked: bool, generator: torch.Generator) -> tuple[View, Tensor]:
    """A view of random maps, some of them unknown, and features (H, W, 3 + classes) that resemble its photo."""
    features = torch.randn(*size, 3 + classes, generator=generator)
    features[..., :3] = torch.rand(*size, 3, generator=generator)
    photo = 255 * (0.7 * features[..., :3] + 0.3 * torch.rand(*size, 3, generator=generator))
    labels = torch.randint(0, max(classes, 1), size, generator=generator)
    bytes_of = [torch.randint(0, 256, size, generator=generator).to(torch.uint8) for _ in range(2)]
    view = View(
        0, Intrinsics(size[1], size[0], 50, 50, size[1] / 2, size[0] / 2), torch.eye(4, dtype=torch.float64),
        photo.to(torch.uint8), (4 * torch.rand(size, generator=generator) - 1).clamp(min=0), bytes_of[0],
        torch.where(torch.rand(size, generator=generator) < 0.2, VOID, labels).to(torch.uint8), bytes_of[1],
        scene=torch.rand(size, generator=generator) > 0.3 if masked else None,
    )  # fmt: skip
    return view, features


def there(view: View) -> View:
    tensors = {k: x.to(DEVICE) for k, x in vars(view).items() if isinstance(x, Tensor) and k != "cam_from_world"}
    return replace(view, **tensors)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(24, 31), (5, 70), (64, 8)])
def test_the_loss_has_the_plain_value_and_gradient(size: tuple[int, int], masked: bool) -> None:
    """Also of pictures smaller than the window."""
    generator = torch.Generator().manual_seed(3)
    view, features = made_view(size, 0, masked, generator)
    depth, silhouette = (torch.rand(size, generator=generator) * k for k in (3, 1))
    log_radii = torch.randn(700, generator=generator) - 2.0
    in_view = torch.rand(700, generator=generator) > 0.4
    objective, found = Objective(MappingConfig(), UNIT), []
    for place, device, kind in ((there, DEVICE, torch.float32), (lambda v: v, "cpu", torch.float64)):
        leaves = [x.to(device, kind, copy=True).requires_grad_() for x in (features, depth, silhouette, log_radii)]
        seen = (place(view), EXPOSURE.to(device, kind), Rendering(*leaves[:3]))
        if kind == torch.float32:
            value = card_loss(objective, *seen, leaves[3], in_view.to(device))
        else:
            value = objective.of(*seen, leaves[3][in_view])
        found.append([value.detach(), *torch.autograd.grad(3 * value, leaves)])
    for mine, theirs in zip(*found, strict=True):
        assert theirs.abs().max() > 0
        assert (mine.cpu().double() - theirs).abs().max() < 1e-5 * theirs.abs().max()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(60, 83), (12, 16)])
def test_the_exposure_is_fitted_in_place(size: tuple[int, int], masked: bool) -> None:
    """As in double precision; too few pixels change nothing."""
    generator = torch.Generator().manual_seed(4)
    view, features = made_view(size, 2, masked, generator)
    silhouette = 0.8 + 0.2 * torch.rand(size, generator=generator)
    rendering = Rendering(features.to(DEVICE), silhouette.to(DEVICE), silhouette.to(DEVICE))
    exposures = EXPOSURE.repeat(2, 1, 1).to(DEVICE)
    fit_exposure_on_card(rendering, there(view), exposures[1])
    known = view.of_scene(silhouette) > 0.9
    exact = fit_exposure(features[..., :3].double(), view.colors.double(), known, EXPOSURE.double())
    torch.testing.assert_close(exposures[1].cpu().double(), exact, rtol=1e-5, atol=1e-6)
    assert torch.equal(exposures[0].cpu(), EXPOSURE)
    assert torch.equal(exact, EXPOSURE.double()) == (size == (12, 16))


@pytest.mark.parametrize("masked", [False, True])
def test_the_errors_of_colors_are_the_plain_ones(masked: bool) -> None:
    view, features = made_view((23, 40), 1, masked, torch.Generator().manual_seed(5))
    found = color_errors_on_card(features.to(DEVICE), there(view), EXPOSURE.to(DEVICE)).cpu()
    plain = view.of_scene((expose(features[..., :3], EXPOSURE) - view.colors).abs().mean(-1))
    torch.testing.assert_close(found, plain, rtol=1e-5, atol=1e-6)
    assert 0.01 < plain.mean() < 0.5


def middle(view: View, width: int, height: int) -> View:
    """What a part of the image shows: the interpreter's time grows with the tiles."""
    camera = view.intrinsics
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    rows, columns = slice(top, top + height), slice(left, left + width)
    maps = {k: x for k, x in vars(view).items() if isinstance(x, Tensor) and k != "cam_from_world"}
    moved = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
    return replace(view, intrinsics=moved, **{k: x[rows, columns].contiguous() for k, x in maps.items()})


@pytest.fixture(scope="module")
def started(room: MappingInput) -> Any:
    """A map of the middle of the room's first views, and the views."""
    views = [middle(room.views[i], 64, 48) for i in range(2)]
    settings = MappingConfig(passes=1.0, min_iterations=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu, "supports_triton", lambda example: False)
        patch.setattr(growth, "SEED_STRIDE", 5)
        return views, optimise_map(views, len(room.class_ids), settings, seed=0), len(room.class_ids)


def test_visits_are_those_of_the_cpu(started: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Map, poses and exposures after a pass, classes, what the map is pruned and split by."""
    views, first, classes = started
    found, colors = [], first.gaussian_map.colors
    apart = 0.1 * torch.randn(colors.shape, generator=torch.Generator().manual_seed(0))
    for takes, place in ((True, there), (False, lambda v: v)):
        # On a card the poses stay with the host, whose tensors no kernel takes.
        monkeypatch.setattr(
            gpu, "supports_triton", lambda example, takes=takes: takes and (example.is_cuda or not ON_CARD)
        )
        own = [place(v) for v in views]
        gaussians = type(first.gaussian_map)(
            **{k: x.to(own[0].image.device, copy=True) for k, x in vars(first.gaussian_map).items()}
        )
        # Solved colours have hardly a gradient; and of one that is nearly 0 rounding may turn Adam's first steps round.
        gaussians.colors.add_(apart.to(gaussians.colors))
        state = OptimiserState.fresh(own, classes, gaussians, (first.log_gains, first.offsets))
        before = {k: state.parameters[k].detach().cpu().clone() for k in KEYS}
        optimiser = MapOptimiser(own, classes, MappingConfig(), state)
        for i in (0, 1, 0, 1):
            optimiser.step(Step(i, 1.3, 0.5, False, note=True, refine_pose=i > 0))
        result = state.result(own, 4)
        moved = {k: state.parameters[k].detach().cpu() - before[k] for k in KEYS}
        optimiser.count_labels()
        poses = torch.from_numpy(result.cam_from_world - first.cam_from_world)
        exposures = torch.from_numpy(np.stack([result.log_gains, result.offsets]))
        rest = {"classes": state.parameters.class_logits, "poses": poses, "exposures": exposures}
        rest["weights"], rest["errors"] = state.parameters.noted.unbind(1)
        found.append({k: x.cpu().double() for k, x in (moved | rest).items()})
    for name, mine in found[0].items():
        theirs = found[1][name]
        assert theirs.abs().max() > 0
        assert (mine - theirs).norm() < 0.02 * theirs.norm(), name


@pytest.mark.skipif(ON_CARD, reason="the tests above compile and run the kernels")
def test_the_kernels_compile_for_cards(tmp_path: Path) -> None:
    kernels = {
        "mapping.cuda_losses": [
            "expose_colors", "blur_planes", "compare_moments", "differentiate", "color_errors", "fit_color",
            "compare_maps", "weigh_sizes",
        ],
    }  # fmt: skip
    constants = {"MASKED": True, "BLOCK": 128, "TAPS": 11, "C1": 1e-4, "C2": 9e-4, "SHARE": 0.2, "STRIDE": 4}
    constants |= {"SOLID": 0.9, "MIN_PIXELS": 100, "OUTLIER": 0.02, "RIDGE": 0.003, "MAX_GAIN": 5.0, "NU": losses.NU}
    numbers = ("stride", "size", "row", "step", "numbers", "width", "height", "pixels", "count")
    kinds = dict.fromkeys(numbers, "i32") | dict.fromkeys(("limit", "by_silhouette", "by_depth"), "fp32")
    masks = ("photo", "scene", "reliability", "in_view")
    build(kernels, constants, kinds | dict.fromkeys(masks, "*u8") | {"number": "*i64"}, tmp_path)
