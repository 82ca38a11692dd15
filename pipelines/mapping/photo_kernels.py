"""Triton kernels of the photo loss: what `photo_loss` compiles for a CPU, on a card.

Pictures are flat: number i is a colour of pixel i // 3. The sums are atomic additions: their last bits may differ from
run to run. The interpreter of Triton (environment variable TRITON_INTERPRET=1) runs these kernels on CPU tensors.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def expose_colors(
    shown: tl.tensor, stride: tl.tensor, exposure: tl.tensor, photo: tl.tensor, scene: tl.tensor, planes: tl.tensor,
    sums: tl.tensor, size: tl.tensor, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Exposed colours a, photo b and the products aa, bb and ab into the five planes; adds |a - b| to sums[0]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    pixel, color = i // 3, i % 3
    gain = tl.exp(tl.load(exposure + color))
    a = tl.load(shown + pixel * stride + color, mask=inside, other=0.0) * gain + tl.load(exposure + 3 + color)
    b = tl.load(photo + i, mask=inside, other=0).to(tl.float32) / 255
    if MASKED:
        b = tl.where(tl.load(scene + pixel, mask=inside, other=0) != 0, b, a)
    tl.store(planes + i, a, mask=inside)
    tl.store(planes + size + i, b, mask=inside)
    tl.store(planes + 2 * size + i, a * a, mask=inside)
    tl.store(planes + 3 * size + i, b * b, mask=inside)
    tl.store(planes + 4 * size + i, a * b, mask=inside)
    tl.atomic_add(sums, tl.sum(tl.where(inside, tl.abs(a - b), 0.0), axis=0))


@triton.jit
def blur_planes(
    planes: tl.tensor, out: tl.tensor, window: tl.tensor, size: tl.tensor, row: tl.tensor, step: tl.tensor,
    numbers: tl.tensor, TAPS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The window's mean of `numbers` numbers of planes of `size`, along rows of `row` numbers with step 3, or along
    columns, whose `row` is the whole plane, with the step of a picture's row; zeros outside the picture."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < numbers
    place = (i % size) % row
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(TAPS):
        off = (k - TAPS // 2) * step
        here = inside & (place + off >= 0) & (place + off < row)
        total += tl.load(window + k) * tl.load(planes + i + off, mask=here, other=0.0)
    tl.store(out + i, total, mask=inside)


@triton.jit
def compare_moments(
    moments: tl.tensor, planes: tl.tensor, sums: tl.tensor, size: tl.tensor,
    C1: tl.constexpr, C2: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The similarity's derivatives by mean, variance and covariance into planes 2 to 4; adds it to sums[1]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    x = tl.load(moments + i, mask=inside, other=0.0)
    y = tl.load(moments + size + i, mask=inside, other=0.0)
    var_x = tl.load(moments + 2 * size + i, mask=inside, other=0.0) - x * x
    var_y = tl.load(moments + 3 * size + i, mask=inside, other=0.0) - y * y
    luminance = 2 * x * y + C1
    contrast = 2 * (tl.load(moments + 4 * size + i, mask=inside, other=0.0) - x * y) + C2
    under_l, under_c = x * x + y * y + C1, var_x + var_y + C2
    inverse = 1.0 / (under_l * under_c)
    value = luminance * contrast * inverse
    by_cov = 2 * luminance * inverse
    by_var = -value / under_c
    by_mean = 2 * y * contrast * inverse - 2 * x * value / under_l - 2 * x * by_var - y * by_cov
    tl.store(planes + 2 * size + i, by_mean, mask=inside)
    tl.store(planes + 3 * size + i, by_var, mask=inside)
    tl.store(planes + 4 * size + i, by_cov, mask=inside)
    tl.atomic_add(sums + 1, tl.sum(tl.where(inside, value, 0.0), axis=0))


@triton.jit
def differentiate(
    planes: tl.tensor, blurred: tl.tensor, exposure: tl.tensor, scene: tl.tensor, gradient: tl.tensor, size: tl.tensor,
    SHARE: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The loss's gradient by what was shown; `blurred`: the three derivatives, 0 where there is no scene."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    a = tl.load(planes + i, mask=inside, other=0.0)
    b = tl.load(planes + size + i, mask=inside, other=0.0)
    likeness = tl.load(blurred + i, mask=inside, other=0.0)
    likeness += 2 * a * tl.load(blurred + size + i, mask=inside, other=0.0)
    likeness += b * tl.load(blurred + 2 * size + i, mask=inside, other=0.0)
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    found = ((1 - SHARE) * sign - SHARE * likeness) * tl.exp(tl.load(exposure + i % 3)) / size
    if MASKED:
        found = tl.where(tl.load(scene + i // 3, mask=inside, other=0) != 0, found, 0.0)
    tl.store(gradient + i, found, mask=inside)
