"""Sixteen float32 numbers that a compiled kernel works on at once: a vector type for numba.

numba leaves it to LLVM to find vectors in loops, which it does not where kernels keep state in several arrays (3 to 5
times slower). Here the vectors are written down: `Lanes` add, multiply and compare like numbers, `Mask` is the result
of a comparison. Everything here can be used in functions compiled by numba only. Array indices are not checked.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

intrinsic: Any = extending.intrinsic  # its own annotation hides the arguments of what it makes

WIDTH = 16
FLAGS = ("contract", "nsz", "arcp")
_FLOAT, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)


class LanesType(types.Type):
    """16 x float32."""


class MaskType(types.Type):
    """16 x bool."""


lanes = LanesType("lanes")
mask = MaskType("mask")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(_FLOAT, WIDTH))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), WIDTH))


def vector_type(length: int = WIDTH, element: ir.Type = _FLOAT) -> ir.VectorType:
    return ir.VectorType(element, length)


def constant(value: float, length: int = WIDTH, element: ir.Type = _FLOAT) -> ir.Constant:
    return ir.Constant(vector_type(length, element), [value] * length)


def splat_lanes(builder: ir.IRBuilder, scalar: ir.Value, length: int = WIDTH) -> ir.Value:
    undefined = ir.Constant(vector_type(length), ir.Undefined)
    first = builder.insert_element(undefined, scalar, I32(0))
    return builder.shuffle_vector(first, undefined, constant(0, length, I32))


def call_llvm(builder: ir.IRBuilder, name: str, result: ir.Type, *values: ir.Value) -> ir.Value:
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def address_of(context: Any, builder: ir.IRBuilder, array_type: Any, array: ir.Value, index: ir.Value) -> ir.Value:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def load_lanes(builder: ir.IRBuilder, address: ir.Value, length: int = WIDTH) -> ir.Value:
    value = builder.load(builder.bitcast(address, vector_type(length).as_pointer()))
    value.align = 4  # arrays of float32 start anywhere
    return value


def store_lanes(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    builder.store(value, builder.bitcast(address, value.type.as_pointer())).align = 4


# --- arithmetic and comparison ---------------------------------------------------------------------------------------

_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_COMPARISON = {operator.lt: "<", operator.le: "<=", operator.ge: ">=", operator.gt: ">"}


def _binary(emit: Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]) -> Callable[..., ir.Value]:
    """A lowering of (lanes or float32, lanes or float32): a scalar stands for 16 equal lanes."""

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: tuple[ir.Value, ir.Value]) -> ir.Value:
        left, right = (
            splat_lanes(builder, value) if kind == types.float32 else value
            for kind, value in zip(sig.args, args, strict=True)
        )
        return emit(builder, left, right)

    return lower


def _define(function: Any, result: types.Type, emit: Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]) -> None:
    operands = [(lanes, lanes), (lanes, types.float32), (types.float32, lanes)]
    if result is mask and function is operator.and_:
        operands = [(mask, mask)]
    for left, right in operands:
        lower_builtin(function, left, right)(_binary(emit))
    cases = [signature(result, left, right) for left, right in operands]
    infer_global(function)(type(f"_{function.__name__}_of_lanes", (ConcreteTemplate,), {"cases": cases}))


for _function, _name in _ARITHMETIC.items():
    _define(_function, lanes, lambda b, x, y, name=_name: getattr(b, name)(x, y, flags=FLAGS))  # type: ignore[misc]
for _function, _sign in _COMPARISON.items():
    _define(_function, mask, lambda b, x, y, sign=_sign: b.fcmp_ordered(sign, x, y))  # type: ignore[misc]
_define(operator.and_, mask, lambda b, x, y: b.and_(x, y))


# --- single values ---------------------------------------------------------------------------------------------------


def _on_values(result: types.Type, *arguments: types.Type) -> Callable[[Callable[..., ir.Value]], Any]:
    """Return a decorator: what emits code for values of these types becomes a function of kernels."""

    def decorate(emit: Callable[..., ir.Value]) -> Any:
        def typed(typing_context: Any, *given: Any) -> Any:
            return result(*arguments), lambda context, builder, sig, args: emit(builder, *args)

        return intrinsic(functools.update_wrapper(typed, emit, assigned=("__module__", "__name__", "__doc__")))

    return decorate


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] as lanes; a flat float32 array."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return load_lanes(builder, address_of(context, builder, sig.args[0], *args))

    return lanes(array, types.intp), emit


@intrinsic
def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 16] = value."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        store_lanes(builder, args[2], address_of(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), emit


@_on_values(lanes, types.float32)
def iota(builder: ir.IRBuilder, first: ir.Value) -> ir.Value:
    """first, first + 1, ... first + 15."""
    steps = ir.Constant(vector_type(), [float(i) for i in range(WIDTH)])
    return builder.fadd(splat_lanes(builder, first), steps, flags=FLAGS)


@_on_values(lanes, types.float32)
def splat(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Sixteen times the same number."""
    return splat_lanes(builder, value)


@_on_values(lanes, mask, lanes)
def where(builder: ir.IRBuilder, condition: ir.Value, value: ir.Value) -> ir.Value:
    """value where the condition holds, else 0."""
    return builder.select(condition, value, constant(0.0))


@_on_values(lanes, lanes, types.float32)
def min_scalar(builder: ir.IRBuilder, value: ir.Value, limit: ir.Value) -> ir.Value:
    """The smaller of each lane and the limit."""
    limits = splat_lanes(builder, limit)
    return builder.select(builder.fcmp_ordered("<", value, limits), value, limits)


