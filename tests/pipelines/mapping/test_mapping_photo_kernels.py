"""The photo loss by Triton's kernels against torch's own functions: on a card, else in Triton's interpreter."""

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

from msgs_slam.pipelines.mapping.photo_loss import photo_loss_by_kernels, plain_photo_loss  # noqa: E402

ROOT = Path(__file__).resolve().parents[3]
DEVICE = "cuda" if ON_CARD else "cpu"


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(24, 31), (5, 70), (64, 8)])
def test_the_kernels_have_the_plain_value_and_gradient(size: tuple[int, int], masked: bool) -> None:
    """Also of pictures smaller than the window, and of colours that are some of more features."""
    generator = torch.Generator().manual_seed(3)
    features = torch.rand(*size, 5, generator=generator)
    photo = (255 * (0.7 * features[..., :3] + 0.3 * torch.rand(*size, 3, generator=generator))).to(torch.uint8)
    scene = torch.rand(size, generator=generator) > 0.3 if masked else None
    exposure = torch.tensor([[0.1, -0.2, 0.05], [0.01, 0.02, -0.1]])
    found = []
    for loss, device, kind in (
        (photo_loss_by_kernels, DEVICE, torch.float32),
        (plain_photo_loss, "cpu", torch.float64),
    ):
        colors = features.to(device, kind).requires_grad_()
        place = None if scene is None else scene.to(device)
        value = loss(colors[..., :3], exposure.to(device, kind), photo.to(device), place)
        found.append([x.cpu().double() for x in (value.detach(), *torch.autograd.grad(3 * value, [colors]))])
    for mine, theirs in zip(*found, strict=True):
        assert theirs.abs().max() > 0
        assert (mine - theirs).abs().max() < 1e-5 * theirs.abs().max()


@pytest.mark.skipif(ON_CARD, reason="the test above compiles and runs the kernels")
def test_the_kernels_compile_for_cards(tmp_path: Path) -> None:
    """The interpreter accepts more than the compiler does; compiling needs no card."""
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", COMPILE], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


COMPILE = """
import triton
from triton.compiler import ASTSource
from triton.backends.compiler import GPUTarget
from msgs_slam.pipelines.mapping import photo_kernels
kinds = dict.fromkeys(("stride", "size", "row", "step", "numbers"), "i32") | dict(photo="*u8", scene="*u8")
for name in ("expose_colors", "blur_planes", "compare_moments", "differentiate"):
    kernel = getattr(photo_kernels, name)
    constants = dict(MASKED=True, BLOCK=512, TAPS=11, C1=1e-4, C2=9e-4, SHARE=0.2)
    constants = {n: x for n, x in constants.items() if n in kernel.arg_names}
    signature = {n: "constexpr" if n in constants else kinds.get(n, "*fp32") for n in kernel.arg_names}
    source = ASTSource(kernel, signature, constexprs=constants)
    assert triton.compile(source, target=GPUTarget("cuda", 80, 32)).asm["ptx"]
"""
