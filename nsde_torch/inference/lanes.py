"""Numbers of `WIDTH` chunks side by side, for loops that are compiled: one instruction works on all of them.

Products of matrices of a few rows are too short for the processor's vectors. Across chunks, which know nothing of one
another, they are not: with `load` and `store` at the ends, a recursion is written as if for one chunk.

    total = lanes(0.0)
    for o in range(n):
        total += load(a[i, o]) * load(b[o, j])        # a (m, n, WIDTH), b (n, k, WIDTH)
    store(c[i, j], total)
"""

import operator
from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from nsde_torch.arrays import Array

WIDTH = 8  # doubles of a register of 512 bits, of two of 256
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_FLAGS = ("contract", "reassoc")  # as in `nsde_torch.jit`


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"lanes{WIDTH}")


_lanes = _Lanes()


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _VECTOR)


def _vector(context: Any, builder: Any, of: Any, value: Any) -> Any:
    """The lanes of a value; of a number, all alike."""
    if isinstance(of, _Lanes):
        return value
    number = context.cast(builder, value, of, types.float64)
    out = ir.Constant(_VECTOR, ir.Undefined)
    for lane in range(WIDTH):
        out = builder.insert_element(out, number, ir.Constant(ir.IntType(32), lane))
    return out


def _address(context: Any, builder: Any, of: Any, row: Any) -> Any:
    return builder.bitcast(context.make_array(of)(context, builder, row).data, _VECTOR.as_pointer())


@intrinsic
def _load(typing: Any, row: Any) -> Any:
    def made(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(_address(context, builder, signature.args[0], values[0]), align=8)

    return _lanes(row), made


@intrinsic
def _store(typing: Any, row: Any, value: Any) -> Any:
    def made(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector = _vector(context, builder, signature.args[1], values[1])
        builder.store(vector, _address(context, builder, signature.args[0], values[0]), align=8)
        return context.get_dummy_value()

    return types.void(row, value), made


@intrinsic
def _spread(typing: Any, number: Any) -> Any:
    def made(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _vector(context, builder, signature.args[0], values[0])

    return _lanes(number), made


@intrinsic
def _root(typing: Any, value: Any) -> Any:
    def made(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        of_lanes = ir.FunctionType(_VECTOR, [_VECTOR])
        name = f"llvm.sqrt.v{WIDTH}f64"
        return builder.call(
            builder.module.globals.get(name) or ir.Function(builder.module, of_lanes, name), values
        )

    return _lanes(value), made


def _offer(name: str, *symbols: Callable[..., Any]) -> None:
    """Have compiled code work on lanes, and lanes and a number, by an instruction of LLVM."""

    def operation(typing: Any, a: Any, b: Any) -> Any:
        def made(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            both = (_vector(context, builder, t, v) for t, v in zip(signature.args, values, strict=True))
            return getattr(builder, name)(*both, flags=_FLAGS)

        return _lanes(a, b), made

    instruction: Any = intrinsic(operation)

    def chosen(a: Any, b: Any) -> Any:
        some = isinstance(a, _Lanes) or isinstance(b, _Lanes)
        return (lambda a, b: instruction(a, b)) if some else None

    for symbol in symbols:
        overload(symbol, strict=False)(chosen)


_offer("fadd", operator.add, operator.iadd)
_offer("fsub", operator.sub, operator.isub)
_offer("fmul", operator.mul, operator.imul)
_offer("fdiv", operator.truediv)

# in compiled code a value of lanes is one number for each chunk; to a reader and a type checker it is a number
load = cast(Callable[[Array], float], _load)
store = cast(Callable[[Array, float], None], _store)
lanes = cast(Callable[[float], float], _spread)
root = cast(Callable[[float], float], _root)
