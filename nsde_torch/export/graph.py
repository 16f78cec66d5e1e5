"""Functions of plain tensors as graphs of few operations, with all that is constant worked out beforehand.

`make_fx` writes down the operations of a function of fixed shapes, derivatives among them. What an interpreter then
pays for is their number, so what does nothing is taken out, what repeats is done once, and what follows from constants
alone becomes a constant.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from itertools import accumulate
from operator import getitem
from typing import Any

import torch
from torch import Tensor, fx
from torch._functorch.compile_utils import fx_graph_cse
from torch.fx.experimental.proxy_tensor import make_fx

from nsde_torch.columns import few_operations

# Rules that take operations out of a graph whose shapes are known, and leave its values up to rounding.
#
#     split(cat(a, b, ...)) -> a, b, ...                   cat(cat(a, b), c) -> cat(a, b, c)
#     x + c y               -> add(x, y, alpha=c)          x + a @ b         -> addmm(x, a, b)
#
# Parts of no width are constants, and are left out when parts are put together and cut.

_aten = torch.ops.aten
_CAT, _SPLIT = _aten.cat.default, _aten.split_with_sizes.default
_ADD, _SUB, _MUL, _MM = _aten.add.Tensor, _aten.sub.Tensor, _aten.mul.Tensor, _aten.mm.default
Shapes = Callable[[fx.Node], Sequence[int] | None]


def rewrite(graph: fx.Graph, values: Mapping[fx.Node, object]) -> None:
    """One pass over a graph none of whose operations changes a tensor in place.

    `values` are those of its nodes for an example, for their shapes.
    """
    made: dict[fx.Node, Sequence[int]] = {}

    def shape(node: fx.Node) -> Sequence[int] | None:
        value = values.get(node)
        return tuple(value.shape) if isinstance(value, Tensor) else made.get(node)

    for node in list(graph.nodes):
        if node.target is _CAT:
            _flatten(node, shape)
        elif node.target is _SPLIT:
            _narrow(node)
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


def _narrow(node: fx.Node) -> None:
    """Last parts of no width that nobody takes are not cut off."""
    widths: Any = list(node.args[1])  # type: ignore[arg-type]
    taken = {user.args[1] for user in node.users if user.target is getitem and user.users}
    while len(widths) > 1 and widths[-1] == 0 and len(widths) - 1 not in taken:
        widths.pop()
    node.args = (node.args[0], widths, *node.args[2:])


def _uncut(graph: fx.Graph, node: fx.Node, shape: Shapes) -> fx.Node | None:
    """The joined parts that a cut takes out again, where it cuts between them."""
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
    for rest, other in ((first, second), (second, first))[: 2 if node.target is _ADD else 1]:
        if not isinstance(rest, fx.Node) or not isinstance(other, fx.Node) or len(other.users) != 1:
            continue
        a, b = values.get(rest), values.get(other)
        if not (isinstance(a, Tensor) and isinstance(b, Tensor) and a.dtype == b.dtype):
            continue
        if other.target is _MUL and isinstance(other.args[1], (int, float)):
            node.args, node.kwargs = (rest, other.args[0]), {"alpha": other.args[1]}
            return
        if other.target is _MM and node.target is _ADD and shape(other) == shape(node):
            node.target, node.args = _aten.addmm.default, (rest, *other.args)
            return


def _parts(cat: fx.Node) -> list[fx.Node]:
    parts: Any = cat.args[0]
    return list(parts)


_SAME = {_aten.alias.default, _aten.detach.default, _aten.lift_fresh_copy.default, _aten.clone.default}
"""Give their argument back, in a graph that changes no tensor in place."""
_FILLED = {
    *(_aten.zeros_like.default, _aten.ones_like.default, _aten.full_like.default, _aten.new_zeros.default),
    *(_aten.new_ones.default, _aten.new_full.default, _aten._new_zeros_with_same_feature_meta.default),
}
"""Follow from the shape of their argument alone."""
_SHAPED = {_aten.view.default, _aten._unsafe_view.default, _aten.reshape.default}
_LARGEST = 1 << 20
_FOLDED = "folded_"


def graph_of(
    function: Callable[..., Sequence[Tensor]], example: Sequence[Tensor], *, few: bool = True
) -> fx.GraphModule:
    """A function of tensors, without branches on their values, as a graph of torch's operations.

    Shapes and types are those of the `example`. With `few`, it has as few operations as there can be; else as the
    function.
    """

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        return tuple(function(*arguments))

    with torch.no_grad(), few_operations() if few else nullcontext():
        made = make_fx(run)(*example)
    if not few:
        made.graph = fx_graph_cse(made.graph)
        made.graph.eliminate_dead_code()
    size = 0
    while few and size != len(made.graph.nodes):
        size = len(made.graph.nodes)
        with torch.no_grad():
            _fold(made, example)
    made.recompile()
    return made


def _fold(module: fx.GraphModule, example: Sequence[Tensor]) -> None:
    """One pass over a graph: constants, operations that do nothing, operations that repeat."""
    values = fx.Interpreter(module, garbage_collect_values=False)
    values.run(*example)
    graph, known = module.graph, values.env  # the value of every node
    constant: set[fx.Node] = set()
    seen: dict[tuple[object, ...], fx.Node] = {}
    for node in list(graph.nodes):
        if node.op == "get_attr":
            constant.add(node)
            known[node] = own_value = getattr(module, str(node.target))
            assert isinstance(own_value, Tensor)
            if not str(node.target).startswith(_FOLDED):
                # a copy: tensors of the model are shared by stages, and constants of a graph are its own
                own = _replace_by_constant(module, node, own_value, constant)
                known[own] = own_value
                seen.setdefault(_content(own_value), own)
                continue
            same = seen.setdefault(_content(own_value), node)
            if same is not node:
                node.replace_all_uses_with(same)
                graph.erase_node(node)
            continue
        if node.op != "call_function":
            continue
        value = known.get(node)
        if not isinstance(value, Tensor):
            if all(n in constant for n in node.all_input_nodes) and node.all_input_nodes:
                constant.add(node)
            continue
        inputs = node.all_input_nodes
        source = inputs[0] if inputs else None
        if (
            node.target in _FILLED or not value.numel() or all(n in constant for n in inputs)
        ) and value.numel() <= _LARGEST:
            known[_replace_by_constant(module, node, value, constant)] = value
        elif node.target is _aten.copy_.default and inputs[0] is not inputs[-1]:
            # derivatives are copied into fresh zeros
            assert known[inputs[1]].shape == value.shape
            node.replace_all_uses_with(inputs[1])
            graph.erase_node(node)
        elif (
            node.target is getitem
            and inputs[0].target is _SPLIT
            and getattr(known[inputs[0].all_input_nodes[0]], "shape", None) == value.shape
        ):
            # the one part of a table cut into one
            node.replace_all_uses_with(inputs[0].all_input_nodes[0])
            graph.erase_node(node)
        elif source is not None and _is_nothing(node, known[source], value):
            node.replace_all_uses_with(source)
            graph.erase_node(node)
        elif node.target in _SHAPED and source is not None and source.target in _SHAPED:
            node.replace_input_with(source, source.all_input_nodes[0])
        elif node.target is _aten.permute.default and source is not None and source.target is node.target:
            before = source.args[1]
            node.args = (source.args[0], [before[k] for k in node.args[1]])
    graph.eliminate_dead_code()
    rewrite(graph, known)
    graph.eliminate_dead_code()
    module.graph = fx_graph_cse(graph)
    module.graph.eliminate_dead_code()
    module.delete_all_unused_submodules()
    used = {str(n.target) for n in module.graph.nodes if n.op == "get_attr"}
    for name in [name for name in module._buffers if name not in used]:
        del module._buffers[name]
    module.recompile()


def _replace_by_constant(
    module: fx.GraphModule, node: fx.Node, value: Tensor, constant: set[fx.Node]
) -> fx.Node:
    names = (f"{_FOLDED}{k}" for k in range(len(module._buffers) + 1))
    name = next(name for name in names if name not in module._buffers)
    module.register_buffer(name, value.clone().contiguous())
    with module.graph.inserting_before(node):
        new = module.graph.get_attr(name)
    constant.add(new)
    node.replace_all_uses_with(new)
    module.graph.erase_node(node)
    return new


def _is_nothing(node: fx.Node, before: object, after: Tensor) -> bool:
    """Whether an operation gives its first argument back."""
    if not isinstance(before, Tensor) or before.dtype != after.dtype:
        return False
    if node.target in _SAME or node.target is _aten._to_copy.default:
        return before.stride() == after.stride()
    if before.shape != after.shape:
        return False
    if node.target in (*_SHAPED, _aten.expand.default, _aten.slice.Tensor):
        return True
    if node.target is _aten.permute.default:
        order: Any = node.args[1]
        return all(before.shape[k] == 1 or k == place for place, k in enumerate(order))
    return node.target in (_MUL, _aten.div.Tensor) and node.args[1] in (1, 1.0)


def _content(value: Tensor) -> tuple[object, ...]:
    """What constants of one value have in common."""
    value = value.detach().contiguous()
    return tuple(value.shape), value.dtype, value.view(-1).numpy().tobytes()
