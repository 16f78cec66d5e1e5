"""Graphs of fewer operations keep their values, and lose the operations that they need not have."""

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from nsde_torch.export.graph import graph_of

_X = torch.linspace(-1.0, 2.0, 35, dtype=torch.float64).view(5, 7)
_Y = torch.linspace(0.3, -4.0, 35, dtype=torch.float64).view(5, 7)
_M = torch.linspace(-1.0, 1.0, 49, dtype=torch.float64).view(7, 7)


def _cut_and_joined(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    a, b, nothing = torch.cat((x, y), 1).split((7, 7, 0), 1)
    return a * b + torch.cat((nothing, x), 1), nothing + 1.0


def _cut_across(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    a, b = torch.cat((x, y, x), 1).split((14, 7), 1)
    return torch.cat((a.sin(), b), 1), torch.cat((x, y), 1).split((3, 11), 1)[1]


def _nested(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    return (torch.cat((torch.cat((x, y), 1), x), 1),)


def _multiple(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    return x + 0.5 * y, x - 3.0 * y, 2.0 * x - y


def _product(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    return x + y @ _M, x[:1] + y @ _M


@pytest.mark.parametrize(
    ("function", "gone", "left"),
    [
        (_cut_and_joined, {"split_with_sizes", "cat"}, {"mul", "add"}),
        (_cut_across, set(), {"cat", "sin", "split_with_sizes"}),
        (_nested, set(), {"cat"}),
        (_multiple, set(), {"add", "sub"}),
        (_product, {"mm", "add"}, {"addmm"}),
    ],
)
def test_values_stay_and_operations_go(
    function: Callable[..., Sequence[Tensor]], gone: set[str], left: set[str]
) -> None:
    graph = graph_of(function, (_X, _Y))
    for ours, theirs in zip(graph(_X, _Y), function(_X, _Y), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-14, atol=1e-14)
    names = [str(n.target).split(".")[1] for n in graph.graph.nodes if str(n.target).startswith("aten.")]
    assert left <= set(names)
    assert not gone & set(names)
    plain = graph_of(function, (_X, _Y), few=False)
    assert len(names) <= len([n for n in plain.graph.nodes if str(n.target).startswith("aten.")])


def test_a_multiple_that_is_used_twice_is_kept() -> None:
    graph = graph_of(lambda x, y: ((z := 0.5 * y) + x, z.sin()), (_X, _Y))
    assert any("mul" in str(n.target) for n in graph.graph.nodes)
    assert torch.equal(graph(_X, _Y)[1], (0.5 * _Y).sin())
