"""Effects that are written as text: a law of the machine's own variables, without a class of its own.

    force = c1 q q_dot                       {c1: 0.3}
    body_moment[y] = c1 v_body_x w_z         {c1: 0.44}

The text is the name of the effect, in `effects.yaml` as everywhere; the grammar is that of `expression_grammar`, and
nothing of it is executed as code. Coefficients that are factors of a term are its sizes, and nothing is added where
all of them are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from operator import add, mul
from typing import Any, ClassVar

import torch
from torch import Tensor

from nsde_torch.effects import units
from nsde_torch.effects.base import Effect, Parameter, Port, elapsed, in_row
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
    nodes,
    parse,
    parts_of,
)
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import did_you_mean

# Units of the coefficients of a law: what is added has one unit, and every term has that of the port.
#
#     force [m/s2] = c1 q q_dot - c2 max(q - k1, 0)^2         c1 [1/(m s)], c2 [1/(m s2)], k1 [m]
#
# Angles of `sin` and `cos` are in rad. A variable of unknown unit leaves the units that hang on it unknown.

_OF_NUMBERS: Mapping[str, tuple[units.Powers, str]] = {
    **dict.fromkeys(("sin", "cos"), ({"rad": 1}, "an angle [rad]")),
    "expm1": ({}, "a number without unit"),
}
UNKNOWN = "SI"
"""Unit of a coefficient that hangs on a variable of unknown unit."""


def coefficient_units(law: Written, variables: Mapping[str, str], port: str) -> dict[str, str]:
    """Unit of each coefficient of a law, from those of its variables (empty: unknown) and of its value, the port's.

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
        if isinstance(node, Call) and node.function in (
            "sin",
            "cos",
            "sign",
            "peak",
            "pull",
            "window",
            "expm1",
        ):
            return {}
        if isinstance(node, Call) and node.function == "pow":
            # of any power: the unit of its size is unknown
            return {} if self.unit(node.arguments[0]) == {} else None
        if isinstance(node, Call) and node.function == "root":
            inner = self.unit(node.arguments[0])
            whole = inner is not None and all(power % 2 == 0 for power in inner.values())
            return {u: power // 2 for u, power in inner.items()} if inner is not None and whole else None
        return self._same(parts_of(node))

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
        elif isinstance(node, Call) and node.function in _OF_NUMBERS:
            want, what = _OF_NUMBERS[node.function]
            self.settle(node.arguments[0], want)
            given = self.unit(node.arguments[0])
            if given not in (None, {}, want):
                raise ConfigError(
                    f"law {self.text!r}: {in_text(node)} takes {what}; {in_text(node.arguments[0])} is in "
                    f"{units.written(given or {})}. Write {node.function}(k1 {in_text(node.arguments[0])})."
                )
        elif isinstance(node, Call) and node.function in ("root", "pow"):
            self.settle(node.arguments[0], None)
            for to in node.arguments[1:]:
                self.settle(to, {})
        elif isinstance(node, Sum | Call):
            same = self._same(parts_of(node))
            for part in parts_of(node):
                self.settle(part, want if same is None else same)

    def _same(self, parts: Sequence[Node]) -> units.Powers | None:
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


FEATURES, UP, TIME = "system.features", "system.up", "time"
"""Quantities of any system: its features, and the direction of world's up in the body where it has an attitude."""


@dataclass(frozen=True)
class Source:
    """Where a variable comes from."""

    kind: str  # `state`, `input`, `mixed` (a sum of inputs), `time`, or a quantity
    column: int = 0  # its column there
    weights: tuple[float, ...] = ()  # of the inputs, of a mixed one


@dataclass(frozen=True)
class Rows:
    """Rows of a port."""

    names: tuple[str, ...]  # by which a law names them; one empty name where there is but one
    units: tuple[str, ...]  # of what is added

    def written(self, port: str) -> list[str]:
        """The rows as laws and reports write them: `body_force[z]`; the port alone where it has but one."""
        return [f"{port}[{name}]" if name else port for name in self.names]


@dataclass(frozen=True)
class Vocabulary:
    """What a law of a machine may speak of."""

    system: str  # name of the machine
    variables: tuple[tuple[str, str, Source], ...]  # name, unit (empty: unknown) and source of each
    ports: tuple[tuple[str, Rows], ...]  # name and rows of each
    widths: tuple[tuple[str, int], ...] = ()  # columns of the quantities that are read, by their names


class Expression(Effect):
    """A law that is written as text; classes of it are made by `expression_at` and `unplaced_expression`."""

    law: ClassVar[Written]  # the law, parsed
    row: ClassVar[int] = 0  # of the port
    width: ClassVar[int] = 0  # rows of the port
    sources: ClassVar[Mapping[str, Source]] = {}  # where its variables come from
    unit: ClassVar[str] = ""  # of what it adds
    separate = "runs in which the variables of the law move further, and apart from each other"

    def __init__(self, values: Mapping[str, float | list[float]] | None = None, *, n_inputs: int = 1) -> None:
        # a first value that is given says what a typical change is: coefficients have any size
        given = {k: v for k, v in (values or {}).items() if isinstance(v, float | int) and v}
        self.PARAMETERS = {  # type: ignore[misc]
            k: replace(p, scale=abs(given[k])) if k in given else p for k, p in self.PARAMETERS.items()
        }
        super().__init__(values, n_inputs=n_inputs)

    def get_extra_state(self) -> Tensor:
        """Sizes of typical changes: saved values are multiples of them."""
        return torch.tensor([self._scales[name] for name in self._specs], dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Take over the sizes that values were saved with."""
        self._scales = dict(zip(self._specs, state.tolist(), strict=True))

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """The law in its row of the port, nothing in the others."""
        if not self.width:
            raise ConfigError(f"law {self.name!r} is of no machine; make it by `System.make_effect`.")
        return in_row(self._worked_out(self.law.right, t, x, u).expand(len(x), 1), self.row, self.width)

    def _worked_out(self, node: Node, t: float | Tensor, x: Tensor, u: Tensor) -> Tensor:
        """Value of a node (N, 1), or (1,)."""
        if isinstance(node, Whole):
            return x.new_full((1,), float(node.value))
        if isinstance(node, Coefficient):
            return self.value(node.name)
        if isinstance(node, Variable):
            return self._variable(node, t, x, u)
        if isinstance(node, Power):
            return reduce(mul, [self._worked_out(node.base, t, x, u)] * node.power)
        if isinstance(node, Product):
            return reduce(mul, (self._worked_out(part, t, x, u) for part in node.parts))
        if isinstance(node, Sum):
            worked = [(sign, self._worked_out(part, t, x, u)) for sign, part in node.parts]
            return reduce(add, (value if sign > 0 else -value for sign, value in worked))
        values = [self._worked_out(part, t, x, u) for part in node.arguments]
        return _CALLED[node.function](*values)

    def _variable(self, node: Variable, t: float | Tensor, x: Tensor, u: Tensor) -> Tensor:
        if node.logged:
            return self.channel(node.name, u)
        source = self.sources[node.name]
        if source.kind == TIME:
            return torch.as_tensor(elapsed(t, x)).to(x).reshape(-1, 1)
        if source.kind == "state":
            return x[:, source.column : source.column + 1]
        if source.kind == "input":
            return u[:, source.column : source.column + 1]
        if source.kind == "mixed":
            return reduce(add, (w * u[:, i : i + 1] for i, w in enumerate(source.weights) if w))
        return self.channel(source.kind, u)[:, source.column : source.column + 1]


_CALLED: dict[str, Callable[..., Tensor]] = {
    "abs": torch.abs,
    "sin": torch.sin,
    "cos": torch.cos,
    "max": torch.maximum,
    "min": torch.minimum,
    "sign": lambda value, width: torch.tanh(value / width),
    "peak": lambda value, at: 2.0 * value * at / (value * value + at * at),
    "pull": lambda value, at: value / at * torch.exp(0.5 - 0.5 * (value / at) ** 2),
    "window": lambda value, at: torch.exp(-((value / at) ** 8)),
    "expm1": lambda value: torch.expm1(value.clamp_max(_LARGEST_EXPONENT)),
    "root": lambda value: value.sign() * value.abs().clamp_min(_STEEPEST).sqrt(),
    "pow": lambda value, to: value.sign() * torch.exp(to * value.abs().clamp_min(_STEEPEST).log()),
}
_STEEPEST = 1e-12  # size below which the slope of a root or a power, which may be infinite at 0, is none
_HIGHEST = 6.0  # power: beyond, rows of the largest values alone say anything
_ENDS: dict[str, tuple[float | None, float | None]] = {  # of the second argument
    **dict.fromkeys(("sign", "peak", "pull", "window"), (0.0, None)),
    "pow": (-_HIGHEST, _HIGHEST),
}
_LARGEST_EXPONENT = 30.0  # a rollout that has run off stays finite


def unplaced_expression(name: str) -> type[Expression]:
    """The effect that a law is on some machine, and not where it acts or in what units; ConfigError for no law."""
    return _unplaced(parse(name).text)


@cache
def _unplaced(text: str) -> type[Expression]:
    law = parse(text)
    return _made(law, dict.fromkeys((*law.sizes, *law.shapes), UNKNOWN), {})


def expression_at(name: str, words: Vocabulary) -> type[Expression]:
    """The effect that a law is on a machine.

    Raises:
        ConfigError: not of the grammar, or a port, row, variable or unit that does not fit the machine.
    """
    return _placed(parse(name).text, words)


@cache
def _placed(text: str, words: Vocabulary) -> type[Expression]:
    law = parse(text)
    row, rows = _row(law, words)
    known = {name: (unit, source) for name, unit, source in words.variables}
    read = [node for node in nodes(law.right) if isinstance(node, Variable)]
    for node in read:
        if law.port == Port.INPUT.value and known.get(node.name, ("", Source("")))[1].kind in (FEATURES, UP):
            raise ConfigError(f"law {text!r}: a law of the input reads states and inputs, not {node.name!r}.")
        if not node.logged and node.name not in known:
            raise ConfigError(
                f"law {text!r}: {node.name!r} is no variable of system {words.system!r}; there are "
                f"{', '.join(known)}, and logged(NAME) for a column of the log.{did_you_mean(node.name, known)}"
            )
    for name in (*law.sizes, *law.shapes):
        if name in known:
            raise ConfigError(
                f"law {text!r}: {name!r} is a variable of system {words.system!r}; name the coefficient otherwise."
            )
    sources = {node.name: known[node.name][1] for node in read if not node.logged}
    quantities = {k: width for k, width in words.widths if any(s.kind == k for s in sources.values())}
    own_units = coefficient_units(law, {name: unit for name, (unit, _) in known.items()}, rows.units[row])
    own = {
        "row": row,
        "unit": rows.units[row],
        "width": len(rows.names),
        "sources": sources,
        "quantities": quantities,
        "exogenous": tuple(dict.fromkeys(node.name for node in read if node.logged)),
    }
    return _made(law, own_units, own)


def _row(law: Written, words: Vocabulary) -> tuple[int, Rows]:
    ports = dict(words.ports)
    if law.port not in ports:
        raise ConfigError(
            f"law {law.text!r}: {law.port!r} is no port of system {words.system!r}; there are {', '.join(ports)}."
        )
    rows = ports[law.port]
    if law.row not in rows.names:
        choices = ", ".join(rows.written(law.port))
        raise ConfigError(f"law {law.text!r}: a law of that port is written {choices} = ...")
    return rows.names.index(law.row), rows


def _made(law: Written, own_units: Mapping[str, str], own: dict[str, Any]) -> type[Expression]:
    second = {
        node.arguments[1].name: node.function
        for node in nodes(law.right)
        if isinstance(node, Call) and len(node.arguments) == 2 and isinstance(node.arguments[1], Coefficient)
    }
    parameters = {name: Parameter(0.0, own_units[name], help="size of a term") for name in law.sizes}
    for name in law.shapes:
        low, high = _ENDS.get(second.get(name, ""), (None, None))
        parameters[name] = Parameter(1.0, own_units[name], low=low, high=high, help="shape of a term")
    with_values = ", ".join(f"{name} = {{{name}}}" for name in (*law.sizes, *law.shapes))
    made: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": f"The law {law.text}.",
        "name": law.text,
        "law": law,
        "port": Port(law.port),
        "formula": in_text(law.right),
        "source": "a law that is written as text",
        "PARAMETERS": parameters,
        "amplitudes": law.sizes,
        "sentence": f"A law of the machine's own variables adds {in_text(law.right)}, {with_values}.",
        **own,
    }
    return type("Expression", (Expression,), made)
