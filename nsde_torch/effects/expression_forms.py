"""A law with its values, in other forms: for people, in LaTeX, and as text that SymPy reads."""

from __future__ import annotations

import re
from collections.abc import Mapping

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
)

_LATEX = {"sin": r"\sin", "cos": r"\cos", "max": r"\max", "min": r"\min"}
_SYMPY = {"abs": "Abs", "max": "Max", "min": "Min"}
_GREEK = ("alpha", "beta", "gamma", "delta", "theta", "phi", "psi", "omega", "tau", "rho", "mu")


def valued(law: Written, values: Mapping[str, float]) -> str:
    """A law with numbers in the place of its coefficients, such as `force = 0.298 q q_dot`."""
    return f"{_port(law)} = {_sum(law.right, values, _Form)}"


def sympy_text(law: Written, values: Mapping[str, float]) -> str:
    """The right side of a law as text that `sympy.sympify` reads."""
    return _sum(law.right, values, _Sympy)


def latex(law: Written, values: Mapping[str, float]) -> str:
    """A law with its values in LaTeX."""
    port = rf"\mathrm{{{law.port.replace('_', ' ')}}}".replace(" ", r"\ ")
    row = f"_{{{_latex_name(law.row)}}}" if law.row else ""
    return f"{port}{row} = {_sum(law.right, values, _Latex)}"


def _port(law: Written) -> str:
    return f"{law.port}[{law.row}]" if law.row else law.port


def _number(value: float) -> str:
    return f"{value:.3g}"


def _sum(node: Sum, values: Mapping[str, float], form: type[_Form]) -> str:
    """A sum whose signs are those of its terms with their values."""
    out = ""
    for sign, part in node.parts:
        text = form(values).factor(part) if isinstance(part, Sum) else form(values).text(part)
        minus = (sign < 0) != text.startswith("-")
        text = text.removeprefix("-")
        out += (" - " if minus else " + ") + text if out else ("-" if minus else "") + text
    return out


class _Form:
    """How nodes are written: as a report has them."""

    times = " "

    def __init__(self, values: Mapping[str, float]) -> None:
        self.values = values

    def text(self, node: Node) -> str:
        """A node."""
        if isinstance(node, Sum):
            return _sum(node, self.values, type(self))
        if isinstance(node, Product):
            return self.times.join(self.factor(part) for part in self.size_first(node))
        if isinstance(node, Power):
            return self.power(node)
        if isinstance(node, Call):
            return self.call(node)
        if isinstance(node, Coefficient):
            return self.number(self.values[node.name])
        return str(node.value) if isinstance(node, Whole) else self.variable(node)

    def size_first(self, node: Product) -> list[Node]:
        """Factors with the number ahead."""
        return sorted(node.parts, key=lambda part: not isinstance(part, Coefficient))

    def factor(self, node: Node) -> str:
        """A node as a factor."""
        return f"({self.text(node)})" if isinstance(node, Sum | Product) else self.text(node)

    def power(self, node: Power) -> str:
        """A power."""
        return f"{self.factor(node.base)}^{node.power}"

    def call(self, node: Call) -> str:
        """A function."""
        return f"{node.function}({', '.join(map(self.text, node.arguments))})"

    def number(self, value: float) -> str:
        """A value of a coefficient."""
        return _number(value)

    def variable(self, node: Variable) -> str:
        """A variable."""
        return node.name


class _Sympy(_Form):
    """As SymPy has it."""

    times = "*"

    def power(self, node: Power) -> str:
        """A power."""
        return f"{self.factor(node.base)}**{node.power}"

    def call(self, node: Call) -> str:
        """A function; the smooth sign is tanh."""
        arguments = [self.text(a) for a in node.arguments]
        if node.function == "sign":
            return f"tanh(({arguments[0]})/({arguments[1]}))"
        return f"{_SYMPY.get(node.function, node.function)}({', '.join(arguments)})"

    def number(self, value: float) -> str:
        """All digits."""
        return repr(value)


class _Latex(_Form):
    """As LaTeX has it."""

    times = r"\,"

    def power(self, node: Power) -> str:
        """A power."""
        return f"{self.factor(node.base)}^{{{node.power}}}"

    def call(self, node: Call) -> str:
        """A function."""
        arguments = [self.text(a) for a in node.arguments]
        if node.function == "abs":
            return rf"\left|{arguments[0]}\right|"
        if node.function == "sign":
            return rf"\tanh\left({arguments[0]} / {arguments[1]}\right)"
        return rf"{_LATEX[node.function]}\left({', '.join(arguments)}\right)"

    def number(self, value: float) -> str:
        """A number with its power of ten."""
        found = re.fullmatch(r"(.+)e([-+]\d+)", _number(value))
        return rf"{found[1]} \cdot 10^{{{int(found[2])}}}" if found else _number(value)

    def variable(self, node: Variable) -> str:
        """A variable; `_dot` is a dot over it."""
        return _latex_name(node.name)


def _latex_name(name: str) -> str:
    if name.endswith("_dot"):
        return rf"\dot{{{_latex_name(name.removesuffix('_dot'))}}}"
    head, _, rest = name.partition("_")
    head = f"\\{head}" if head in _GREEK else head if len(head) == 1 else rf"\mathrm{{{head}}}"
    rest = rest.replace("_", r"\,")
    return f"{head}_{{{rest}}}" if rest else head
