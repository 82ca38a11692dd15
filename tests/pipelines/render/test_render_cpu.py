"""The compiled renderer against the float64 reference: images to 1e-4, gradients to 1e-3, same bytes always."""

import pytest
import reference
import torch
from render_scenes import IMAGES, NAMES, random_gaussians, room
from torch import Tensor

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.render.api import composite, moved, project_map, render
from msgs_slam.pipelines.system.threads import get_threads, set_threads
from msgs_slam.pipelines.types import Intrinsics


@pytest.fixture(autouse=True)
def _default_threads():
    yield
    set_threads(0)


def run(
    scene: dict[str, Tensor],
    width: int,
    height: int,
    backend: str,
    dtype: torch.dtype,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Images, and gradients of a fixed random weighting of all of them."""
    inputs = {name: tensor.detach().clone().to(dtype).requires_grad_() for name, tensor in scene.items()}
    image = composite(**inputs, width=width, height=height, backend=backend)
    images = {name: getattr(image, name) for name in IMAGES}
    generator = torch.Generator().manual_seed(5)
    upstream = [torch.randn(x.shape, generator=generator).to(dtype) for x in images.values()]
    torch.autograd.backward(list(images.values()), upstream)
    gradients = {name: inputs[name].grad for name in NAMES}
    return {name: x.detach() for name, x in images.items()}, gradients


def assert_agrees(scene: dict[str, Tensor], width: int, height: int) -> None:
    images, gradients = run(scene, width, height, "cpu", torch.float32)
    expected, expected_gradients = run(scene, width, height, reference, torch.float64)
    for name in IMAGES:
        # Depths are larger than 1; what counts is the error of their ratio.
        scale = max(1.0, float(expected[name].abs().max())) if images[name].numel() else 1.0
        torch.testing.assert_close(images[name].double(), expected[name], rtol=0, atol=1e-4 * scale, msg=name)
    for name in gradients:
        error = (gradients[name].double() - expected_gradients[name]).norm()
        assert error <= 1e-3 * expected_gradients[name].norm() + 1e-12, f"gradient of {name}: {error}"


MOVED = se3.exp(torch.tensor([0.03, -0.02, 0.04, 0.01, -0.02, 0.005], dtype=torch.float64))

SCENES = {
    "transparent": {"count": 2000, "opacity": (0.002, 0.1)},
    "opaque": {"count": 2000, "opacity": (0.95, 1.0)},
    "sub-pixel": {"count": 3000, "sigma": (0.01, 0.4)},
    "large": {"count": 300, "sigma": (5.0, 60.0)},
    "huge and near": {"count": 200, "sigma": (100.0, 5000.0), "opacity": (0.01, 0.5)},
    "mixed": {"count": 1500, "sigma": (0.02, 300.0)},
    "all behind": {"count": 50, "behind": 1.0},
    "none": {"count": 0},
    "one": {"count": 1, "sigma": (3.0, 3.1), "opacity": (0.7, 0.8), "behind": 0.0},
}


@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize("name", SCENES)
def test_random_scenes(name, channels):
    width, height = 75, 53
    scene = random_gaussians(width=width, height=height, channels=channels, seed=len(name), **SCENES[name])
    assert_agrees(scene, width, height)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 200), (161, 2), (16, 32), (33, 65)])
def test_image_sizes(width, height):
    assert_agrees(random_gaussians(400, width, height, 3, seed=width), width, height)


@pytest.mark.parametrize("channels", [1, 3, 11, 16, 17, 64])
def test_channel_counts(channels):
    assert_agrees(random_gaussians(500, 40, 30, channels, seed=channels), 40, 30)


def test_no_channels():
    scene = random_gaussians(300, 30, 20, 0, seed=8)
    images, _ = run(scene, 30, 20, "cpu", torch.float32)
    expected, _ = run(scene, 30, 20, reference, torch.float64)
    torch.testing.assert_close(images["silhouette"].double(), expected["silhouette"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("opacity", [(0.004, 0.02), (0.3, 1.0)])
def test_a_hundred_thousand_in_one_tile(opacity):
    scene = random_gaussians(100_000, 16, 16, 3, seed=4, sigma=(0.3, 0.8), opacity=opacity)
    assert_agrees(scene, 16, 16)


def test_full_size_room():
    """320 x 240, 50 000 Gaussians, colours alone and 11 channels: two million pairs of a pixel and a Gaussian."""
    scene = room(320, 240, 50_000, 8)
    u, v, sigma, z = project_map(scene.means, scene.radii, MOVED, scene.intrinsics)
    for features in (scene.colors, torch.cat([scene.colors, scene.logits], 1)):
        assert_agrees(dict(zip(NAMES, (u, v, sigma, z, scene.opacities, features), strict=True)), 320, 240)


def test_the_projection_is_that_of_torch():
    """Values and gradients beside autograd's in float64, also of centres too near and behind; the same bytes for any
    number of threads."""
    generator = torch.Generator().manual_seed(2)
    means = torch.randn(40_000, 3, generator=generator) + torch.tensor([0.0, 0.0, 1.0])
    radii = torch.rand(40_000, generator=generator)
    upstream = [torch.randn(40_000, generator=generator) for _ in range(4)]
    camera, found = Intrinsics(64, 48, 50, 60, 31, 25), []
    for dtype, threads in ((torch.float64, 1), (torch.float32, 1), (torch.float32, 3)):
        set_threads(threads)
        given = [means.to(dtype).clone().requires_grad_(), radii.to(dtype).clone().requires_grad_()]
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        shown = project_map(*given, moved(MOVED, twist), camera, near=0.3)
        torch.autograd.backward(list(shown), [x.to(dtype) for x in upstream])
        found.append([*(x.detach() for x in shown), *(x.grad for x in (*given, twist))])
    exact, ours, threaded = found
    assert 0.1 < (exact[3] <= 0.3).double().mean() < 0.9
    for a, b, c in zip(exact, ours, threaded, strict=True):
        assert (b.double() - a).norm() < 1e-5 * a.norm()
        assert torch.equal(b, c)


@pytest.mark.parametrize("classes", [0, 8])
def test_map_and_pose_gradients_through_the_projection(classes):
    """The judge is given the centres as float32 rounds them: 1e-5 pixel is enough to move a pixel over the edge of a
    Gaussian, and how float32 rounds is the machine's own affair. Its gradients go through its own projection."""
    scene = room(160, 120, 12_000, 8)
    features = torch.cat([scene.colors, scene.logits[:, :classes]], 1)
    rounded: list[Tensor] = []
    results = []
    for backend, dtype in (("cpu", torch.float32), (reference, torch.float64)):
        tensors = (scene.means, scene.radii, scene.opacities, features)
        tensors = [x.clone().to(dtype).requires_grad_() for x in tensors]
        twist = torch.zeros(6, dtype=dtype, requires_grad=True)
        projected = project_map(*tensors[:2], moved(MOVED, twist), scene.intrinsics)
        rounded = rounded or [x.detach() for x in projected]
        projected = [x + (value.to(dtype) - x).detach() for x, value in zip(projected, rounded, strict=True)]
        image = composite(*projected, *tensors[2:], 160, 120, backend=backend)
        outputs = (image.features, image.depth_sum, image.silhouette)
        generator = torch.Generator().manual_seed(1)
        upstream = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(dtype) for x in outputs]
        torch.autograd.backward(outputs, upstream)
        results.append([*(x.detach() for x in outputs), *(x.grad for x in (*tensors, twist))])
    for name, ours, exact in zip(("image", "depth sum", "silhouette"), *results, strict=False):
        assert (ours - exact).abs().max() < 1e-4 * max(1.0, float(exact.max())), name
    names = ("means", "radii", "opacities", "features", "twist")
    for name, ours, exact in zip(names, results[0][3:], results[1][3:], strict=True):
        assert (ours - exact).norm() < 1e-3 * exact.norm(), name