@_on_values(lanes, lanes)
def reciprocal(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """1 over each lane, for numbers in 2^-60..2^60, relative error below 3e-7; a third of the time of a division.

    The difference of a constant and a float's bits has about the bits of the reciprocal; three steps of Newton's.
    """
    bits = builder.bitcast(value, vector_type(element=I32))
    guess = builder.bitcast(builder.sub(constant(0x7EF311C7, element=I32), bits), vector_type())
    for _ in range(3):
        miss = builder.fsub(constant(2.0), builder.fmul(value, guess, flags=FLAGS), flags=FLAGS)
        guess = builder.fmul(guess, miss, flags=FLAGS)
    return guess


@_on_values(types.float32, lanes)
def total(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Sum of the lanes, always added in the same order."""
    return fold(builder, value, lambda x, y: builder.fadd(x, y, flags=FLAGS))


@intrinsic
def add_totals(typing_context: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """array[index : index + 4] += the sums of the lanes of a, b, c and d; always added in the same order."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        target = address_of(context, builder, sig.args[0], args[0], args[1])
        sums = builder.fadd(load_lanes(builder, target, 4), four_sums(builder, list(args[2:])), flags=FLAGS)
        store_lanes(builder, sums, target)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes, lanes, lanes, lanes), emit


@_on_values(types.float32, lanes)
def reduce_max(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """The largest of the lanes."""
    return fold(builder, value, lambda x, y: builder.select(builder.fcmp_ordered(">", x, y), x, y))


@_on_values(lanes, lanes, lanes)
def maximum(builder: ir.IRBuilder, value: ir.Value, other: ir.Value) -> ir.Value:
    """The larger of two numbers, lane by lane."""
    return builder.select(builder.fcmp_ordered(">", value, other), value, other)


@_on_values(types.boolean, mask)
def any_lane(builder: ir.IRBuilder, condition: ir.Value) -> ir.Value:
    """Whether the condition holds in any lane."""
    return builder.icmp_unsigned("!=", builder.bitcast(condition, ir.IntType(WIDTH)), ir.IntType(WIDTH)(0))


@intrinsic
def add_to_box(
    typing_context: Any, image: Any, image_at: Any, features: Any, features_at: Any, weights: Any, weights_at: Any,
    rows: Any, columns: Any, vectors: Any,
) -> Any:  # fmt: skip
    """image[pixel, :] += weights[pixel] * features for the pixels of a box that starts at the given places.

    The box lies in a tile of 16 pixels a row, which keeps 16 numbers a pixel for each element of the tuple `vectors`.
    The tuple's *type* carries the number, so that kernels are compiled for it and cached like any other.
    """

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


_EXP2 = (1.0, 0.693147206, 0.240226466, 0.0555032900, 0.00961851953, 0.00133998604, 0.000153375768)
"""2^f on [-1/2, 1/2], relative error 2e-9: least squares of the relative error at Chebyshev's nodes."""


@_on_values(lanes, lanes)
def lane_exp(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """e to each lane, for arguments <= 0 (less than -80 counts as -80); relative error about 1e-7."""
    limit = constant(-80.0)
    argument = builder.select(builder.fcmp_ordered(">", value, limit), value, limit)
    power = builder.fmul(argument, constant(1.4426950408889634))
    whole = call_llvm(builder, f"llvm.rint.v{WIDTH}f32", vector_type(), power)
    part = builder.fsub(power, whole)
    result: ir.Value = constant(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        result = builder.fadd(builder.fmul(result, part, flags=FLAGS), constant(coefficient), flags=FLAGS)
    exponent = builder.add(builder.fptosi(whole, vector_type(element=I32)), constant(127, element=I32))
    scale = builder.bitcast(builder.shl(exponent, constant(23, element=I32)), vector_type())
    return builder.fmul(result, scale)


def fold(builder: ir.IRBuilder, value: ir.Value, join: Callable[[ir.Value, ir.Value], ir.Value]) -> ir.Value:
    """Halves onto halves: a fixed order, four steps for sixteen lanes."""
    undefined = ir.Constant(vector_type(), ir.Undefined)
    for step in (8, 4, 2, 1):
        order = ir.Constant(vector_type(element=I32), [(i + step) % WIDTH for i in range(WIDTH)])
        value = join(value, builder.shuffle_vector(value, undefined, order))
    return builder.extract_element(value, I32(0))


def four_sums(builder: ir.IRBuilder, values: list[ir.Value]) -> ir.Value:
    """Sums over the lanes of four vectors, as one vector of 4: halves are added pair by pair, then together."""

    def mix(left: ir.Value, right: ir.Value, order: list[int]) -> ir.Value:
        return builder.shuffle_vector(left, right, ir.Constant(vector_type(len(order), I32), order))

    def add_halves(left: ir.Value, right: ir.Value, half: int) -> ir.Value:
        # Lanes come in runs of 2 * half that belong to one sum; runs of `left` first, then those of `right`.
        low = [start + i for start in range(0, 2 * WIDTH, 2 * half) for i in range(half)]
        high = [i + half for i in low]
        return builder.fadd(mix(left, right, low), mix(left, right, high), flags=FLAGS)

    both = add_halves(add_halves(values[0], values[1], 8), add_halves(values[2], values[3], 8), 4)
    for step in (2, 1):
        order = [4 * (i // 4) + (i + step) % 4 for i in range(WIDTH)]
        both = builder.fadd(both, mix(both, both, order), flags=FLAGS)
    return mix(both, both, [0, 4, 8, 12])
