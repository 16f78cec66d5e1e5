"""Functions of plain tensors as graphs of few operations, with all that is constant worked out beforehand.

`make_fx` writes down the operations of a function of fixed shapes, derivatives among them. What an interpreter then
pays for is their number, so what does nothing is taken out, what repeats is done once, what follows from constants
alone becomes a constant, and what is put together to be cut again is not.
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

_aten = torch.ops.aten
_CAT, _SPLIT = _aten.cat.default, _aten.split_with_sizes.default
_SAME = {
    *(_aten.alias.default, _aten.detach.default, _aten.lift_fresh_copy.default, _aten.clone.default),
    _aten._to_copy.default,
}
"""Give their argument back where its type is theirs, in a graph that changes no tensor in place."""
_FILLED = {
    *(_aten.zeros_like.default, _aten.ones_like.default, _aten.full_like.default, _aten.new_zeros.default),
    *(_aten.new_ones.default, _aten.new_full.default, _aten._new_zeros_with_same_feature_meta.default),
}
"""Follow from the shape of their argument alone."""
_SHAPED = {
    *(_aten.view.default, _aten._unsafe_view.default, _aten.reshape.default, _aten.expand.default),
    _aten.slice.Tensor,
}
"""Give their argument back where it has their shape."""
_LARGEST = 1 << 20
Values = Mapping[fx.Node, Any]  # of the nodes of a graph, for an example


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
    made.graph.eliminate_dead_code()
    made.graph = fx_graph_cse(made.graph)
    size = 0
    while few and size != len(made.graph.nodes):
        size = len(made.graph.nodes)
        with torch.no_grad():
            _fold(made, example)
    made.recompile()
    return made


def _fold(module: fx.GraphModule, example: Sequence[Tensor]) -> None:
    """One pass over a graph: constants, operations that do nothing, that repeat, cuts between parts."""
    values = fx.Interpreter(module, garbage_collect_values=False)
    values.run(*example)
    graph, known = module.graph, values.env
    constants: dict[object, fx.Node] = {}  # by what they hold
    fixed: set[fx.Node] = set()  # nodes that follow from constants alone

    def constant(value: Tensor, before: fx.Node) -> fx.Node:
        # a copy: tensors of the model are shared by stages, and constants of a graph are its own
        value = value.detach().clone().contiguous()
        key = tuple(value.shape), value.dtype, value.view(-1).numpy().tobytes()
        if key not in constants:
            names = (f"folded_{k}" for k in range(len(module._buffers) + 1))
            name = next(name for name in names if name not in module._buffers)
            module.register_buffer(name, value)
            with graph.inserting_before(before):
                constants[key] = new = graph.get_attr(name)
            fixed.add(new)
            known[new] = value
        return constants[key]

    for node in list(graph.nodes):
        inputs = node.all_input_nodes
        if node.op == "get_attr":
            known[node] = getattr(module, str(node.target))
        elif node.op != "call_function":
            continue
        value, follows = known.get(node), all(n in fixed for n in inputs)
        if not isinstance(value, Tensor):
            fixed |= {node} if follows and inputs else set()
        elif (follows or node.target in _FILLED or not value.numel()) and value.numel() <= _LARGEST:
            _give(node, constant(value, node))
        elif node.target is getitem and (parts := _uncut(node, known)):
            with graph.inserting_before(node):
                new = (
                    parts[0]
                    if len(parts) == 1
                    else graph.call_function(_CAT, (parts, _axis(inputs[0], known)))
                )
            known[new] = value
            _give(node, new)
        elif _is_nothing(node, known[inputs[0]], value):
            _give(node, inputs[0])
    graph.eliminate_dead_code()
    module.graph = fx_graph_cse(graph)
    module.graph.eliminate_dead_code()
    module.delete_all_unused_submodules()
    used = {str(n.target) for n in module.graph.nodes if n.op == "get_attr"}
    for name in [name for name in module._buffers if name not in used]:
        del module._buffers[name]
    module.recompile()


def _give(node: fx.Node, instead: fx.Node) -> None:
    node.replace_all_uses_with(instead)
    node.graph.erase_node(node)


def _axis(node: fx.Node, known: Values) -> int:
    """Axis of a cut, or of what is put together."""
    axis: Any = node.args[-1] if isinstance(node.args[-1], int) else 0
    source: Any = node.all_input_nodes[0]
    return int(axis) % known[source].ndim


def _uncut(node: fx.Node, known: Values) -> list[fx.Node]:
    """The parts that a cut takes out of what was put together, or the whole; none where it cuts through a part."""
    split: Any = node.args[0]
    if split.target is not _SPLIT:
        return []
    place: Any = node.args[1]
    joined, axis = split.args[0], _axis(split, known)
    if known[joined].shape == known[node].shape:
        return [joined]
    if joined.target is not _CAT or _axis(joined, known) != axis:
        return []
    parts: Any = joined.args[0]
    ends = [0, *accumulate(known[part].shape[axis] for part in parts)]
    cuts: list[int] = [0, *accumulate(split.args[1])]
    low, high = cuts[place], cuts[place + 1]
    return parts[ends.index(low) : ends.index(high)] if low in ends and high in ends else []


def _is_nothing(node: fx.Node, before: object, after: Tensor) -> bool:
    """Whether an operation gives its first argument back."""
    if not isinstance(before, Tensor) or before.dtype != after.dtype:
        return False
    if node.target in _SAME:
        return before.stride() == after.stride()
    return node.target in _SHAPED and before.shape == after.shape