def test_same_bytes_for_any_number_of_threads():
    width, height = 90, 400
    scene = random_gaussians(4000, width, height, 3, seed=6, sigma=(0.3, 30.0))
    first = None
    for threads in (1, 2, 4, 1, 3):
        set_threads(threads)
        assert get_threads() == threads
        images, gradients = run(scene, width, height, "cpu", torch.float32)
        found = [x.numpy().tobytes() for x in (*images.values(), *gradients.values())]
        first = first or found
        assert found == first
    with pytest.raises(ValueError, match="threads"):
        set_threads(-1)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("backend", ["cpu", reference])
def test_values_that_are_not_finite_are_named(name, value, backend):
    scene = random_gaussians(50, 20, 20, 3, seed=7)
    scene[name].view(-1)[17] = value
    with pytest.raises(ValueError, match=f"^{name}: 1 of "):
        composite(**scene, width=20, height=20, backend=backend)


def test_large_finite_values_are_no_error():
    """Their sum overflows, they do not."""
    scene = random_gaussians(50, 20, 20, 1, seed=7)
    scene["features"][:] = 3e38
    image = composite(**scene, width=20, height=20)
    assert image.silhouette.max() > 0


def test_wrong_arguments_are_refused():
    scene = random_gaussians(5, 20, 20, 3, seed=7)
    with pytest.raises(ValueError, match="opacity: got shape"):
        composite(**{**scene, "opacity": scene["opacity"][:4]}, width=20, height=20)
    with pytest.raises(ValueError, match="image size"):
        composite(**scene, width=0, height=20)
    with pytest.raises(ValueError, match="expected 'cpu', 'cuda'"):
        composite(**scene, width=20, height=20, backend="gpu")
    with pytest.raises(ValueError, match="float32"):
        composite(**{name: x.double() for name, x in scene.items()}, width=20, height=20, backend="cpu")


