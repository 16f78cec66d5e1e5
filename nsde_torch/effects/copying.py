"""Copies of modules, without the dozen empty tables of hooks that `copy.deepcopy` takes apart in every one.

A diagnosis copies systems by the thousand.
"""

from __future__ import annotations

import copy
from typing import Any

from torch import nn


def copied(module: nn.Module, memo: dict[int, Any]) -> Any:
    """A deep copy of a module, for its `__deepcopy__`.

    Args:
        module: What is copied.
        memo: That of `copy.deepcopy`.
    """
    out = memo[id(module)] = type(module).__new__(type(module))
    for name, value in vars(module).items():
        vars(out)[name] = _copied(value, memo)
    return out


def _copied(value: Any, memo: dict[int, Any]) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    known = memo.get(id(value))
    if known is not None:
        return known
    if isinstance(value, (nn.ModuleList, nn.ParameterDict)):
        return copied(value, memo)
    if type(value) is dict:
        table = memo[id(value)] = {}
        table.update((key, _copied(one, memo)) for key, one in value.items())
        return table
    if isinstance(value, dict) and not value:
        memo[id(value)] = copy.copy(value)
        return memo[id(value)]
    return copy.deepcopy(value, memo)
