"""The Triton kernels against the float64 reference: on a card where there is one, else by Triton's interpreter."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ON_CARD = torch.cuda.is_available()
if not ON_CARD:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install 'msgs-slam[cuda-check]'")

from render_scenes import IMAGES, NAMES, random_gaussians, random_proxy, room  # noqa: E402

from msgs_slam.pipelines.gaussians.render import composite, cuda, reference, render  # noqa: E402

ROOT = Path(__file__).resolve().parents[4]
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


def assert_agrees(scene, width, height, proxy=None, kappa=0.0):
    results = []
    for backend, device, dtype in (("cuda", DEVICE, torch.float32), ("reference", "cpu", torch.float64)):
        inputs = {name: x.clone().to(device, dtype).requires_grad_() for name, x in scene.items()}
        guide = None if proxy is None else proxy.to(device)
        image = composite(**inputs, width=width, height=height, proxy_depth=guide, kappa=kappa, backend=backend)
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


@pytest.mark.parametrize("kappa", [0.0, 3.0])
@pytest.mark.parametrize("name", SCENES)
def test_random_scenes(name, kappa):
    scene = random_gaussians(width=SIZE[0], height=SIZE[1], channels=5, seed=len(name), **SCENES[name])
    assert_agrees(scene, *SIZE, random_proxy(*SIZE, seed=2), kappa)


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
    exact = render(*(x.double() for x in tensors), pose, scene.intrinsics, backend="reference")
    worst = (ours.features - exact.features).abs().amax(-1)
    assert (worst > 1e-4).double().mean() < 1e-3


@pytest.mark.skipif(ON_CARD, reason="the tests above compile and run the kernels")
@pytest.mark.parametrize(
    ("name", "guided", "padded"),
    [("forward_tile", True, 64), ("backward_tile", True, 64), ("backward_tile", False, 16), ("inspect_tile", True, 16)],
)
def test_kernels_compile_for_cards_and_fit_their_shared_memory(name, guided, padded, tmp_path):
    """The interpreter accepts more than the compiler does; compiling needs no card."""
    code = COMPILE.format(name=name, guided=guided, padded=padded)
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert 0 < int(done.stdout.split()[-1]) <= 99 * 1024  # what a program may have on compute capability 8.6


COMPILE = """
import triton
from triton.compiler import ASTSource
from triton.backends.compiler import GPUTarget
from msgs_slam.pipelines.gaussians.render import cuda_kernels
kernel = cuda_kernels.{name}
constants = dict(GUIDED={guided}, COUNTED={guided}, PADDED={padded}, STEP=16, TILE=16, ALPHA_MAX=0.99, LIGHT_MIN=1e-4)
kinds = dict(width="i32", height="i32", channels="i32", kappa="fp32", starts="*i64", members="*i64")
constants = {{n: x for n, x in constants.items() if n in kernel.arg_names}}
signature = {{n: "constexpr" if n in constants else kinds.get(n, "*fp32") for n in kernel.arg_names}}
source = ASTSource(kernel, signature, constexprs=constants)
compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=dict(num_warps=8))
print(compiled.metadata.shared)
"""
