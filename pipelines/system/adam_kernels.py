"""Triton kernel of Adam's step: one pass over memory where torch's functions take twenty.

The interpreter of Triton (environment variable TRITON_INTERPRET=1) runs it on CPU tensors.
"""

import triton
import triton.language as tl


@triton.jit
def descend_rows(
    value: tl.tensor, first: tl.tensor, second: tl.tensor, gradient: tl.tensor, rows: tl.tensor, shares: tl.tensor,
    count: tl.tensor, width: tl.tensor, stride: tl.tensor, scale: tl.tensor, root: tl.tensor,
    BETA1: tl.constexpr, BETA2: tl.constexpr, NEW1: tl.constexpr, NEW2: tl.constexpr, EPSILON: tl.constexpr,
    CHOSEN: tl.constexpr, SHARED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Step the numbers of some rows: `count` numbers of the gradient in all, `width` a row, a row every `stride`.

    With CHOSEN its rows are those numbered in `rows`, with SHARED each takes its share of the step.
    """
    number = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = number < count
    row, column = number // width, number % width
    g = tl.load(gradient + row * stride + column, mask=inside, other=0.0)
    # Numbers with a gradient of 0 wait, and so do their moments.
    moves = inside & (g != 0)
    own = row
    if CHOSEN:
        own = tl.load(rows + row, mask=inside, other=0)
    at = own * width + column
    m = BETA1 * tl.load(first + at, mask=moves, other=0.0) + NEW1 * g
    v = BETA2 * tl.load(second + at, mask=moves, other=0.0) + NEW2 * g * g
    step = scale * m / (tl.sqrt(v) * root + EPSILON)
    if SHARED:
        step *= tl.load(shares + row, mask=moves, other=0.0)
    tl.store(first + at, m, mask=moves)
    tl.store(second + at, v, mask=moves)
    tl.store(value + at, tl.load(value + at, mask=moves, other=0.0) + step, mask=moves)
