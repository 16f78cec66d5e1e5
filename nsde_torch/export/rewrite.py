"""Rules that take operations out of a graph whose shapes are known, and leave its values up to rounding.

    split(cat(a, b, ...)) -> a, b, ...                   cat(cat(a, b), c) -> cat(a, b, c)
    x + c y               -> add(x, y, alpha=c)          x + a @ b         -> addmm(x, a, b)

Parts of no width are constants, and are left out of what is put together and cut.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from operator import getitem
from typing import Any

import torch
from torch import Tensor, fx

_aten = torch.ops.aten
_CAT, _SPLIT = _aten.cat.default, _aten.split_with_sizes.default
_ADD, _SUB, _MUL, _MM = _aten.add.Tensor, _aten.sub.Tensor, _aten.mul.Tensor, _aten.mm.default
Shapes = Callable[[fx.Node], Sequence[int] | None]


def rewrite(graph: fx.Graph, values: Mapping[fx.Node, object]) -> None:
    """One pass over a graph.

    Args:
        graph: Of torch's operations, none of which changes a tensor in place.
        values: Values of its nodes for an example, for their shapes.
    """
    made: dict[fx.Node, Sequence[int]] = {}

    def shape(node: fx.Node) -> Sequence[int] | None:
        value = values.get(node)
        return tuple(value.shape) if isinstance(value, Tensor) else made.get(node)

    for node in list(graph.nodes):
        if node.target is _CAT:
            _flatten(node, shape)
        elif node.target is _SPLIT:
            _narrow(node, shape)
        elif node.target is getitem:
            new = _uncut(graph, node, shape)
            if new is not None:
                made[new] = shape(node) or ()
                node.replace_all_uses_with(new)
        elif node.target in (_ADD, _SUB):
            _join(node, shape, values)


def _axis(node: fx.Node, ndim: int, at: int) -> int:
    axis: Any = node.args[at] if len(node.args) > at else 0
    return int(axis) % ndim


def _flatten(node: fx.Node, shape: Shapes) -> None:
    """Parts of no width are left out, and those of a part that is put together itself take its place."""
    own = shape(node)
    if own is None:
        return
    axis = _axis(node, len(own), 1)
    parts: list[fx.Node] = []
    for part in _parts(node):
        size = shape(part)
        if size is not None and size[axis] == 0:
            continue
        if part.target is _CAT and len(part.users) == 1 and _axis(part, len(own), 1) == axis:
            parts += _parts(part)
        else:
            parts.append(part)
    if len(parts) == 1:
        node.replace_all_uses_with(parts[0])
    elif parts:
        node.args = (parts, axis)


def _narrow(node: fx.Node, shape: Shapes) -> None:
    """Last parts of no width that nobody takes are not cut off."""
    widths: Any = list(node.args[1])  # type: ignore[arg-type]
    taken = {user.args[1] for user in node.users if user.target is getitem and user.users}
    while len(widths) > 1 and widths[-1] == 0 and len(widths) - 1 not in taken:
        widths.pop()
    node.args = (node.args[0], widths, *node.args[2:])


def _uncut(graph: fx.Graph, node: fx.Node, shape: Shapes) -> fx.Node | None:
    """The parts of what was put together that a cut takes out again, where it cuts between them."""
    split: Any = node.args[0]
    if split.target is not _SPLIT or split.args[0].target is not _CAT:
        return None
    cat = split.args[0]
    own, sizes = shape(cat), [shape(part) for part in _parts(cat)]
    if own is None or any(size is None or len(size) != len(own) for size in sizes):
        return None
    axis = _axis(split, len(own), 2)
    if _axis(cat, len(own), 1) != axis:
        return None
    ends = [0, *accumulate(size[axis] for size in sizes if size is not None)]
    place: Any = node.args[1]
    cuts = [0, *accumulate(split.args[1])]
    low, high = cuts[place], cuts[place + 1]
    if low == high or low not in ends or high not in ends:
        return None
    inside = _parts(cat)[ends.index(low) : ends.index(high)]
    if len(inside) == 1:
        return inside[0]
    with graph.inserting_before(node):
        return graph.call_function(_CAT, (inside, axis))


def _join(node: fx.Node, shape: Shapes, values: Mapping[fx.Node, object]) -> None:
    """A sum with a multiple, or with a product of matrices, as one operation."""
    if node.kwargs or len(node.args) != 2:
        return
    first, second = node.args
    sides = [(first, second), (second, first)] if node.target is _ADD else [(first, second)]
    for rest, other in sides:
        if not isinstance(rest, fx.Node) or not isinstance(other, fx.Node) or len(other.users) != 1:
            continue
        if shape(rest) is None or not _same_type(values, rest, other):
            continue
        if other.target is _MUL and isinstance(other.args[1], (int, float)):
            node.args, node.kwargs = (rest, other.args[0]), {"alpha": other.args[1]}
            return
        if other.target is _MM and node.target is _ADD and shape(other) == shape(node):
            node.target, node.args = _aten.addmm.default, (rest, *other.args)
            return


def _same_type(values: Mapping[fx.Node, object], a: fx.Node, b: fx.Node) -> bool:
    of_a, of_b = values.get(a), values.get(b)
    return isinstance(of_a, Tensor) and isinstance(of_b, Tensor) and of_a.dtype == of_b.dtype


def _parts(cat: fx.Node) -> list[fx.Node]:
    parts: Any = cat.args[0]
    return list(parts)
