"""Functions of tensors as expressions of single numbers, and their derivatives.

A function is run with numpy arrays of `Scalar` in the place of tensors. What is constant is worked out, what repeats
is kept once, and products with 0 or 1 vanish, so that the sparsity of a Jacobian shows by itself. The derivative
follows rule by rule, forward from the inputs,

    d f(a, b) = f_a da + f_b db,       d max(a, b) = da or db, and their mean where a = b (torch's rule)

Wide affine maps of constant weights (layers of a network) stay whole: they and what is between them become a function
with loops, `Network`, whose Jacobian goes backwards from its few outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, final

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from nsde_torch.columns import few_operations
from nsde_torch.errors import ExportError

Number = Any  # a `Scalar`, or a float where it is constant
Table = np.ndarray[Any, Any]
_WIDE = 48  # weights that are not 0 from which on an affine map is a layer, and is not written out


@final
class Scalar:
    """One number: an operation (or `input`, `layer`, `slope`) on others; equal ones are the same object.

    `data` is what else tells it: the name and place of an input, the layer and place in it.
    """

    __slots__ = ("args", "data", "number", "op")
    _known: ClassVar[dict[Any, Scalar]] = {}

    def __init__(self, op: str, args: tuple[Number, ...], data: Any = None) -> None:
        self.op, self.args, self.data, self.number = op, args, data, len(Scalar._known)

    @classmethod
    def of(cls, op: str, *args: Number, data: Any = None) -> Scalar:
        """The one object of an operation."""
        key = (op, data, *((float, a) if isinstance(a, float) else id(a) for a in args))
        found = cls._known.get(key)
        if found is None:
            found = cls._known[key] = cls(op, args, data)
        return found

    def __add__(self, other: Number) -> Number:
        return add(self, other)

    def __sub__(self, other: Number) -> Number:
        return add(self, neg(_plain(other)))

    def __rsub__(self, other: Number) -> Number:
        return add(neg(self), other)

    def __mul__(self, other: Number) -> Number:
        return mul(self, other)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: Number) -> Number:
        return div(self, other)

    def __rtruediv__(self, other: Number) -> Number:
        return div(other, self)

    def __neg__(self) -> Number:
        return neg(self)


@contextmanager
def of_their_own() -> Iterator[None]:
    """Scalars that are made while it lasts are let go of after it."""
    Scalar._known.clear()
    try:
        yield
    finally:
        Scalar._known.clear()


def _plain(x: Number) -> Number:
    return x if isinstance(x, Scalar) else float(x)


def add(a: Number, b: Number) -> Number:
    a, b = _plain(a), _plain(b)
    if isinstance(a, float) and isinstance(b, float):
        return a + b
    if a == 0.0 or b == 0.0:
        return b if a == 0.0 else a
    for x, y in ((a, b), (b, a)):
        if isinstance(y, Scalar) and y.op == "neg":
            return 0.0 if x is y.args[0] else Scalar.of("sub", x, y.args[0])
    return Scalar.of("add", *_ordered(a, b))


def neg(a: Number) -> Number:
    if isinstance(a, float):
        return -a
    if a.op == "neg":
        return a.args[0]
    if a.op == "sub":
        return Scalar.of("sub", a.args[1], a.args[0])
    if a.op == "mul" and isinstance(a.args[0], float):
        return mul(-a.args[0], a.args[1])
    return Scalar.of("neg", a)


def mul(a: Number, b: Number) -> Number:
    """a b; 0 where a factor is the constant 0, whatever the other is."""
    a, b = _plain(a), _plain(b)
    if isinstance(a, float) and isinstance(b, float):
        return a * b
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float):
            if x == 0.0:
                return 0.0
            if x in (1.0, -1.0):
                return y if x > 0 else neg(y)
            if y.op == "neg":
                return mul(-x, y.args[0])
            if y.op == "mul" and isinstance(y.args[0], float):
                return mul(x * y.args[0], y.args[1])
            return Scalar.of("mul", x, y)
    if a.op == "neg" or b.op == "neg":
        sign = (a.op == "neg") != (b.op == "neg")
        a, b = (x.args[0] if x.op == "neg" else x for x in (a, b))
        return neg(mul(a, b)) if sign else mul(a, b)
    return Scalar.of("mul", *_ordered(a, b))


def div(a: Number, b: Number) -> Number:
    a, b = _plain(a), _plain(b)
    if isinstance(b, float) and b != 0.0:
        return a / b if isinstance(a, float) else mul(1.0 / b, a)
    return 0.0 if a == 0.0 and b != 0.0 else Scalar.of("div", a, b)


def _ordered(a: Number, b: Number) -> tuple[Number, Number]:
    if isinstance(a, float) or isinstance(b, float):
        return (a, b) if isinstance(a, float) else (b, a)
    return (a, b) if a.number <= b.number else (b, a)


FUNCTIONS = (
    *("sin", "cos", "tan", "exp", "expm1", "log", "log1p", "sqrt", "tanh", "atan", "acos", "asin", "asinh"),
    "floor",
)
"""Functions of one number that have the same name in torch, in Python and in C."""
_FOLDED: dict[str, Callable[..., float]] = {
    **{n: getattr(math, n) for n in (*FUNCTIONS, "atan2", "pow")},
    **{"abs": abs, "max": max, "min": min, "sign": lambda x: float(x > 0) - float(x < 0)},
    **{"lt": lambda a, b: float(a < b), "le": lambda a, b: float(a <= b), "eq": lambda a, b: float(a == b)},
}


def call(op: str, *args: Number) -> Number:
    """An operation by its name, worked out where it is constant."""
    given = tuple(map(_plain, args))
    if op == "where":
        condition, a, b = given
        if isinstance(condition, float) or a is b or a == b:
            return b if condition == 0.0 else a
        return Scalar.of(op, *given)
    if not all(isinstance(a, float) for a in given):
        return Scalar.of(op, *given)
    try:
        return float(_FOLDED[op](*given))
    except OverflowError:
        return math.inf
    except ValueError:  # no number where there is none, as in torch
        return math.nan


# ---- derivatives ----------------------------------------------------------------------------------------


def _slopes(x: Scalar) -> list[Number]:
    a, b = (*x.args, 0.0)[:2]
    if x.op in ("lt", "le", "eq", "sign", "floor"):
        return [0.0] * len(x.args)
    rules: dict[str, Callable[[], list[Number]]] = {
        "add": lambda: [1.0, 1.0],
        "sub": lambda: [1.0, -1.0],
        "mul": lambda: [b, a],
        "div": lambda: [div(1.0, b), neg(mul(x, div(1.0, b)))],
        "pow": lambda: [mul(b, call("pow", a, b - 1.0)), 0.0],
        "atan2": lambda: [b * div(1.0, a * a + b * b), neg(a * div(1.0, a * a + b * b))],
        "neg": lambda: [-1.0],
        "sin": lambda: [call("cos", a)],
        "cos": lambda: [neg(call("sin", a))],
        "tan": lambda: [1.0 + x * x],
        "exp": lambda: [x],
        "expm1": lambda: [1.0 + x],
        "log": lambda: [div(1.0, a)],
        "log1p": lambda: [div(1.0, 1.0 + a)],
        "sqrt": lambda: [div(0.5, x)],
        "tanh": lambda: [1.0 - x * x],
        "abs": lambda: [call("sign", a)],
        "atan": lambda: [div(1.0, 1.0 + a * a)],
        "asinh": lambda: [div(1.0, call("sqrt", 1.0 + a * a))],
        "acos": lambda: [div(-1.0, call("sqrt", 1.0 - a * a))],
        "asin": lambda: [div(1.0, call("sqrt", 1.0 - a * a))],
    }
    return rules[x.op]()


def _chosen(x: Scalar, parts: Sequence[Mapping[int, Number]]) -> dict[int, Number]:
    """Derivatives of what takes one of its arguments: chosen, since 0 times what is not taken may be no number."""
    out: dict[int, Number] = {}
    for k in sorted(set().union(*parts)):
        first, second, *third = (part.get(k, 0.0) for part in parts)
        if x.op == "where":
            out[k] = call("where", x.args[0], second, third[0])
        elif x.op == "clamped":  # (x, low, high): that of x on the bounds too
            low, high = call("le", x.args[1], x.args[0]), call("le", x.args[0], x.args[2])
            out[k] = call("where", mul(low, high), first, 0.0)
        else:
            a, b = x.args if x.op == "max" else x.args[::-1]
            mean = mul(0.5, add(first, second))
            out[k] = call("where", call("lt", b, a), first, call("where", call("lt", a, b), second, mean))
    return out


def in_order(outputs: Sequence[Number]) -> list[Scalar]:
    """All scalars that outputs follow from, arguments first."""
    seen: dict[int, Scalar] = {}
    stack: list[tuple[Number, bool]] = [(x, False) for x in reversed(outputs)]
    while stack:
        x, ready = stack.pop()
        if isinstance(x, float) or id(x) in seen:
            continue
        if ready:
            seen[id(x)] = x
        else:
            stack += [(x, True), *((a, False) for a in reversed(x.args))]
    return list(seen.values())


def jacobian(outputs: Sequence[Number], inputs: Sequence[Scalar]) -> list[dict[int, Number]]:
    """Derivatives of each output, by the place of the input, where they are not 0."""
    made: dict[int, dict[int, Number]] = {id(x): {k: 1.0} for k, x in enumerate(inputs)}
    for x in in_order(outputs):
        if id(x) in made or not x.args:
            continue
        if x.op in ("where", "clamped", "max", "min"):
            parts = [{} if isinstance(a, float) else made.get(id(a), {}) for a in x.args]
            made[id(x)] = _chosen(x, parts)
            continue
        if x.op == "layer":
            slopes: list[Number] = [
                Scalar.of("slope", *x.args, data=(*x.data, j)) for j in range(len(x.args))
            ]
        else:
            slopes = _slopes(x)
        total: dict[int, Number] = {}
        for slope, a in zip(slopes, x.args, strict=True):
            for k, part in ({} if isinstance(a, float) else made.get(id(a), {})).items():
                total[k] = add(total.get(k, 0.0), mul(slope, part))
        made[id(x)] = {k: v for k, v in total.items() if not (isinstance(v, float) and v == 0.0)}
    return [{} if isinstance(x, float) else made.get(id(x), {}) for x in outputs]


# ---- networks -------------------------------------------------------------------------------------------


@final
@dataclass(eq=False)
class Layer:
    """An affine map, and what lies between it and the layer below."""

    weight: Table  # (n_out, n_in)
    bias: Table  # (n_out,)
    below: Layer | None = None  # the layer below; None: its inputs are any scalars
    activation: Number = 0.0  # what is applied to the outputs of the layer below, of the scalar `PLACE`

    @property
    def chain(self) -> list[Layer]:
        """The layers from the first to this."""
        return [*([] if self.below is None else self.below.chain), self]

    def parts(self) -> list[list[list[int]]]:
        """Networks side by side are one with blocks on its diagonal: the units of each, by layer."""
        chain = self.chain
        starts = np.cumsum([0, *(len(layer.bias) for layer in chain)])
        above: list[int] = []
        below: list[int] = []
        for k, layer in enumerate(chain[1:], start=1):
            i, j = np.nonzero(layer.weight)
            above += (i + starts[k]).tolist()
            below += (j + starts[k - 1]).tolist()
        n = int(starts[-1])
        _, label = connected_components(coo_matrix((np.ones(len(above)), (above, below)), (n, n)), False)
        found = dict.fromkeys(label[starts[-2] :][chain[-1].weight.any(axis=1)].tolist())
        return [
            [np.flatnonzero(label[a:b] == one).tolist() for a, b in pairwise(starts.tolist())]
            for one in found
        ]


PLACE = Scalar("input", (), ("x", None))


def _layer(weight: Table, bias: Table, inputs: Sequence[Number]) -> Table:
    """Outputs of an affine map of constants: written out, or a layer where they follow from the inputs at all."""
    varying = [(j, x) for j, x in enumerate(inputs) if isinstance(x, Scalar) and weight[:, j].any()]
    leaves: list[Any] = [_leaf(x) for _, x in varying]
    inside = all(leaf is not None for leaf in leaves)
    if not varying or not (inside or np.count_nonzero(weight) > _WIDE):
        return np.array([_dot(row, inputs) + b for row, b in zip(weight, bias, strict=True)], object)
    weight, columns = weight.astype(float), [j for j, _ in varying]
    fixed = np.array([0.0 if isinstance(x, Scalar) else x for x in inputs])
    base: tuple[Number, ...] = tuple(x for _, x in varying)
    layer = Layer(weight[:, columns], bias.astype(float) + weight @ fixed)
    if inside:
        below, base = leaves[0].data[0], leaves[0].args
        forms = {id(f): f for f in (_at_place(x, leaf) for (_, x), leaf in zip(varying, leaves, strict=True))}
        if len(forms) != 1 or any(leaf.data[0] is not below for leaf in leaves):
            raise ExportError("a network whose layers are not one after another cannot be written in C.")
        full = np.zeros((len(bias), len(below.bias)))
        for j, leaf in zip(columns, leaves, strict=True):
            full[:, leaf.data[1]] += weight[:, j]
        (activation,) = forms.values()
        layer = Layer(full, layer.bias, below, activation)
    made = [Scalar.of("layer", *base, data=(layer, i)) for i in range(len(bias))]
    rows = zip(layer.weight, made, layer.bias.tolist(), strict=True)
    return np.array([x if row.any() else constant for row, x, constant in rows], object)


def _dot(a: Iterable[Number], b: Iterable[Number]) -> Number:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)


def _leaf(x: Number) -> Scalar | None:
    """The one output of a layer that a scalar is a function of, if it is of nothing else."""
    found: dict[int, Scalar] = {}
    stack = [x]
    while stack:
        y = stack.pop()
        if isinstance(y, float):
            continue
        if y.op == "layer":
            found[id(y)] = y
        elif not y.args:
            return None
        else:
            stack += y.args
    return next(iter(found.values())) if len(found) == 1 else None


def _at_place(x: Number, leaf: Scalar | None) -> Number:
    """The same function of `PLACE`."""
    made: dict[int, Number] = {id(leaf): PLACE}
    for y in in_order([x]):
        if y.args and id(y) not in made and y.op != "layer":
            args = (a if isinstance(a, float) else made.get(id(a), a) for a in y.args)
            made[id(y)] = Scalar.of(y.op, *args, data=y.data)
    return made[id(x)]


# ---- functions of tensors -------------------------------------------------------------------------------


def inputs(name: str, *shape: int) -> Table:
    """A table of inputs, `name[0]`, `name[1]`, ... row by row."""
    n = math.prod(shape)
    return np.array([Scalar.of("input", data=(name, k)) for k in range(n)], object).reshape(shape)


def run(
    function: Callable[..., Sequence[Tensor]],
    arguments: Sequence[Table],
    *,
    dtype: torch.dtype = torch.float64,
) -> list[Table]:
    """What a function of tensors of a type makes of tables of scalars of the shapes of its arguments.

    The function has operations that change nothing in place, and no branches on values. ExportError: it holds an
    operation that is not known here.
    """
    with torch.no_grad(), few_operations():
        made = function(*(_Symbolic(table, dtype) for table in arguments))
    return [_table(x) for x in made]


class _Symbolic(Tensor):
    """A table of scalars where a tensor is expected: torch hands each operation on it to its rule."""

    table: Table
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, table: Table, dtype: torch.dtype) -> _Symbolic:
        made: _Symbolic = Tensor._make_wrapper_subclass(cls, table.shape, dtype=dtype)
        made.table = table
        return made

    @classmethod
    def __torch_dispatch__(cls, op: Any, types: Any, args: Any, kwargs: Any) -> Any:  # type: ignore[override]
        name, named = op._opname, kwargs or {}
        rule = _RULES.get(name)
        if rule is None:
            raise ExportError(f"the model holds torch's {name}, which cannot be written in C.")
        own = next(x.dtype for x in tree_leaves((args, named)) if isinstance(x, _Symbolic))
        dtype = torch.bool if name in _ASKED else named.get("dtype") or own
        if name == "where":
            dtype = next((x.dtype for x in args[1:] if isinstance(x, Tensor) and x.ndim), dtype)

        def given(x: Any) -> Any:
            return _table(x) if isinstance(x, Tensor) else x

        made = rule(*(tree_map(given, a) for a in args), **{k: tree_map(given, v) for k, v in named.items()})
        if isinstance(made, list):
            return [_Symbolic(part, dtype) for part in made]
        return _Symbolic(np.asarray(made, object), dtype)


def _table(x: Tensor) -> Table:
    return x.table if isinstance(x, _Symbolic) else np.asarray(x.detach().double().numpy()).astype(object)


def _each(op: str) -> Callable[..., Table]:
    """An operation on each element."""
    count = {"where": 3, "max": 2, "min": 2, "lt": 2, "le": 2, "eq": 2, "atan2": 2, "pow": 2}.get(op, 1)
    one = np.frompyfunc(lambda *a: call(op, *a), count, 1)
    return lambda *a, **_: np.asarray(one(*a), object)


def _clamp(x: Table, low: Number = None, high: Number = None) -> Table:
    a, b = -math.inf if low is None else low, math.inf if high is None else high

    def one(v: Number, lo: Number, hi: Number) -> Number:
        if isinstance(v, float):
            return min(max(v, lo), hi)
        return Scalar.of("clamped", v, lo, hi)

    return np.asarray(np.frompyfunc(one, 3, 1)(x, a, b), object)


def _power(x: Table, n: Number) -> Table:
    if isinstance(n, (int, float)) and float(n).is_integer() and 1 <= n <= 4:
        return math.prod([x] * (int(n) - 1), start=x)
    return _each("pow")(x, n)


def _product(a: Table, b: Table, bias: Table | float = 0.0) -> Table:
    """bias + a b of two tables, layers where one is constant and the other a column or a row."""
    n, m = a.shape[0], b.shape[1]
    full = np.broadcast_to(np.asarray(bias, object), (n, m))
    if m == 1 and _constant(a) and _constant(full) and not _constant(b):
        return _layer(a, full[:, 0], list(b[:, 0])).reshape(n, m)
    if n == 1 and _constant(b) and _constant(full) and not _constant(a):
        return _layer(b.T, full[0], list(a[0])).reshape(n, m)
    return np.array([[_dot(row, column) for column in b.T] for row in a], object).reshape(n, m) + full


def _constant(x: Table) -> bool:
    return all(isinstance(v, float) for v in x.flat)


def _slice(x: Table, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Table:
    cut: list[Any] = [slice(None)] * x.ndim
    cut[dim] = slice(start, end, step)
    return x[tuple(cut)]


def _split(x: Table, sizes: Sequence[int] | int, dim: int = 0) -> list[Table]:
    cuts = range(sizes, x.shape[dim], sizes) if isinstance(sizes, int) else np.cumsum(sizes)[:-1].tolist()
    return np.split(x, list(cuts), dim)


def _sum(x: Table, dim: Any = None, keepdim: bool = False, **_: Any) -> Table:
    axis = None if dim is None or dim == [] else tuple(dim) if isinstance(dim, list) else dim
    return np.asarray(np.sum(x, axis=axis, keepdims=keepdim), object)


def _norm(x: Table, order: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> Table:
    if order != 2:
        raise ExportError("a norm other than the Euclidean cannot be written in C.")
    return _each("sqrt")(_sum(x * x, dim, keepdim))


def _cross(a: Table, b: Table, dim: int = -1) -> Table:
    (ax, ay, az), (bx, by, bz) = (np.moveaxis(t, dim, 0) for t in (a, b))
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), dim)


def _sigmoid(x: Table) -> Table:
    return 1.0 / (1.0 + _each("exp")(-x))


def _softplus(x: Table, beta: float = 1.0, threshold: float = 20.0) -> Table:
    # of the smaller one, so that no exponential overflows
    low = _each("min")(beta * x, threshold)
    return _each("where")(_each("lt")(threshold, beta * x), x, _each("log1p")(_each("exp")(low)) / beta)


def _at(x: Table, places: Sequence[Table | None]) -> Table:
    """Rows and columns by lists of their numbers."""
    return x[tuple(slice(None) if k is None else k.astype(int) for k in places)]


_ASKED = {"lt", "le", "gt", "ge", "eq", "ne"} | {
    f"{a}_{b}" for a in ("logical", "bitwise") for b in ("and", "or", "not")
}
"""Operations whose results are true or false."""
_RULES: Mapping[str, Callable[..., Any]] = {
    **{n: _each(n) for n in (*FUNCTIONS, "abs", "atan2", "sign", "where", "lt", "le", "eq")},
    **dict.fromkeys(
        ("alias", "clone", "detach", "_to_copy", "contiguous", "lift_fresh_copy"), lambda x, *_, **__: x
    ),
    **dict.fromkeys(("view", "reshape", "_unsafe_view"), lambda x, shape: x.reshape(shape)),
    **dict.fromkeys(("bitwise_and", "logical_and"), lambda a, b: a * b),
    **dict.fromkeys(("bitwise_or", "logical_or"), lambda a, b: _each("max")(a, b)),
    **dict.fromkeys(("bitwise_not", "logical_not"), lambda a: 1.0 - a),
    "sgn": _each("sign"),
    "ceil": lambda a: -_each("floor")(-a),
    "cosh": lambda a: (_each("exp")(a) + _each("exp")(-a)) / 2.0,
    "sinh": lambda a: (_each("expm1")(a) - _each("expm1")(-a)) / 2.0,
    "hypot": lambda a, b: _each("sqrt")(a * a + b * b),
    "softplus": _softplus,
    "maximum": _each("max"),
    "minimum": _each("min"),
    "gt": lambda a, b: _each("lt")(b, a),
    "ge": lambda a, b: _each("le")(b, a),
    "ne": lambda a, b: 1.0 - _each("eq")(a, b),
    "add": lambda a, b, alpha=1: a + alpha * b,
    "sub": lambda a, b, alpha=1: a - alpha * b,
    "rsub": lambda a, b, alpha=1: b - alpha * a,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "remainder": lambda a, b: a - b * _each("floor")(a / b),
    "neg": lambda a: -a,
    "reciprocal": lambda a: 1.0 / a,
    "rsqrt": lambda a: 1.0 / _each("sqrt")(a),
    "sigmoid": _sigmoid,
    "silu": lambda a: a * _sigmoid(a),
    # the slope at 0 is 0, as torch has it
    "relu": lambda a: _each("where")(_each("lt")(0.0, a), a, 0.0),
    "pow": _power,
    "clamp": _clamp,
    "clamp_min": lambda x, low: _clamp(x, low),
    "clamp_max": lambda x, high: _clamp(x, None, high),
    "mm": _product,
    "addmm": lambda bias, a, b: _product(a, b, bias),
    "bmm": lambda a, b: np.stack([_product(x, y) for x, y in zip(a, b, strict=True)]),
    "mv": lambda a, b: _product(a, b[:, None])[:, 0],
    "t": lambda x: x.T,
    "permute": lambda x, order: x.transpose(order),
    "transpose": lambda x, a, b: x.swapaxes(a, b),
    "expand": lambda x, shape: np.broadcast_to(
        x, [n if s == -1 else s for s, n in zip(shape, (*[1] * (len(shape) - x.ndim), *x.shape), strict=True)]
    ),
    "unsqueeze": lambda x, dim: np.expand_dims(x, dim),
    "squeeze": lambda x, dim=None: np.squeeze(x, dim),
    "select": lambda x, dim, k: np.take(x, k, axis=dim),
    "slice": _slice,
    **dict.fromkeys(("split", "split_with_sizes"), _split),
    "unbind": lambda x, dim=0: [np.take(x, k, axis=dim) for k in range(x.shape[dim])],
    "cat": lambda parts, dim=0: np.concatenate(parts, dim),
    "stack": lambda parts, dim=0: np.stack(parts, dim),
    "roll": lambda x, by, dim: np.roll(x, by[0], dim[0]),
    "index_select": lambda x, dim, rows: np.take(x, rows.astype(int), axis=dim),
    "index": _at,
    "flip": lambda x, dims: np.flip(x, dims),
    "prod": lambda x, dim=None, keepdim=False, **_: np.asarray(
        np.prod(x, axis=dim, keepdims=keepdim), object
    ),
    "sum": _sum,
    "mean": lambda x, dim=None, keepdim=False, **_: (s := _sum(x, dim, keepdim)) / (x.size / s.size),
    "linalg_vector_norm": _norm,
    "linalg_cross": _cross,
    "zeros_like": lambda x, **_: np.full(x.shape, 0.0, object),
    "ones_like": lambda x, **_: np.full(x.shape, 1.0, object),
    "new_zeros": lambda x, shape, **_: np.full(shape, 0.0, object),
    "new_ones": lambda x, shape, **_: np.full(shape, 1.0, object),
    "new_full": lambda x, shape, value, **_: np.full(shape, float(value), object),
    "full_like": lambda x, value, **_: np.full(x.shape, float(value), object),
    "scalar_tensor": lambda x, **_: np.array(float(x), object),
}
