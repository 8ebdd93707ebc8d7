"""Vectors of sixteen float32 or float64 lanes as single values in numba kernels, like the vector types of C compilers.

LLVM's own vectoriser works on one short loop at a time: it sums the lanes of every accumulator at the end of each row
of pixels. Values of these types stay in vector registers across loops; where registers are narrower than 16 floats
(AVX2, NEON), LLVM splits them. Arithmetic is `fastmath`, like that of the kernels.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
BOOLS = ir.VectorType(ir.IntType(1), LANES)
ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
COMPARISONS = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}


class Floats(types.Type):
    """LANES float32 or float64."""

    def __init__(self, dtype: types.Float) -> None:
        super().__init__(f"Floats({dtype})")
        self.dtype = dtype


class Bools(types.Type):
    """LANES booleans, the result of comparing `Floats`."""


@register_model(Floats)
class _FloatsModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(manager[kind.dtype].get_value_type(), LANES))


@register_model(Bools)
class _BoolsModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: types.Type) -> None:
        super().__init__(manager, kind, BOOLS)


bools = Bools("bools")


def _shuffle(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    """A vector of the lanes with the indices `lanes`: 0..LANES - 1 are those of a, from LANES on those of b."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes))


def _spread(builder: Any, value: Any, vector: Any) -> Any:
    """A scalar repeated in every lane of a vector type; vectors are returned as they are."""
    if isinstance(value.type, ir.VectorType):
        return value
    if value.type != vector.element:
        value = (builder.fpext if value.type == ir.FloatType() else builder.fptrunc)(value, vector.element)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return _shuffle(builder, first, first, [0] * LANES)


def _define(function: Callable[..., Any], compares: bool, emit: Callable[..., Any]) -> None:
    """Define a binary operator on two vectors, and on a vector and a scalar."""

    @type_callable(function)
    def typing(_context: Any) -> Callable[..., Any]:
        def result(a: Any, b: Any) -> Any:
            lanes = next((kind for kind in (a, b) if isinstance(kind, (Floats, Bools))), None)
            return bools if lanes is not None and compares else lanes

        return result

    def lower(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        vector = next(value.type for value in arguments if isinstance(value.type, ir.VectorType))
        return emit(builder, *(_spread(builder, value, vector) for value in arguments))

    for pair in ((Floats, Floats), (Floats, types.Float), (types.Float, Floats), (Bools, Bools)):
        lower_builtin(function, *pair)(lower)


for _function, _name in ARITHMETIC.items():
    _define(_function, False, lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=("fast",)))
for _function, _name in COMPARISONS.items():
    _define(_function, True, lambda builder, a, b, name=_name: builder.fcmp_ordered(name, a, b))
_define(operator.and_, True, lambda builder, a, b: builder.and_(a, b))


@intrinsic
def where(_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """Lanes of a where the mask is true, else of b; one of a and b may be a scalar."""
    lanes = a if isinstance(a, Floats) else b

    def emit(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        vector = context.get_value_type(lanes)
        return builder.select(arguments[0], *(_spread(builder, value, vector) for value in arguments[1:]))

    return lanes(mask, a, b), emit


@intrinsic
def load(_context: Any, array: Any, start: Any) -> Any:
    """LANES consecutive entries of a contiguous array, from the flat index `start` on.

    A flat index avoids views of rows: each view made in a loop may cost two atomic updates of a reference count.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_address(context, builder, signature, arguments), align=4)

    return Floats(array.dtype)(array, start), emit


@intrinsic
def store(_context: Any, array: Any, start: Any, value: Any) -> Any:
    """Set LANES consecutive entries of a contiguous array, from the flat index `start` on."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _address(context, builder, signature, arguments), align=4)
        return context.get_dummy_value()

    return types.void(array, start, value), emit


def _address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    vector = context.get_value_type(Floats(signature.args[0].dtype))
    return builder.bitcast(builder.gep(data, [arguments[1]]), vector.as_pointer())


def _reduction(name: str, *start: float) -> Any:
    """An intrinsic that reduces all lanes to one scalar."""

    @intrinsic
    def reduce(_context: Any, value: Any) -> Any:
        def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            vector = arguments[0].type
            values = [*(ir.Constant(vector.element, number) for number in start), *arguments]
            kind = ir.FunctionType(vector.element, [operand.type for operand in values])
            full_name = f"llvm.vector.reduce.{name}.v{LANES}f{value.dtype.bitwidth}"
            function = cgutils.get_or_insert_function(builder.module, kind, full_name)
            return builder.call(function, values, fastmath=("fast",))

        return value.dtype(value), emit

    return reduce


largest = _reduction("fmax")
"""The largest of all lanes."""
total = _reduction("fadd", 0.0)
"""The sum of all lanes."""


@intrinsic
def totals(_context: Any, values: Any) -> Any:
    """The sums over all lanes of up to LANES vectors, as one vector: lane k holds the sum of values[k].

    A tree of shuffles halves the number of vectors at each level, which needs fewer operations than separate sums.
    """

    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        level, group = cgutils.unpack_tuple(builder, arguments[0]), LANES
        while group > 1:
            low = [s + k + side * LANES for s in range(0, LANES, group) for side in (0, 1) for k in range(group // 2)]
            high = [lane + group // 2 for lane in low]
            level += [ir.Constant(level[0].type, None)] * (len(level) % 2)
            pairs = zip(level[::2], level[1::2], strict=True)
            halves = ((_shuffle(builder, a, b, low), _shuffle(builder, a, b, high)) for a, b in pairs)
            level, group = [builder.fadd(a, b, flags=("fast",)) for a, b in halves], group // 2
        bits = LANES.bit_length() - 1
        order = [int(f"{lane:0{bits}b}"[::-1], 2) for lane in range(LANES)]
        return _shuffle(builder, level[0], level[0], order)

    return values.dtype(values), emit


@intrinsic
def trailing_zeros(_context: Any, value: Any) -> Any:
    """Position of the lowest bit that is set in a positive integer."""

    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return value(value), emit


@intrinsic
def prefetch(_context: Any, array: Any, start: Any) -> Any:
    """Prefetch the cache line of one entry of a contiguous float32 array, for rows that are read in random order."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.bitcast(_address(context, builder, signature, arguments), ir.IntType(8).as_pointer())
        integer = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, integer, integer, integer])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, *(integer(flag) for flag in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, start), emit
