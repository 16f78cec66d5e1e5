"""The grammar of laws that are written as text: parsed by hand, nothing is executed.

    law      = port [ "[" row "]" ] "=" sum
    sum      = [ "-" ] product { ( "+" | "-" ) product }
    product  = power { [ "*" ] power }
    power    = atom [ "^" whole number ]
    atom     = variable | coefficient | whole number | function "(" sum { "," sum } ")" | "(" sum ")"

Functions are `abs(a)`, `sin(a)`, `cos(a)`, `max(a, b)`, `min(a, b)`, `sign(a, width)`, which is tanh(a / width),
`peak(a, at)`, which is 2 a at / (a^2 + at^2), `pull(a, at)`, which is a / at exp(1/2 - a^2 / (2 at^2)),
`window(a, at)`, which is exp(-(a / at)^8), `expm1(a)`, which is exp(a) - 1, `root(a)`, which is the root of |a| with
the sign of a, `pow(a, to)`, which is |a|^to with the sign of a, and `logged(name)`, a column of the log.
A coefficient is `c` or `k` with a number or `_word` behind it: `c1`, `k_width`. Every term of the outer sum has exactly
one coefficient as a factor, which is its size; all others are shapes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from nsde_torch.errors import ConfigError

FUNCTIONS: dict[str, tuple[int, str, str]] = {
    "abs": (1, "Abs({0})", r"\left|{0}\right|"),
    "sin": (1, "sin({0})", r"\sin\left({0}\right)"),
    "cos": (1, "cos({0})", r"\cos\left({0}\right)"),
    "max": (2, "Max({0}, {1})", r"\max\left({0}, {1}\right)"),
    "min": (2, "Min({0}, {1})", r"\min\left({0}, {1}\right)"),
    "sign": (2, "tanh(({0})/({1}))", r"\tanh\left({0} / {1}\right)"),
    "peak": (2, "2*({0})*({1})/(({0})**2 + ({1})**2)", r"\frac{{2\,({0})\,{1}}}{{({0})^2 + {1}^2}}"),
    "pull": (
        2,
        "({0})/({1})*exp(1/2 - ({0})**2/(2*({1})**2))",
        r"\frac{{{0}}}{{{1}}}\,e^{{1/2 - ({0})^2 / (2\,{1}^2)}}",
    ),
    "window": (2, "exp(-(({0})/({1}))**8)", r"e^{{-\left(({0}) / {1}\right)^8}}"),
    "expm1": (1, "(exp({0}) - 1)", r"\left(e^{{{0}}} - 1\right)"),
    "root": (1, "sign({0})*sqrt(Abs({0}))", r"\operatorname{{sign}}({0})\,\sqrt{{\left|{0}\right|}}"),
    "pow": (
        2,
        "sign({0})*Abs({0})**({1})",
        r"\operatorname{{sign}}({0})\,\left|{0}\right|^{{{1}}}",
    ),
    "logged": (1, "", ""),
}
"""Functions: the number of their arguments, and how SymPy and LaTeX write them."""

_TOKEN = re.compile(r"\s*(?:(?P<name>[^\W\d]\w*)|(?P<number>\d+(?:\.\d*)?)|(?P<sign>[-+*^(),=\[\]]))")
_COEFFICIENT = re.compile(r"[ck](\d+|_\w+)")
_LONGEST, _DEEPEST, _HIGHEST, _LARGEST = 400, 12, 9, 999  # characters, brackets, power, whole number


@dataclass(frozen=True)
class Whole:
    """A whole number."""

    value: int


@dataclass(frozen=True)
class Variable:
    """A variable of the machine, or a column of the log."""

    name: str
    logged: bool = False  # whether it is a column of the log that is neither state nor input


@dataclass(frozen=True)
class Coefficient:
    """A number with a name, to be fitted."""

    name: str


@dataclass(frozen=True)
class Sum:
    """Parts with their signs, 1 or -1."""

    parts: tuple[tuple[int, Node], ...]


@dataclass(frozen=True)
class Product:
    """Factors."""

    parts: tuple[Node, ...]


@dataclass(frozen=True)
class Power:
    """A whole power."""

    base: Node
    power: int


@dataclass(frozen=True)
class Call:
    """A function of its arguments."""

    function: str
    arguments: tuple[Node, ...]


Node = Whole | Variable | Coefficient | Sum | Product | Power | Call


@dataclass(frozen=True)
class Written:
    """A law as it is written."""

    port: str
    row: str  # name of its row; empty where it was left out
    right: Sum  # what is added there

    @property
    def place(self) -> str:
        """The port and its row."""
        return f"{self.port}[{self.row}]" if self.row else self.port

    @property
    def text(self) -> str:
        """The law on one line, the same for any spelling of it: its name."""
        return f"{self.place} = {in_text(self.right)}"

    @property
    def sizes(self) -> tuple[str, ...]:
        """Coefficients that are factors of a term: it is nothing without them."""
        return tuple(own[0] for own in (_factors(part) for _, part in self.right.parts) if own)

    @property
    def shapes(self) -> tuple[str, ...]:
        """The other coefficients."""
        every = dict.fromkeys(n.name for n in nodes(self.right) if isinstance(n, Coefficient))
        return tuple(name for name in every if name not in self.sizes)


def is_law(name: str) -> bool:
    """Whether the name of an effect is a law that is written as text."""
    return "=" in name


def nodes(node: Node) -> Iterator[Node]:
    """A node and all below it."""
    yield node
    for one in parts_of(node):
        yield from nodes(one)


def parts_of(node: Node) -> Sequence[Node]:
    """What a node is made of."""
    if isinstance(node, Sum):
        return [part for _, part in node.parts]
    if isinstance(node, Power):
        return [node.base]
    if isinstance(node, Product):
        return node.parts
    return node.arguments if isinstance(node, Call) else ()


def _factors(term: Node) -> list[str]:
    """Coefficients among the factors of a term."""
    parts = term.parts if isinstance(term, Product) else (term,)
    return [part.name for part in parts if isinstance(part, Coefficient)]


def parse(text: str) -> Written:
    """Parse a law.

    Raises:
        ConfigError: what is not of the grammar; says where.

    Example:
        >>> parse("force=c1*q*q_dot - c2 max(q - k1, 0)^2").text
        'force = c1 q q_dot - c2 max(q - k1, 0)^2'
    """
    return _Parser(text).law()


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    start: int
    end: int


class _Parser:
    """Recursive descent; one function per rule of the grammar."""

    def __init__(self, text: str) -> None:
        self.text, self.at, self.depth = text, 0, 0
        if len(text) > _LONGEST:
            raise ConfigError(
                f"a law is at most {_LONGEST} characters long; got {len(text)}. Write it as several laws."
            )
        self.tokens = list(self._tokens())

    def _tokens(self) -> Iterator[_Token]:
        at = 0
        while self.text[at:].strip():
            found = _TOKEN.match(self.text, at)
            if found is None:
                at += len(self.text[at:]) - len(self.text[at:].lstrip())
                raise self._error(f"{self.text[at]!r} is not of the grammar", at)
            kind = str(found.lastgroup)
            yield _Token(kind, found[kind], found.start(kind), found.end(kind))
            at = found.end()
        yield _Token("end", "", len(self.text), len(self.text))

    def _error(self, what: str, at: int) -> ConfigError:
        return ConfigError(
            f"law {self.text!r}: {what} (character {at + 1}). A law is a port, `=`, and terms of variables and "
            "coefficients: force = c1 q q_dot - c2 max(q - k1, 0)^2."
        )

    @property
    def _next(self) -> _Token:
        return self.tokens[self.at]

    def _take(self, sign: str) -> bool:
        """Whether the next token is this sign, which is then behind."""
        taken = self._next.kind == "sign" and self._next.text == sign
        self.at += taken
        return taken

    def _expected(self, what: str) -> ConfigError:
        got = repr(self._next.text) if self._next.text else "the end"
        return self._error(f"expected {what}, got {got}", self._next.start)

    def _expect(self, sign: str) -> None:
        if not self._take(sign):
            raise self._expected(repr(sign))

    def _word(self, what: str) -> str:
        token = self._next
        if token.kind not in ("name", "number"):
            raise self._expected(what)
        self.at += 1
        return token.text

    def law(self) -> Written:
        port, row = self._word("the name of a port"), ""
        if self._take("["):
            row = self._word("the name of a row")
            self._expect("]")
        self._expect("=")
        start = self._next.start
        right = self._sum()
        if self._next.kind != "end":
            raise self._error(f"{self._next.text!r} does not belong here", self._next.start)
        self._check(right, start)
        return Written(port, row, right)

    def _check(self, right: Sum, start: int) -> None:
        """Every term has one size, which stands nowhere else."""
        every = [n.name for n in nodes(right) if isinstance(n, Coefficient)]
        for _, part in right.parts:
            own = _factors(part)
            if len(own) != 1:
                has = "no coefficient" if not own else f"{len(own)} coefficients"
                raise self._error(
                    f"the term {in_text(part)!r} has {has} as a factor; write one, such as c1, which is its size, "
                    "and multiply brackets out",
                    start,
                )
            if every.count(own[0]) > 1:
                raise self._error(f"the coefficient {own[0]!r} stands twice; name each term's own", start)

    def _sum(self) -> Sum:
        self.depth += 1
        if self.depth > _DEEPEST:
            raise self._error(f"brackets are nested more than {_DEEPEST} deep", self._next.start)
        sign = -1 if self._take("-") else 1
        parts = [(sign, self._product())]
        while self._next.kind == "sign" and self._next.text in "+-":
            sign = -1 if self._take("-") else 1
            if sign > 0:
                self._expect("+")
            parts.append((sign, self._product()))
        self.depth -= 1
        return Sum(tuple(parts))

    def _product(self) -> Node:
        parts = [self._power()]
        while self._take("*") or self._next.kind in ("name", "number") or self._next.text == "(":
            parts.append(self._power())
        return parts[0] if len(parts) == 1 else Product(tuple(parts))

    def _power(self) -> Node:
        base = self._atom()
        if not self._take("^"):
            return base
        token = self._next
        if token.kind != "number" or not token.text.isdigit() or not 2 <= int(token.text) <= _HIGHEST:
            got = repr(token.text) if token.text else "the end"
            raise self._error(f"a power is a whole number from 2 to {_HIGHEST}; got {got}", token.start)
        self.at += 1
        return Power(base, int(token.text))

    def _atom(self) -> Node:
        token = self._next
        if self._take("("):
            inner = self._sum()
            self._expect(")")
            return _unwrapped(inner)
        if token.kind == "number":
            if not token.text.isdigit() or int(token.text) > _LARGEST:
                raise self._error(
                    f"numbers in a law are whole and at most {_LARGEST}; got {token.text}. Write a coefficient, c1, "
                    f"and give it the value: {{c1: {token.text}}}",
                    token.start,
                )
            self.at += 1
            return Whole(int(token.text))
        if token.kind != "name":
            raise self._expected("a variable, a coefficient or a function")
        self.at += 1
        called = self._next.text == "(" and self._next.start == token.end
        if called and token.text in FUNCTIONS:  # else a variable: a valve's `window`, say
            return self._call(token)
        if called:
            raise self._error(
                f"{token.text!r} is no function; functions are {', '.join(FUNCTIONS)}", token.start
            )
        return Coefficient(token.text) if _COEFFICIENT.fullmatch(token.text) else Variable(token.text)

    def _call(self, token: _Token) -> Call | Variable:
        self._expect("(")
        if token.text == "logged":
            name = self._word("the name of a column of the log")
            self._expect(")")
            return Variable(name, logged=True)
        arguments = [_unwrapped(self._sum())]
        while self._take(","):
            arguments.append(_unwrapped(self._sum()))
        self._expect(")")
        takes, *_ = FUNCTIONS[token.text]
        if len(arguments) != takes:
            raise self._error(f"{token.text} takes {takes} argument(s); got {len(arguments)}", token.start)
        return Call(token.text, tuple(arguments))


def _unwrapped(inner: Sum) -> Node:
    """The only part of a sum of one, without its bracket."""
    return inner.parts[0][1] if len(inner.parts) == 1 and inner.parts[0][0] > 0 else inner


_GREEK = ("alpha", "beta", "gamma", "delta", "theta", "phi", "psi", "omega", "tau", "rho", "mu")


def in_text(node: Node) -> str:
    """A node as the grammar has it."""
    return _Form().text(node)


def valued(law: Written, values: Mapping[str, float]) -> str:
    """A law with numbers in the place of its coefficients, such as `force = 0.298 q q_dot`."""
    return f"{law.place} = {_Valued(values).text(law.right)}"


def sympy_text(law: Written, values: Mapping[str, float]) -> str:
    """The right side of a law as text that `sympy.sympify` reads."""
    return _Sympy(values).text(law.right)


def latex(law: Written, values: Mapping[str, float]) -> str:
    """A law with its values in LaTeX."""
    port = rf"\mathrm{{{law.port.replace('_', ' ')}}}".replace(" ", r"\ ")
    row = f"_{{{_latex_name(law.row)}}}" if law.row else ""
    return f"{port}{row} = {_Latex(values).text(law.right)}"


class _Form:
    """How nodes are written: as the grammar has them."""

    times = " "
    power = "{0}^{1}"
    calls: ClassVar[Mapping[str, str]] = {}  # functions that are written otherwise than `name(a, b)`

    def text(self, node: Node) -> str:
        if isinstance(node, Sum):
            return self.sum(node)
        if isinstance(node, Product):
            return self.times.join(map(self.factor, self.ordered(node)))
        if isinstance(node, Power):
            return self.power.format(self.factor(node.base), node.power)
        if isinstance(node, Call):
            arguments = [self.text(a) for a in node.arguments]
            usual = f"{node.function}({', '.join(arguments)})"
            return self.calls[node.function].format(*arguments) if node.function in self.calls else usual
        if isinstance(node, Coefficient):
            return self.coefficient(node)
        return str(node.value) if isinstance(node, Whole) else self.variable(node)

    def sum(self, node: Sum) -> str:
        """A sum whose signs are those of its terms, with their values where these are known."""
        out = ""
        for sign, part in node.parts:
            text = self.factor(part) if isinstance(part, Sum) else self.text(part)
            minus = (sign < 0) != text.startswith("-")
            text = text.removeprefix("-")
            out += (" - " if minus else " + ") + text if out else ("-" if minus else "") + text
        return out

    def factor(self, node: Node) -> str:
        return f"({self.text(node)})" if isinstance(node, Sum | Product) else self.text(node)

    def ordered(self, node: Product) -> Sequence[Node]:
        return node.parts

    def coefficient(self, node: Coefficient) -> str:
        return node.name

    def variable(self, node: Variable) -> str:
        return f"logged({node.name})" if node.logged else node.name


class _Valued(_Form):
    """As a report has them, with values."""

    calls = {"expm1": "(exp({0}) - 1)"}

    def __init__(self, values: Mapping[str, float]) -> None:
        self.values = values

    def ordered(self, node: Product) -> Sequence[Node]:
        return sorted(node.parts, key=lambda part: not isinstance(part, Coefficient))  # the size first

    def coefficient(self, node: Coefficient) -> str:
        return f"{self.values[node.name]:.3g}"

    def variable(self, node: Variable) -> str:
        return node.name


class _Sympy(_Valued):
    """As SymPy has it."""

    times = "*"
    power = "{0}**{1}"
    calls = {name: sympy for name, (_, sympy, _) in FUNCTIONS.items()}

    def coefficient(self, node: Coefficient) -> str:
        return repr(self.values[node.name])


class _Latex(_Valued):
    """As LaTeX has it."""

    times = r"\,"
    power = "{0}^{{{1}}}"
    calls = {name: latex for name, (_, _, latex) in FUNCTIONS.items()}

    def coefficient(self, node: Coefficient) -> str:
        number = super().coefficient(node)
        found = re.fullmatch(r"(.+)e([-+]\d+)", number)
        return rf"{found[1]} \cdot 10^{{{int(found[2])}}}" if found else number

    def variable(self, node: Variable) -> str:
        return _latex_name(node.name)


def _latex_name(name: str) -> str:
    if name.endswith("_dot"):
        return rf"\dot{{{_latex_name(name.removesuffix('_dot'))}}}"
    head, _, rest = name.partition("_")
    head = f"\\{head}" if head in _GREEK else head if len(head) == 1 else rf"\mathrm{{{head}}}"
    rest = rest.replace("_", r"\,")
    return f"{head}_{{{rest}}}" if rest else head
