"""The controller as plain C: a source file and its header.

What is written by hand and what is the model's meet in `templates/controller.c`: the plan, its checks and the estimator
are those of `step` and of `control.autopilots`, as loops over arrays of fixed sizes; the model, its derivatives and the
products with its sparse Jacobians are generated from the graphs of the Python controller's own functions (`scalar`).
In the place of the condensed Hessian a recursion over the steps (Riccati's) solves for the free inputs: the same
numbers up to rounding, for K (nz + nu)^3 operations instead of (K nu)^3.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any

import torch
from torch import Tensor

from nsde_torch.control.autopilots import Estimator
from nsde_torch.control.gauss_newton import SHARES
from nsde_torch.control.options import EstimatorOptions
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.export import scalar
from nsde_torch.export.graph import graph_of
from nsde_torch.export.layout import STATUS
from nsde_torch.export.scalar import PLACE, Layer, Number, Scalar, Table
from nsde_torch.export.step import ExportedStep

_TEMPLATES = Path(__file__).parent / "templates"
_LONG = 90
"""Characters of an expression from which on it becomes a statement of its own."""
_CALLS = {
    **{n: f"F({n})({{0}})" for n in ("sin", "cos", "tan", "exp", "expm1", "log", "log1p", "sqrt", "atan")},
    **{n: f"F({n})({{0}})" for n in ("acos", "asin", "asinh", "floor")},
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


class _Networks:
    """The networks of a file, each a function of its own."""

    def __init__(self) -> None:
        self._places: dict[Layer, dict[int, tuple[int, int]]] = {}
        self._numbers: dict[str, int] = {}
        self.widths: list[tuple[int, int]] = []

    @property
    def code(self) -> list[str]:
        """The functions."""
        return [code.replace("network_#", f"network_{k}") for code, k in self._numbers.items()]

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
        """Outputs y and, if asked for, their slopes, backwards from each output."""
        n, last, tables, body = [len(r) for r in rows], len(chain) - 1, [], []
        for k, (layer, (above, below)) in enumerate(zip(chain, pairwise(rows), strict=True)):
            weight = ",\n    ".join(
                f"{{{', '.join(map(number, row))}}}" for row in layer.weight[below][:, above].T
            )
            bias = ", ".join(map(number, layer.bias[below]))
            tables.append(f"static const real network_#_w{k}[{n[k]}][{n[k + 1]}] = {{\n    {weight}}};")
            tables.append(f"static const real network_#_b{k}[{n[k + 1]}] = {{{bias}}};")
            source, target = f"h{k}" if k else "x", f"h{k + 1}" if k < last else "y"
            if k < last:
                body.append(f"    real {target}[{n[k + 1]}], s{k + 1}[{n[k + 1]}];")
            body.append(
                f"    copy(network_#_b{k}, {target}, {n[k + 1]});\n    for (int j = 0; j < {n[k]}; j++)"
            )
            body.append(
                f"        for (int i = 0; i < {n[k + 1]}; i++) {target}[i] += network_#_w{k}[j][i] * {source}[j];"
            )
            if k < last:
                activation = chain[k + 1].activation
                slope = scalar.jacobian([activation], [PLACE])[0].get(0, 0.0)
                code = _Body(self, "        ", given={id(PLACE): "a"})
                code.count([activation, slope])
                value, derivative = code.text(activation), code.text(slope)
                body.append(
                    f"    for (int i = 0; i < {n[k + 1]}; i++) {{\n        const real a = {target}[i];"
                )
                body.append("".join(code.lines) + f"        {target}[i] = {value};")
                body.append(f"        s{k + 1}[i] = {derivative};\n    }}")
        body.append(f"    for (int o = 0; slope && o < {n[-1]}; o++) {{")
        for k in range(last, -1, -1):
            target, weights = (f"g{k}" if k else "slope[o]"), f"network_#_w{k}[j]"
            if k:
                body.append(f"        real g{k}[{n[k]}];")
            body.append(f"        for (int j = 0; j < {n[k]}; j++) {{")
            if k == last:
                body.append(f"            {target}[j] = {weights}[o];")
            else:
                body.append(f"            {target}[j] = 0;\n            for (int i = 0; i < {n[k + 1]}; i++)")
                body.append(f"                {target}[j] += {weights}[i] * g{k + 1}[i];")
            body.append(f"            {target}[j] *= s{k}[j];\n        }}" if k else "        }")
        head = f"static void network_#(const real *x, real *y, real (*slope)[{n[0]}])\n{{"
        return "\n".join((*tables, head, *body, "    }", "}\n"))


class _Body:
    """Statements that work out scalars; what is used more than once, or is long, has a name."""

    def __init__(
        self,
        networks: _Networks,
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
        for x in scalar.in_order(outputs):
            for a in x.args:
                if isinstance(a, Scalar):
                    self._uses[id(a)] = self._uses.get(id(a), 0) + 1
        for x in outputs:
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


def _function(
    head: str, outputs: Sequence[tuple[str, Number]], networks: _Networks, *, slopes: bool = False
) -> str:
    """A function of what its head says; outputs are places and what is put there, the place "" what it returns."""
    body = _Body(networks, slopes=slopes)
    body.count(x for _, x in outputs)
    ends = []
    for place, x in outputs:
        text = body.text(x)
        ends.append(f"    {place} = {text};\n" if place else f"    return {text};\n")
    code = "".join((*body.lines, *ends))
    given = re.findall(r"const real \*(?:restrict )?(\w+)", head)
    unused = "".join(f"    (void){name};\n" for name in given if not re.search(rf"\b{name}\[", code))
    return f"{head}\n{{\n{unused}{code}}}\n"


class _Matrix:
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


def _void(head: str, lines: Iterable[str]) -> str:
    return f"static void {head}\n{{\n" + "".join(f"    {line}\n" for line in lines) + "}\n\n"


def _products(a: _Matrix, b: _Matrix, q: _Matrix, nz: int) -> str:
    """Products with the Jacobians of a step: A, B, and Q = J^T J of the roots of the cost; and m - h^T h."""
    vector, square = "const real *restrict", "real (*restrict m)[LD], "

    def over(count: str, x: _Matrix, left: str, right: str, start: str = "0") -> list[str]:
        head = f"for (int c = {start}; c < {count}; c++)"
        return [f"{head} {left} = {x.column(j, right)};".replace("<j>", str(j)) for j in range(x.width)]

    to = "real (*restrict out)[LD]"
    terms = " + ".join(f"h[{i}][r] * h[{i}][c]" for i in range(b.width))
    return "".join(
        (
            _void(f"a_times({vector} a, {square}{to})", over("LD", a, "out[<j>][c]", "m[{}][c]")),
            _void(f"b_times({vector} b, {square}{to})", over("LD", b, "out[<j>][c]", "m[{}][c]")),
            # of what is symmetric, one half
            _void(f"times_a({square}{vector} a, {to})", over("NR", a, "out[c][<j>]", "m[c][{}]", "<j>")),
            _void(f"inputs_times_a({square}{vector} a, {to})", over("NU", a, "out[c][<j>]", "m[c][{}]")),
            _void(
                f"times_b({square}{vector} b, real (*restrict out)[NU])",
                over("NU", b, "out[c][<j>]", "m[c][{}]"),
            ),
            _void(
                f"forward({vector} a, {vector} b, {vector} dz, {vector} du, real *restrict out)",
                (f"out[{i}] = {a.row(i, 'dz[{}]')} + {b.row(i, 'du[{}]')};" for i in range(nz)),
            ),
            _void(
                f"back_a({vector} a, {vector} l, real *restrict out)",
                (f"out[{j}] = {a.column(j, 'l[{}]')};" for j in range(nz)),
            ),
            _void(
                f"back_b({vector} b, {vector} l, real *restrict out)",
                (f"out[{j}] = {b.column(j, 'l[{}]')};" for j in range(b.width)),
            ),
            # a sum in one go: a row that is stored and loaded again for each term takes twice as long
            _void(
                f"less_square(real (*restrict h)[LD], {to})",
                (
                    f"for (int r = 0; r < NR; r++)\n        for (int c = 0; c < LD; c++) out[r][c] -= {terms};",
                ),
            ),
            _void(f"add_q({vector} q, {to})", (f"out[{i}][{j}] += {t};" for (i, j), t in q.terms.items())),
            _void(
                f"times_q({vector} q, {vector} e, real *restrict out)",
                (f"out[{i}] = {q.row(i, 'e[{}]')};" for i in range(q.height)),
            ),
        )
    )


def _scalars(
    function: Callable[..., Sequence[Tensor]], tables: Mapping[str, int], dtype: torch.dtype
) -> tuple[list[Table], list[Table]]:
    """A function of tables of one row, run on scalars: its inputs and its outputs."""
    example = [torch.ones(1, n, dtype=dtype) for n in tables.values()]
    given = [scalar.inputs(name, 1, n) for name, n in tables.items()]
    made = scalar.run(graph_of(function, example), given)
    return [t[0] for t in given], [t.reshape(-1) for t in made]


def _model(step: ExportedStep) -> tuple[str, dict[str, Any]]:
    """The functions of a model and of its cost, and sizes that follow from them."""
    s, h, p, dtype = step.sizes, step.horizon, step.predictor, step.dtype
    rate = float(h.rate_weight) > 0
    networks = _Networks()
    (z, u, _), (after,) = _scalars(
        lambda z, u, d: (h.advance(z, u, d),), {"z": s.nz, "u": s.nu, "d": s.nd}, dtype
    )
    slopes = scalar.jacobian(list(after), [*z, *u])
    a = _Matrix("a", [{j: x for j, x in row.items() if j < s.nz} for row in slopes], s.nz + s.nu * rate)
    inputs: list[dict[int, Number]] = [{j - s.nz: x for j, x in row.items() if j >= s.nz} for row in slopes]
    b = _Matrix("b", [*inputs, *({i: 1.0} for i in range(s.nu * rate))], s.nu)
    (x, _), (roots,) = _scalars(lambda x, ref: (h.residual(x, ref),), {"x": s.nx, "ref": s.nx}, dtype)
    by_state = scalar.jacobian(list(roots), list(x))

    def total(terms: Iterable[Number]) -> Number:
        return sum(terms, 0.0)

    q = _Matrix(
        "q",
        [
            {
                j: v
                for j in range(s.nx)
                if (v := total(row[i] * row[j] for row in by_state if i in row and j in row)) != 0.0
            }
            for i in range(s.nx)
        ],
        s.nx,
    )
    square = total(r * r for r in roots)
    half = [
        total(row[i] * r for row, r in zip(by_state, roots, strict=True) if i in row) for i in range(s.nx)
    ]
    (_, _), (augmented,) = _scalars(lambda x, u: (p.augment(x, u),), {"x": s.nx, "u": s.nu}, dtype)
    lift = _scalars(lambda x, u: (step._system.quantity("thrust", x, u),), {"x": s.nx, "u": s.nu}, dtype)[1]
    later = _scalars(lambda z, u, d: (step.sample(z, u, d),), {"z": s.nz, "u": s.nu, "d": s.nd}, dtype)[1]
    rows = "const real *z, const real *u, const real *d"

    def put(name: str, values: Iterable[Number]) -> list[tuple[str, Number]]:
        return [(f"{name}[{k}]", v) for k, v in enumerate(values)]

    parts = [
        _function(f"static void advance({rows}, real *after)", put("after", after), networks),
        _function("static real square(const real *x, const real *ref)", [("", square)], networks),
        _function("static void augment(const real *x, const real *u, real *out)", put("out", augmented), networks),
        _function("static real lift(const real *x, const real *u)", [("", lift[0][0])], networks),
        _function(f"void nsde_predict({rows}, real *after)", put("after", later[0]), networks),
        _function(
            f"static void step_slopes({rows}, real *restrict a, real *restrict b, real *restrict after)",
            [*put("after", after), *a.entries, *b.entries],
            networks,
            slopes=True,
        ),
        _function(
            "static real cost_slopes(const real *x, const real *ref, real *restrict q, real *restrict g)",
            [*q.entries, *put("g", half), ("", square)],
            networks,
            slopes=True,
        ),
        _products(a, b, q, s.nz),
    ]  # fmt: skip
    sizes = {name: max(len(m.entries), 1) for name, m in (("na", a), ("nb", b), ("nq", q))}
    height = s.nz + s.nu * rate
    return "\n".join((*networks.code, *parts)), {**sizes, "rows": height, "stride": -(-height // 4) * 4}


def sources(
    step: ExportedStep, name: str, about: Mapping[str, Any], estimator: EstimatorOptions
) -> tuple[str, str]:
    """Source and header, whose last lines await the record in the place of `@RECORD@`.

    Args:
        step: What is exported.
        name: Of the files, without their endings.
        about: The record.
        estimator: Latency, and how fast pushes are learned.

    Raises:
        ConfigError: a plan over several paths, or names and times that cannot be.
        ExportError: the model holds an operation that is not known in C.
    """
    if step.sizes.particles > 1:
        raise ConfigError(
            f"`format=c` plans along the mean path; got mpc.particles={step.sizes.particles}. Take mpc.particles=1, or "
            "format=torchscript."
        )
    if not re.fullmatch(r"\w+", name):
        raise ConfigError(f"a C file is named by letters, digits and _; got {name!r}.")
    times = Estimator(step.sample, estimator, period=about["period_s"])
    scalar.forget()
    model, sizes = _model(step)
    scalar.forget()
    s, o, system = step.sizes, step.options, step.predictor.system
    starts, at = {}, 0
    for port, width in step.predictor.ports.items():
        starts[port], at = at, at + width
    status = [f"   {k:2d}  {word.replace(':', ', ')}" for k, word in enumerate(STATUS)]
    values: dict[str, Any] = {
        **about,
        **sizes,
        **vars(s),
        **{k: number(v) for k, v in vars(estimator).items()},
        **{k: number(float(v)) for k, v in vars(step.safety).items()},
        **{k: number(float(getattr(o, k))) for k in ("low", "high", "input_weight", "input_centre", "rate_weight")},
        **{"tolerance": number(step.tolerance), "left": number(step.left)},
        "force_at": starts.get(Port.BODY_FORCE, -1),
        "moment_at": starts.get(Port.BODY_MOMENT, -1),
        "NAME": name,
        "VERSION": about["versions"]["nsde_torch"],
        "PRECISION": "NSDE_FLOAT" if step.dtype == torch.float32 else "NSDE_DOUBLE",
        "MODEL": model,
        "shares": ", ".join(map(number, (*SHARES, 0.0))),
        "keep_s": step.safety.keep,
        "hover": ", ".join(map(number, about["hover"])),
        "iterations": step.iterations,
        "changes": step.changes,
        "system": system.name,
        "memory": s.nz - s.nx,
        "model_sha256": about["model"]["weights_sha256"],
        "past": times.past,
        "ahead": times.ahead,
        "state_doc": _listed(f"{n} [{unit}]" for n, unit in zip(system.state_names, system.state_units, strict=True)),
        "input_doc": _listed(system.input_names),
        "push_doc": _listed(f"{port.value}, {width} axes" for port, width in step.predictor.ports.items())
        + " [m/s2, rad/s2]",
        "status_doc": "\n".join(status),
    }  # fmt: skip

    def filled(file: str) -> str:
        text = (_TEMPLATES / file).read_text(encoding="utf-8")
        return re.sub(r"@(\w+)@", lambda m: m[0] if m[1] == "RECORD" else str(values[m[1]]), text)

    return filled("controller.c"), filled("controller.h")


def _listed(words: Iterable[str]) -> str:
    return fill(", ".join(words), width=100, subsequent_indent=" " * 14)
