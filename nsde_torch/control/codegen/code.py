"""Scalars as functions in C: statements, networks with loops, and products with sparse matrices."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from nsde_torch.control.codegen import scalar
from nsde_torch.control.codegen.scalar import PLACE, Layer, Number, Scalar
from nsde_torch.texts import rendered

_LONG = 90  # characters of an expression from which on it becomes a statement of its own
_CALLS = {
    **{n: f"F({n})({{0}})" for n in scalar.FUNCTIONS},
    # right to rounding beside 1, and twice as fast as libm's
    "tanh": "(1 - 2 / (F(exp)(2 * {0}) + 1))",
    **{"atan2": "F(atan2)({0}, {1})", "pow": "F(pow)({0}, {1})", "abs": "F(fabs)({0})"},
    **{"add": "({0} + {1})", "sub": "({0} - {1})", "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}"},
    **{"max": "LARGER({0}, {1})", "min": "SMALLER({0}, {1})", "clamped": "clamped({0}, {1}, {2})"},
    **{"lt": "R({0} < {1})", "le": "R({0} <= {1})", "eq": "R({0} == {1})"},
    **{"where": "({0} != 0 ? {1} : {2})", "sign": "R(({0} > 0) - ({0} < 0))"},
}


def number(x: float) -> str:
    """A constant, of the type that the file is compiled for."""
    if x in (float("inf"), -float("inf")):
        return "R(INFINITY)" if x > 0 else "R(-INFINITY)"
    if x != x:
        return "R(NAN)"
    text = repr(float(x))
    if text.endswith(".0") and len(text) < 8:
        text = text[:-2]
        return text if x >= 0 else f"({text})"
    return f"R({text})"


class Networks:
    """The networks of a file, each a function of its own."""

    def __init__(self) -> None:
        self._places: dict[Layer, dict[int, tuple[int, int]]] = {}
        self._numbers: dict[str, int] = {}
        self._told = 0
        self.widths: list[tuple[int, int]] = []

    def code(self) -> list[str]:
        """The functions that were not asked for before."""
        new = list(self._numbers.items())[self._told :]
        self._told = len(self._numbers)
        return [code.replace("network_#", f"network_{k}") for code, k in new]

    def places(self, layer: Layer) -> dict[int, tuple[int, int]]:
        """Output -> number of the network that makes it, and its place there."""
        if layer not in self._places:
            found: dict[int, tuple[int, int]] = {}
            for units in layer.parts():
                rows = [list(range(layer.chain[0].weight.shape[1])), *units]
                code = self._written(layer.chain, rows)
                if code not in self._numbers:
                    self.widths.append((len(rows[0]), len(rows[-1])))
                k = self._numbers.setdefault(code, len(self._numbers))
                found |= {unit: (k, place) for place, unit in enumerate(units[-1])}
            self._places[layer] = found
        return self._places[layer]

    def _written(self, chain: Sequence[Layer], rows: Sequence[Sequence[int]]) -> str:
        """The layers of a network, of some of their units each."""
        last, layers = len(chain) - 1, []
        for k, (layer, (above, below)) in enumerate(zip(chain, pairwise(rows), strict=True)):
            weight = (f"{{{', '.join(map(number, row))}}}" for row in layer.weight[below][:, above].T)
            own = {"weight": ",\n    ".join(weight), "bias": ", ".join(map(number, layer.bias[below]))}
            own |= {"source": f"h{k}" if k else "x", "target": f"h{k + 1}" if k < last else "y"}
            if k < last:
                activation = chain[k + 1].activation
                slope = scalar.jacobian([activation], [PLACE])[0].get(0, 0.0)
                code = _Body(self, "        ", given={id(PLACE): "a"})
                code.count([activation, slope])
                own |= {"value": code.text(activation), "slope": code.text(slope)}
                own["lines"] = "".join(code.lines)
            layers.append({"k": k, "n_in": len(above), "n_out": len(below), **own})
        return rendered(__file__, "network.c", layers=layers) + "\n"


class _Body:
    """Statements that work out scalars; what is used more than once, or is long, has a name."""

    def __init__(
        self,
        networks: Networks,
        indent: str = "    ",
        *,
        given: Mapping[int, str] | None = None,
        slopes: bool = False,
    ) -> None:
        self._networks, self._indent, self._slopes = networks, indent, slopes
        self._uses: dict[int, int] = {}
        self._names = dict(given or {})
        self._called: dict[tuple[Any, ...], str] = {}
        self.lines: list[str] = []

    def count(self, outputs: Iterable[Number]) -> None:
        """Look at how often each scalar is used."""
        outputs = list(outputs)
        used = [a for x in scalar.in_order(outputs) for a in x.args]
        for x in (*used, *outputs):
            if isinstance(x, Scalar):
                self._uses[id(x)] = self._uses.get(id(x), 0) + 1

    def text(self, output: Number) -> str:
        """An expression, after the statements that it needs; `count` comes first."""
        for x in scalar.in_order([output]):
            if id(x) not in self._names:
                self._names[id(x)] = self._expression(x)
        return self._name(output)

    def _name(self, x: Number) -> str:
        return number(x) if isinstance(x, float) else self._names[id(x)]

    def _expression(self, x: Scalar) -> str:
        if x.op == "input":
            return f"{x.data[0]}[{x.data[1]}]"
        if x.op in ("layer", "slope"):
            network, place = self._networks.places(x.data[0])[x.data[1]]
            at = self._call(network, x.args)
            return f"y{at}[{place}]" if x.op == "layer" else f"j{at}[{place}][{x.data[2]}]"
        args = [self._name(a) for a in x.args]
        # of those without brackets, what follows a division or a sign needs them
        if x.op in ("div", "mul", "neg"):
            args[-1] = f"({args[-1]})" if re.search(r"^-|[*/]", args[-1]) else args[-1]
        made = _CALLS[x.op].format(*args)
        if self._uses.get(id(x), 0) <= 1 and len(made) < _LONG:
            return made
        name = f"t{len(self.lines)}"
        self.lines.append(f"{self._indent}const real {name} = {made};\n")
        return name

    def _call(self, network: int, args: tuple[Number, ...]) -> str:
        key = (network, *(a if isinstance(a, float) else id(a) for a in args))
        if key not in self._called:
            n_in, n_out = self._networks.widths[network]
            at = f"{network}_{len(self._called)}"
            slope = f", j{at}[{n_out}][{n_in}]" if self._slopes else ""
            self.lines.append(
                f"{self._indent}const real x{at}[] = {{{', '.join(map(self._name, args))}}};\n"
                f"{self._indent}real y{at}[{n_out}]{slope};\n"
                f"{self._indent}network_{network}(x{at}, y{at}, {f'j{at}' if self._slopes else 'NULL'});\n"
            )
            self._called[key] = at
        return self._called[key]


def function(
    head: str, outputs: Sequence[tuple[str, Number]], networks: Networks, *, slopes: bool = False
) -> str:
    """A function of what its head says; outputs are places and what is put there, the place "" what it returns."""
    body = _Body(networks, slopes=slopes)
    body.count(x for _, x in outputs)
    ends = []
    for place, x in outputs:
        text = body.text(x)
        ends.append(f"    {place} = {text};\n" if place else f"    return {text};\n")
    code = "".join((*body.lines, *ends))
    return f"{head}\n{{\n{_unused(head, code)}{code}}}\n"


def _unused(head: str, code: str) -> str:
    """Mention of the arrays of a head that its code does not read: compilers warn of them."""
    given = re.findall(r"\*(?:restrict )?(\w+)", head)
    return "".join(f"    (void){name};\n" for name in given if not re.search(rf"\b{name}\[", code))


class Matrix:
    """A sparse matrix whose entries that are no constants lie in an array of a step, one after another."""

    def __init__(self, name: str, rows: Sequence[Mapping[int, Number]], width: int) -> None:
        self.height, self.width = len(rows), width
        self.entries: list[tuple[str, Number]] = []
        self.terms: dict[tuple[int, int], str] = {}
        for i, row in enumerate(rows):
            for j, x in sorted(row.items()):
                self.terms[i, j] = number(x) if isinstance(x, float) else f"{name}[{len(self.entries)}]"
                if isinstance(x, Scalar):
                    self.entries.append((self.terms[i, j], x))

    def column(self, j: int, other: str) -> str:
        """Sum over the rows i of entry times `other`, a pattern of the row."""
        return self._sum(((i, j), other.format(i)) for i in range(self.height))

    def row(self, i: int, other: str) -> str:
        """Sum over the columns j of entry times `other`, a pattern of the column."""
        return self._sum(((i, j), other.format(j)) for j in range(self.width))

    def _sum(self, places: Iterable[tuple[tuple[int, int], str]]) -> str:
        terms = [(self.terms[place], x) for place, x in places if place in self.terms]
        return " + ".join(x if t == "1" else f"{t} * {x}" for t, x in terms) or "0"


def products(a: Matrix, b: Matrix, q: Matrix, nz: int) -> str:
    """Products with the Jacobians of a step: A, B, and Q = J^T J of the roots of the cost; and m - h^T h."""

    def void(head: str, vectors: str, last: str, caller: Callable[[], str]) -> str:
        given = "".join(f"const real *restrict {name}, " for name in vectors.split())
        full, code = f"{head}{given}{last})", caller()
        return f"static void {full}\n{{\n{_unused(full, code)}{code}}}\n\n"

    return rendered(__file__, "products.c", a=a, b=b, q=q, nz=nz, void=void) + "\n\n"
