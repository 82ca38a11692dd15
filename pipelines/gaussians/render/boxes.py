"""Loops over the channels of a box of pixels, with a Gaussian's channels held in registers; see `lanes`.

A tile keeps `channels` numbers per pixel, pixel after pixel, 16 pixels a row; `channels` is 16 times the length of the
tuple `vectors`, whose *type* carries the number, so that kernels are compiled for it and cached like any other.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from msgs_slam.pipelines.gaussians.render.lanes import (
    FLAGS,
    I64,
    WIDTH,
    address_of,
    four_sums,
    intrinsic,
    load_lanes,
    splat_lanes,
    store_lanes,
    vector_type,
)


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


@intrinsic
def gradients_of_box(
    typing_context: Any,
    image: Any,
    image_at: Any,
    features: Any,
    features_at: Any,
    d_features: Any,
    d_features_at: Any,
    weights: Any,
    weights_at: Any,
    products: Any,
    products_at: Any,
    rows: Any,
    quads: Any,
    vectors: Any,
) -> Any:
    """For the pixels of a box 4 * quads wide: products[pixel] = image[pixel, :] . features, and
    d_features += weights[pixel] * image[pixel, :]. Four pixels at a time share the sum over lanes."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        count = sig.args[12].count
        starts = (address_of(context, builder, sig.args[i], args[i], args[i + 1]) for i in (0, 2, 4, 6, 8))
        image, features, d_features, weights, products = starts
        offsets = [I64(WIDTH * k) for k in range(count)]
        feature = [load_lanes(builder, builder.gep(features, [offset])) for offset in offsets]
        sums = [cgutils.alloca_once(builder, vector_type()) for _ in range(count)]
        for k in range(count):
            builder.store(load_lanes(builder, builder.gep(d_features, [offsets[k]])), sums[k])
        with cgutils.for_range(builder, args[10]) as row, cgutils.for_range(builder, args[11]) as quad:
            first = builder.add(builder.mul(row.index, I64(WIDTH)), builder.mul(quad.index, I64(4)))
            dots = []
            for i in range(4):
                pixel = builder.add(first, I64(i))
                weight = splat_lanes(builder, builder.load(builder.gep(weights, [pixel])))
                base = builder.gep(image, [builder.mul(pixel, I64(WIDTH * count))])
                dot = None
                for k in range(count):
                    value = load_lanes(builder, builder.gep(base, [offsets[k]]))
                    product = builder.fmul(value, feature[k], flags=FLAGS)
                    dot = product if dot is None else builder.fadd(dot, product, flags=FLAGS)
                    more = builder.fmul(weight, value, flags=FLAGS)
                    builder.store(builder.fadd(builder.load(sums[k]), more, flags=FLAGS), sums[k])
                dots.append(dot)
            store_lanes(builder, four_sums(builder, dots), builder.gep(products, [first]))
        for k in range(count):
            store_lanes(builder, builder.load(sums[k]), builder.gep(d_features, [offsets[k]]))
        return context.get_dummy_value()

    places = (image, features, d_features, weights, products)
    arguments = [kind for place in places for kind in (place, types.intp)]
    return types.void(*arguments, types.intp, types.intp, vectors), emit