def test_pose_gradient_equals_finite_differences():
    """In float64 through the reference; the fast backends are held to it above."""
    scene = room(24, 18, 300, 1)
    tensors = [x.double() for x in (scene.means, scene.radii, scene.opacities, scene.colors)]
    pose = se3.exp(torch.tensor([0.02, 0.01, -0.03, 0.02, 0.01, -0.01]).double())

    def loss_at(twist: Tensor) -> Tensor:
        image = render(*tensors, pose, scene.intrinsics, twist=twist, backend=reference)
        return (image.features**2).sum() + image.depth.sum() + (image.silhouette**2).sum()

    twist = torch.tensor([0.01, 0.0, -0.01, 0.0, 0.01, 0.02], dtype=torch.float64, requires_grad=True)
    size = torch.autograd.grad(loss_at(twist), twist)[0].norm()
    assert size > 1
    assert torch.autograd.gradcheck(loss_at, twist, eps=1e-7, rtol=1e-4, atol=1e-4 * float(size))


def test_centres_at_or_behind_the_camera_leave_no_trace():
    scene = room(40, 30, 100, 2)
    means = torch.cat([scene.means, torch.tensor([[0.0, 0, 0], [0.1, 0, -1], [0, 0, 1e-4]])]).requires_grad_()
    extra = [torch.cat([x, x[:3]]) for x in (scene.radii, scene.opacities, scene.colors)]
    image = render(means, *extra, torch.eye(4), scene.intrinsics)
    alone = render(scene.means, scene.radii, scene.opacities, scene.colors, torch.eye(4), scene.intrinsics)
    assert torch.equal(image.features, alone.features)
    (image.features.sum() + image.depth.sum()).backward()
    assert torch.isfinite(means.grad).all()
    assert (means.grad[-3:] == 0).all()
    assert means.grad.abs().max() > 0
