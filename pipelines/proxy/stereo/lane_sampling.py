"""Operations on `lanes` that stereo alone needs: choices, and samples of an image between its pixels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from msgs_slam.pipelines.gaussians.render.lanes import (
    FLAGS,
    I32,
    I64,
    WIDTH,
    address_of,
    call_llvm,
    constant,
    fold,
    intrinsic,
    lanes,
    load_lanes,
    mask,
    vector_type,
)


@intrinsic
def smallest(typing_context: Any, value: Any, other: Any) -> Any:
    """The smaller of two numbers, lane by lane."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(lanes, lanes), emit


@intrinsic
def smallest_of(typing_context: Any, value: Any) -> Any:
    """The smallest of the lanes."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return fold(builder, args[0], lambda x, y: builder.select(builder.fcmp_ordered("<", x, y), x, y))

    return types.float32(lanes), emit


@intrinsic
def choose(typing_context: Any, condition: Any, value: Any, other: Any) -> Any:
    """value where the condition holds, else the other."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.select(*args)

    return lanes(mask, lanes, lanes), emit


@intrinsic
def square_root(typing_context: Any, value: Any) -> Any:
    """Return the square root of each lane."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return call_llvm(builder, f"llvm.sqrt.v{WIDTH}f32", vector_type(), args[0])

    return lanes(lanes), emit


@intrinsic
def interpolate(typing_context: Any, array: Any, columns: Any, across: Any, down: Any) -> Any:
    """Samples of a flat image, `columns` wide, between its pixels: `across` (lanes) columns and `down` rows from its
    first, both >= 0 and below the last.

    Neighbours are read in pairs: instructions that gather numbers from all over take several times as long.
    """

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        rows, parts = _load_corners(context, builder, sig.args[0], args)
        means = []
        for left, right in rows:
            change = builder.fsub(right, left, flags=FLAGS)
            means.append(builder.fadd(left, builder.fmul(parts[0], change, flags=FLAGS), flags=FLAGS))
        change = builder.fsub(means[1], means[0], flags=FLAGS)
        return builder.fadd(means[0], builder.fmul(parts[1], change, flags=FLAGS), flags=FLAGS)

    return lanes(array, types.intp, lanes, lanes), emit


@intrinsic
def corners(typing_context: Any, array: Any, columns: Any, across: Any, down: Any) -> Any:
    """The four pixels around places as of `interpolate`: upper left and right, lower left and right; and how far the
    place is from the first, across and down, of the way to the others."""
    result = types.UniTuple(lanes, 6)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        rows, parts = _load_corners(context, builder, sig.args[0], args)
        return context.make_tuple(builder, result, [*rows[0], *rows[1], *parts])

    return result(array, types.intp, lanes, lanes), emit


def _load_corners(
    context: Any, builder: ir.IRBuilder, array_type: Any, args: Any
) -> tuple[list[tuple[ir.Value, ir.Value]], tuple[ir.Value, ir.Value]]:
    """Of (array, columns, across, down): left and right pixel of the upper and of the lower row, and the fractions."""
    whole, parts = zip(*(_whole_and_rest(builder, position) for position in args[2:]), strict=True)
    wide = ir.VectorType(I64, WIDTH)
    row_length = builder.insert_element(ir.Constant(wide, ir.Undefined), args[1], I32(0))
    row_length = builder.shuffle_vector(row_length, row_length, constant(0, element=I32))
    top = builder.add(builder.mul(builder.zext(whole[1], wide), row_length), builder.zext(whole[0], wide))
    places = (top, builder.add(top, row_length))
    return [_load_pairs(context, builder, array_type, args[0], place) for place in places], (parts[0], parts[1])


def _whole_and_rest(builder: ir.IRBuilder, value: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Of numbers >= 0."""
    whole = builder.fptosi(value, vector_type(element=I32))
    return whole, builder.fsub(value, builder.sitofp(whole, vector_type()), flags=FLAGS)


def _load_pairs(
    context: Any, builder: ir.IRBuilder, array_type: Any, array: ir.Value, places: ir.Value
) -> tuple[ir.Value, ir.Value]:
    """array[place] and array[place + 1] for each of the places."""
    parts = []
    for lane in range(WIDTH):
        place = builder.extract_element(places, I32(lane))
        parts.append(load_lanes(builder, address_of(context, builder, array_type, array, place), 2))
    while len(parts) > 1:
        length = 2 * parts[0].type.count
        order = ir.Constant(vector_type(length, I32), list(range(length)))
        parts = [builder.shuffle_vector(a, b, order) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    orders = (ir.Constant(vector_type(element=I32), list(range(first, 2 * WIDTH, 2))) for first in (0, 1))
    left, right = (builder.shuffle_vector(parts[0], parts[0], order) for order in orders)
    return left, right
