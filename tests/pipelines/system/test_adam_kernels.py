"""Triton's kernels around the renderer against torch's own functions: on a card, else in Triton's interpreter."""

import os
from pathlib import Path

import pytest
import torch

ON_CARD = torch.cuda.is_available()
if not ON_CARD:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install '.[cuda-check]'")

from msgs_slam.pipelines.system import adam  # noqa: E402
from tests.card_builds import build  # noqa: E402
from tests.plain_adam import plain_descend  # noqa: E402

DEVICE = "cuda" if ON_CARD else "cpu"


@pytest.mark.parametrize("shape", [(2500,), (900, 3), (1, 5), (0, 3), (4, 0), (30, 2, 3)])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("chosen", [False, True])
def test_adams_kernel_takes_the_plain_step(
    shape: tuple[int, ...], shared: bool, chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adam, "_descend_on_cpu", adam._descend_on_card)
    generator = torch.Generator().manual_seed(1)
    fast = [torch.rand(shape, generator=generator).to(DEVICE) for _ in range(3)]
    start = [x.double() for x in fast]
    plain = [x.clone() for x in start]
    rows = torch.randperm(shape[0], generator=generator)[: shape[0] // 2] if chosen else torch.arange(shape[0])
    rows = rows.to(DEVICE)
    shares = torch.rand(len(rows), generator=generator).to(DEVICE) if shared else None
    for steps in (5, 6):
        # Columns of a larger gradient, as the renderer's features have them.
        wide = (
            torch.randn(len(rows), *shape[1:-1], 7, generator=generator) if len(shape) > 1 else torch.randn(len(rows))
        )
        gradient = (wide[..., 2 : 2 + shape[-1]] if len(shape) > 1 else wide).to(DEVICE)
        gradient[gradient.abs() < 0.3] = 0
        adam.descend(fast[0], gradient, fast[1], fast[2], 0.1, steps, shares, rows if chosen else None)
        plain_descend(plain[0], gradient.double(), plain[1], plain[2], 0.1, steps, shares, rows)
    for a, b, before in zip(fast, plain, start, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-6)
        assert not len(rows) or not b.numel() or not torch.equal(b, before)


@pytest.mark.skipif(ON_CARD, reason="the test above compiles and runs the kernel")
def test_adams_kernel_compiles_for_cards(tmp_path: Path) -> None:
    constants = {"BETA1": 0.9, "BETA2": 0.999, "NEW1": 0.1, "NEW2": 0.001, "EPSILON": 1e-15, "BLOCK": 1024}
    kinds = {**dict.fromkeys(("count", "width", "stride"), "i32"), "rows": "*i64", "scale": "fp32", "root": "fp32"}
    build({"system.adam_kernels": ["descend_rows"]}, constants | {"CHOSEN": True, "SHARED": True}, kinds, tmp_path)
