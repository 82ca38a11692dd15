"""Operations on `lanes` that stereo alone needs: choices, and samples of an image between its pixels."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numpy.typing import NDArray

from ...system.lanes import (
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
    """Samples of a flat image of `with_row_below`, `columns` wide, between its pixels: `across` (lanes) columns and
    `down` rows from its first, both >= 0 and below the last.

    Neighbours are read together: instructions that gather numbers from all over take several times as long.
    """

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        place, (right, under) = _places(builder, args)
        place = builder.shl(place, constant(1, element=I32))
        a, c, b, d = _load_groups(context, builder, sig.args[0], args[0], place, 4)
        above, below = _between(builder, a, b, right), _between(builder, c, d, right)
        return _between(builder, above, below, under)

    return lanes(array, types.intp, lanes, lanes), emit


def with_row_below(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, H, W, 2) of images (N, H, W): every pixel and the one below it side by side, so that the four around a place
    are read at once."""
    paired = np.empty((*images.shape, 2), images.dtype)
    paired[..., 0], paired[:, :-1, :, 1], paired[:, -1, :, 1] = images, images[:, 1:], images[:, -1]
    return paired


@intrinsic
def corners(typing_context: Any, array: Any, columns: Any, across: Any, down: Any) -> Any:
    """The four pixels around places as of `interpolate`: upper left and right, lower left and right; and how far the
    place is from the first, across and down, of the way to the others."""
    result = types.UniTuple(lanes, 6)

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        place, parts = _places(builder, args)
        columns = builder.trunc(args[1], I32)
        row_length = builder.insert_element(ir.Constant(place.type, ir.Undefined), columns, I32(0))
        under = builder.add(place, builder.shuffle_vector(row_length, row_length, constant(0, element=I32)))
        rows = [_load_groups(context, builder, sig.args[0], args[0], p, 2) for p in (place, under)]
        return context.make_tuple(builder, result, [*rows[0], *rows[1], *parts])

    return result(array, types.intp, lanes, lanes), emit


def _places(builder: ir.IRBuilder, args: Any) -> tuple[ir.Value, tuple[ir.Value, ir.Value]]:
    """Of (array, columns, across, down): the numbers (int32) of the upper left pixels, and the fractions."""
    (column, right), (row, under) = (_whole_and_rest(builder, position) for position in args[2:])
    wide = ir.Constant(column.type, ir.Undefined)
    row_length = builder.insert_element(wide, builder.trunc(args[1], I32), I32(0))
    row_length = builder.shuffle_vector(row_length, row_length, constant(0, element=I32))
    return builder.add(builder.mul(row, row_length), column), (right, under)


def _between(builder: ir.IRBuilder, first: ir.Value, second: ir.Value, part: ir.Value) -> ir.Value:
    change = builder.fsub(second, first, flags=FLAGS)
    return builder.fadd(first, builder.fmul(part, change, flags=FLAGS), flags=FLAGS)


def _whole_and_rest(builder: ir.IRBuilder, value: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Of numbers >= 0."""
    whole = builder.fptosi(value, vector_type(element=I32))
    return whole, builder.fsub(value, builder.sitofp(whole, vector_type()), flags=FLAGS)


def _load_groups(
    context: Any, builder: ir.IRBuilder, array_type: Any, array: ir.Value, places: ir.Value, size: int
) -> list[ir.Value]:
    """array[place], array[place + 1] and so on, `size` of them, for each of the places (int32)."""
    parts = []
    for lane in range(WIDTH):
        place = builder.zext(builder.extract_element(places, I32(lane)), I64)
        parts.append(load_lanes(builder, address_of(context, builder, array_type, array, place), size))
    while len(parts) > 1:
        length = 2 * parts[0].type.count
        order = ir.Constant(vector_type(length, I32), list(range(length)))
        parts = [builder.shuffle_vector(a, b, order) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    orders = (ir.Constant(vector_type(element=I32), list(range(k, size * WIDTH, size))) for k in range(size))
    return [builder.shuffle_vector(parts[0], parts[0], order) for order in orders]
