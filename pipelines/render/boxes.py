"""Loops over the channels of a box of pixels, with a Gaussian's channels held in registers; see `lanes`.

A tile keeps `channels` numbers per pixel, pixel after pixel, 16 pixels a row; `channels` is 16 times the length of the
tuple `vectors`, whose *type* carries the number, so that kernels are compiled for it and cached like any other.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from ..compute.lanes import FLAGS, I64, WIDTH, address_of, intrinsic, load_lanes, splat_lanes, store_lanes


@intrinsic
def add_to_box(
    typing_context: Any,
    image: Any,
    image_at: Any,
    features: Any,
    features_at: Any,
    weights: Any,
    weights_at: Any,
    rows: Any,
    columns: Any,
    vectors: Any,
) -> Any:
    """image[pixel, :] += weights[pixel] * features for the pixels of a box that starts at the given places."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        count = sig.args[8].count
        image, features, weights = (address_of(context, builder, sig.args[i], args[i], args[i + 1]) for i in (0, 2, 4))
        feature = [load_lanes(builder, builder.gep(features, [I64(WIDTH * k)])) for k in range(count)]
        with cgutils.for_range(builder, args[6]) as row, cgutils.for_range(builder, args[7]) as column:
            pixel = builder.add(builder.mul(row.index, I64(WIDTH)), column.index)
            weight = splat_lanes(builder, builder.load(builder.gep(weights, [pixel])))
            for k in range(count):
                offset = builder.add(builder.mul(pixel, I64(WIDTH * count)), I64(WIDTH * k))
                target = builder.gep(image, [offset])
                product = builder.fmul(weight, feature[k], flags=FLAGS)
                store_lanes(builder, builder.fadd(load_lanes(builder, target), product, flags=FLAGS), target)
        return context.get_dummy_value()

    where_and_what = (image, types.intp, features, types.intp, weights, types.intp, types.intp, types.intp, vectors)
    return types.void(*where_and_what), emit
