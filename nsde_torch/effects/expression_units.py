"""Units of the coefficients of a law: what is added has one unit, and every term has that of the port.

    force [m/s2] = c1 q q_dot - c2 max(q - k1, 0)^2         c1 [1/(m s)], c2 [1/(m s2)], k1 [m]

Angles of `sin` and `cos` are in rad. A variable of unknown unit leaves the units that hang on it unknown.
"""

from __future__ import annotations

from collections.abc import Mapping

from nsde_torch.effects import units
from nsde_torch.effects.expression_grammar import (
    Call,
    Coefficient,
    Node,
    Power,
    Product,
    Sum,
    Variable,
    Whole,
    Written,
    in_text,
)
from nsde_torch.errors import ConfigError

UNKNOWN = "SI"
"""Unit of a coefficient that hangs on a variable of unknown unit."""


def coefficient_units(law: Written, variables: Mapping[str, str], port: str) -> dict[str, str]:
    """Unit of each coefficient of a law.

    Args:
        law: The law.
        variables: Unit of each variable; empty where it is unknown.
        port: Unit of what the law adds.

    Raises:
        ConfigError: things of different units are added, or an angle is none.
    """
    known = {name: units.powers(unit) if unit else None for name, unit in variables.items()}
    settling = _Settling(law.text, known)
    for _ in range(2):  # what the second term says of a shape helps the first
        for _, term in law.right.parts:
            settling.settle(term, units.powers(port) if port else None)
    out = {}
    for name in (*law.sizes, *law.shapes):
        found = settling.found.get(name)
        out[name] = UNKNOWN if found is None else units.written(found)
    return out


class _Settling:
    """Units that were found so far."""

    def __init__(self, text: str, variables: Mapping[str, units.Powers | None]) -> None:
        self.text, self.variables = text, variables
        self.found: dict[str, units.Powers] = {}

    def unit(self, node: Node) -> units.Powers | None:
        """Unit of a node as far as it is known; None where it is not."""
        if isinstance(node, Whole):
            return {} if node.value else None  # nothing has any unit
        if isinstance(node, Variable):
            return self.variables.get(node.name)
        if isinstance(node, Coefficient):
            return self.found.get(node.name)
        if isinstance(node, Power):
            base = self.unit(node.base)
            return None if base is None else {u: node.power * p for u, p in base.items()}
        if isinstance(node, Product):
            return _times([self.unit(part) for part in node.parts])
        if isinstance(node, Call) and node.function in ("sin", "cos", "sign"):
            return {}
        parts = [part for _, part in node.parts] if isinstance(node, Sum) else list(node.arguments)
        return self._same(parts)

    def settle(self, node: Node, want: units.Powers | None) -> None:
        """Find the units of coefficients in a node that is to have a unit (None: any)."""
        if isinstance(node, Coefficient):
            if want is not None and node.name not in self.found:
                self.found[node.name] = want
        elif isinstance(node, Power):
            self.settle(node.base, None)
        elif isinstance(node, Product):
            for part in node.parts:
                if not isinstance(part, Coefficient):
                    self.settle(part, None)
            open_ = [part for part in node.parts if self.unit(part) is None]
            rest = _times([self.unit(part) for part in node.parts if part not in open_])
            if len(open_) == 1 and want is not None and rest is not None:
                self.settle(open_[0], units.divided(want, rest))
        elif isinstance(node, Call) and node.function in ("sin", "cos"):
            self.settle(node.arguments[0], {"rad": 1})
            angle = self.unit(node.arguments[0])
            if angle not in (None, {}, {"rad": 1}):
                raise ConfigError(
                    f"law {self.text!r}: {in_text(node)} takes an angle [rad]; {in_text(node.arguments[0])} is in "
                    f"{units.written(angle or {})}. Write {node.function}(k1 {in_text(node.arguments[0])})."
                )
        elif isinstance(node, Sum | Call):
            parts = [part for _, part in node.parts] if isinstance(node, Sum) else list(node.arguments)
            same = self._same(parts)
            for part in parts:
                self.settle(part, want if same is None else same)

    def _same(self, parts: list[Node]) -> units.Powers | None:
        """The unit of things that are added or compared."""
        known = [(part, unit) for part in parts if (unit := self.unit(part)) is not None]
        for part, unit in known[1:]:
            first, own = known[0]
            if unit != own:
                raise ConfigError(
                    f"law {self.text!r}: {in_text(first)} is in {units.written(own)} and {in_text(part)} in "
                    f"{units.written(unit)}: they cannot be added or compared."
                )
        return known[0][1] if known else None


def _times(parts: list[units.Powers | None]) -> units.Powers | None:
    """The unit of a product; None where one factor's is unknown."""
    out: units.Powers = {}
    for part in parts:
        if part is None:
            return None
        out = units.divided(out, {u: -p for u, p in part.items()})
    return out
