"""The Triton kernels against the float64 reference: on a card where there is one, else by Triton's interpreter."""

import os

import pytest
import torch

ON_CARD = torch.cuda.is_available()
if not ON_CARD:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install '.[cuda-check]'")

import reference  # noqa: E402
from render_scenes import IMAGES, NAMES, random_gaussians, room  # noqa: E402

from msgs_slam.pipelines.geometry import se3  # noqa: E402
from msgs_slam.pipelines.render import cuda, cuda_projection  # noqa: E402
from msgs_slam.pipelines.render.api import composite, in_view, render  # noqa: E402
from msgs_slam.pipelines.render.rules import GaussianStats  # noqa: E402
from tests.card_builds import build  # noqa: E402

DEVICE = "cuda" if ON_CARD else "cpu"
SIZE = (161, 113) if ON_CARD else (37, 21)
COUNT = 20_000 if ON_CARD else 250

SCENES = {
    "transparent": {"count": COUNT, "opacity": (0.002, 0.1)},
    "opaque": {"count": COUNT, "opacity": (0.95, 1.0)},
    "sub-pixel": {"count": COUNT, "sigma": (0.01, 0.4)},
    "large": {"count": COUNT // 10, "sigma": (5.0, 60.0)},
    "all behind": {"count": 50, "behind": 1.0},
    "none": {"count": 0},
    "one": {"count": 1, "sigma": (3.0, 3.1), "opacity": (0.7, 0.8), "behind": 0.0},
}


def assert_agrees(scene, width, height):
    results = []
    for backend, device, dtype in (("cuda", DEVICE, torch.float32), (reference, "cpu", torch.float64)):
        inputs = {name: x.clone().to(device, dtype).requires_grad_() for name, x in scene.items()}
        image = composite(**inputs, width=width, height=height, backend=backend)
        images = [getattr(image, name) for name in IMAGES]
        generator = torch.Generator().manual_seed(5)
        torch.autograd.backward(images, [torch.randn(x.shape, generator=generator).to(x) for x in images])
        found = [x.detach() for x in images] + [inputs[name].grad for name in NAMES]
        results.append([x.cpu().double() for x in found])
    for name, ours, exact in zip(IMAGES, *results, strict=False):
        scale = max(1.0, float(exact.abs().max())) if exact.numel() else 1.0
        torch.testing.assert_close(ours, exact, rtol=0, atol=1e-4 * scale, msg=name)
    for name, ours, exact in zip(NAMES, results[0][4:], results[1][4:], strict=True):
        assert (ours - exact).norm() <= 1e-3 * exact.norm() + 1e-12, f"gradient of {name}"


@pytest.mark.parametrize("name", SCENES)
def test_random_scenes(name):
    scene = random_gaussians(width=SIZE[0], height=SIZE[1], channels=5, seed=len(name), **SCENES[name])
    assert_agrees(scene, *SIZE)


@pytest.mark.parametrize("channels", [1, 16, 17, 43, 64])
def test_channel_counts(channels):
    assert_agrees(random_gaussians(100, 20, 18, channels, seed=channels), 20, 18)


def test_more_gaussians_in_a_tile_than_fit_in_a_step():
    scene = random_gaussians(1500, 16, 16, 2, seed=4, sigma=(0.3, 2.0), opacity=(0.01, 0.1), behind=0.0)
    assert_agrees(scene, 16, 16)


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_inspection_is_the_references(name, counted):
    scene = random_gaussians(width=SIZE[0], height=SIZE[1], channels=1, seed=len(name), **SCENES[name])
    counts = torch.rand(SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(3)) if counted else None
    found = []
    for module, device, dtype in ((cuda, DEVICE, torch.float32), (reference, "cpu", torch.float64)):
        inputs = [scene[key].to(device, dtype) for key in ("u", "v", "sigma_px", "z", "opacity")]
        given = None if counts is None else counts.to(device, dtype)
        found.append([x.cpu().double() for x in module.inspect(*inputs, *SIZE, 0.0, given)])
    (median, sums, most), (true_median, true_sums, true_most) = found
    assert (sums - true_sums).norm() <= 1e-3 * true_sums.norm() + 1e-12
    torch.testing.assert_close(most, true_most, rtol=0, atol=1e-4)
    # Where the light is halved almost exactly, rounding may choose the next Gaussian.
    assert ((median - true_median).abs() > 1e-4).double().mean() < 2e-3
    assert bool(true_sums.any()) == (name not in ("all behind", "none"))


@pytest.mark.skipif(not ON_CARD, reason="needs an NVIDIA card")
def test_full_size_room():
    scene = room(320, 240, 50_000, 8)
    tensors = [x.to(DEVICE) for x in (scene.means, scene.radii, scene.opacities, scene.colors)]
    pose = torch.eye(4, dtype=torch.float64, device=DEVICE)
    ours = render(*tensors, pose, scene.intrinsics)
    exact = render(*(x.double() for x in tensors), pose, scene.intrinsics, backend=reference)
    worst = (ours.features - exact.features).abs().amax(-1)
    assert (worst > 1e-4).double().mean() < 1e-3


@pytest.mark.skipif(ON_CARD, reason="the tests above compile and run the kernels")
@pytest.mark.parametrize(
    ("name", "channels"), [("forward_tile", 64), ("backward_tile", 43), ("backward_tile", 3), ("inspect_tile", 1)]
)
def test_kernels_compile_for_cards_and_fit_their_shared_memory(name, channels, tmp_path):
    """The interpreter accepts more than the compiler does; compiling needs no card."""
    settings = cuda._back_settings(channels) if name == "backward_tile" else cuda._settings(channels)
    kinds = {**dict.fromkeys(("width", "height", "channels"), "i32"), "starts": "*i64"}
    build({"render.cuda": [name]}, settings | {"COUNTED": True}, kinds | {"members": "*i64"}, tmp_path)


@pytest.mark.skipif(ON_CARD, reason="the tests above compile and run the kernels")
def test_what_projects_and_lists_compiles_for_cards(tmp_path):
    constants = {"ALPHA_MIN": 1 / 255, "CUT_SIGMAS": 3.0, "TILE": cuda.TILE, "BLOCK": 256, "MOVES": True}
    long = dict.fromkeys(("touched", "ends", "keys", "order", "owners", "members", "starts"), "*i64")
    numbers = dict.fromkeys(("width", "height", "count", "pairs", "tiles"), "i32")
    numbers |= dict.fromkeys(("fx", "fy", "cx", "cy", "focal", "near"), "fp32")
    kernels = {
        "render.cuda_projection": ["project_rows", "record_rows", "mark_rows", "back_project_rows"],
        "render.cuda": ["count_tiles", "list_pairs", "order_members", "divide_pixels", "divide_back_pixels"],
    }
    build(kernels, constants, {**long, **numbers, "marks": "*u8"}, tmp_path)


POSE = se3.exp(torch.tensor([0.1, -0.05, 0.02, 0.03, -0.04, 0.05], dtype=torch.float64))


def test_a_map_is_rendered_as_by_the_reference():
    """With gradients of all that moves, the pose among it; some Gaussians lie behind the camera and some beside it.

    Rounding of a projection decides which pixels at a Gaussian's rim belong to it: the reference in float32 is the
    measure of how much of that there is.
    """
    scene = room(SIZE[0], SIZE[1], COUNT, 5)
    means = torch.cat([scene.means, scene.means[:40] * torch.tensor([1.0, 1.0, -1.0]), scene.means[:40] * 9])
    rest = [torch.cat([x, x[:40], x[:40]]) for x in (scene.radii, scene.opacities, scene.colors)]
    found = []
    kinds = (("cuda", DEVICE, torch.float32), (reference, "cpu", torch.float32), (reference, "cpu", torch.float64))
    for backend, device, kind in kinds:
        leaves = [x.to(device, kind, copy=True).requires_grad_() for x in (means, *rest, POSE)]
        image = render(*leaves, scene.intrinsics, backend=backend)
        images = [image.features, image.depth, image.silhouette]
        generator = torch.Generator().manual_seed(5)
        pulls = [torch.randn(x.shape, generator=generator).to(x) for x in images]
        gradients = torch.autograd.grad(images, leaves, pulls)
        found.append([x.detach().cpu().double() for x in (*images, *gradients)])
    for number, (ours, rounded, exact) in enumerate(zip(*found, strict=True)):
        assert exact.abs().max() > 0
        assert (ours - exact).norm() <= 1e-3 * exact.norm() + 2 * (rounded - exact).norm(), number


def test_lists_are_sorted_by_tile_then_depth_then_index():
    """Against the same said tile by tile; many Gaussians share their depth, some have one below 0."""
    scene = random_gaussians(COUNT, *SIZE, 1, seed=8, sigma=(0.1, 30.0))
    geometry = [scene[name].to(DEVICE) for name in ("u", "v", "sigma_px", "z", "opacity")]
    geometry[3] = (geometry[3] * 2).round() - 3
    records = cuda_projection.record(tuple(geometry), *SIZE, -10.0)
    starts, members = cuda.list_tiles(records, *SIZE)
    u, v, _, z, _, reach = records.cpu().unbind(1)
    side, tile = cuda.TILE, 0
    across = -(-SIZE[0] // side)
    for tile in range(len(starts) - 1):
        x, y = side * (tile % across), side * (tile // across)
        seen = (reach > 0) & (u + reach - 0.5 >= x) & (u - reach - 0.5 < x + side)
        seen &= (v + reach - 0.5 >= y) & (v - reach - 0.5 < y + side)
        # Tiles on the rim take what lies beyond it, too; it touches no pixel of theirs.
        rows = members[starts[tile] : starts[tile + 1]].cpu()
        assert set(torch.nonzero(seen)[:, 0].tolist()) <= set(rows.tolist())
        assert rows.tolist() == sorted(rows.tolist(), key=lambda i: (float(z[i]), i))
    assert tile == len(starts) - 2 > 3
    assert starts[-1] == len(members) > 200


def test_what_is_in_view_is_marked_as_on_the_cpu():
    scene = room(40, 30, 400, 3)
    means = scene.means * torch.tensor([3.0, 3.0, 1.0])
    means[::5, 2] *= -1
    marks = cuda_projection.mark_in_view(
        means.to(DEVICE), scene.radii.to(DEVICE), POSE.float().to(DEVICE), scene.intrinsics, 0.01
    )
    rows = in_view(means, scene.radii, POSE, scene.intrinsics)
    assert torch.nonzero(marks.cpu())[:, 0].tolist() == rows.tolist()
    assert 20 < len(rows) < 380


def test_the_backward_pass_stats_weights_and_errors():
    """As on the CPU. A few Gaussians of the 20,000 on a card gain or lose a pixel at their rim by rounding, as they do
    on the CPU between float32 and float64."""
    scene = room(*SIZE, COUNT, 3)
    found = []
    for backend, device in (("cuda", DEVICE), ("cpu", "cpu")):
        tensors = [x.to(device) for x in (scene.means, scene.radii, scene.opacities, scene.colors)]
        stats = GaussianStats()
        tensors[3].requires_grad_()
        shown = render(*tensors, POSE, scene.intrinsics, backend=backend, stats=stats).features
        stats.errors = (shown.detach() - 0.3).abs().mean(-1)
        shown.sum().backward()
        found.append((stats.largest, stats.error_share))
    for ours, theirs in zip(*found, strict=True):
        seen = found[1][1] > 0
        assert seen.any()
        off = (ours.cpu() - theirs)[seen].abs() > 1e-4 + 2e-3 * theirs[seen].abs()
        assert off.double().mean() < 1e-3
