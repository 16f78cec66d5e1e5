"""The solver and the estimator in C: text of one file each, made of templates and of what a model's functions are.

What is written by hand and what is the model's meet in `templates`: the iteration is that of
`control.gauss_newton.GaussNewton` and the update that of `control.autopilots.Estimator`, as loops over arrays of fixed
sizes; the model, its derivatives and the products with its sparse Jacobians are generated from the functions of the
controller itself (`scalar`). In the place of the condensed Hessian a recursion over the steps (Riccati's) solves for
the free inputs: the same numbers up to rounding, for K (nz + nu)^3 operations instead of (K nu)^3.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nsde_torch.control.codegen import scalar
from nsde_torch.control.codegen.code import Matrix, Networks, function, number, products
from nsde_torch.control.codegen.scalar import Number, Table
from nsde_torch.control.gauss_newton import (
    CHANGES,
    FACTORS,
    FIRST_STEP,
    LEFT,
    SHARES,
    AcceleratedGradient,
    GaussNewton,
)
from nsde_torch.control.predictor import Predictor

if TYPE_CHECKING:
    from nsde_torch.control.autopilots import Estimator

_ROWS = "const real *z, const real *u, const real *d"


def template(path: Path, values: Mapping[str, object]) -> str:
    """A template, each `@name@` in it that is named here filled in."""
    text = path.read_text(encoding="utf-8")
    return re.sub(r"@(\w+)@", lambda m: str(values.get(m[1], m[0])), text).rstrip() + "\n"


def scalars(
    function: Callable[..., Sequence[Tensor]], tables: Mapping[str, int], dtype: torch.dtype
) -> tuple[list[Table], list[Table]]:
    """A function of tables of one row, run on scalars: its inputs and its outputs.

    `tables` are name and width n of each argument; the function is from tensors (1, n) to tensors of `dtype`.
    ExportError: it holds an operation that is not known in C.
    """
    given = [scalar.inputs(name, 1, n) for name, n in tables.items()]
    made = scalar.run(function, given, dtype=dtype)
    return [t[0] for t in given], [t.reshape(-1) for t in made]


def put(name: str, values: Iterable[Number]) -> list[tuple[str, Number]]:
    """Places of an array, and what is put there."""
    return [(f"{name}[{k}]", v) for k, v in enumerate(values)]


def solver(method: GaussNewton, networks: Networks) -> dict[str, str]:
    """Parts of a file that hold an iteration of a plan along one path, by the name that it asks for them by."""
    h = method.horizon
    o, dtype, rate = h.options, h.predictor.dtype, float(h.rate_weight) > 0
    (z, u, _), (after,) = scalars(
        lambda z, u, d: (h.advance(z, u, d),), {"z": h.nz, "u": h.nu, "d": h.nd}, dtype
    )
    slopes = scalar.jacobian(list(after), [*z, *u])
    a = Matrix("a", [{j: x for j, x in row.items() if j < h.nz} for row in slopes], h.nz + h.nu * rate)
    inputs: list[dict[int, Number]] = [{j - h.nz: x for j, x in row.items() if j >= h.nz} for row in slopes]
    b = Matrix("b", [*inputs, *({i: 1.0} for i in range(h.nu * rate))], h.nu)
    (x, _), (roots,) = scalars(lambda x, ref: (h.residual(x, ref),), {"x": h.nx, "ref": h.nx}, dtype)
    by_state = scalar.jacobian(list(roots), list(x))

    def total(terms: Iterable[Number]) -> Number:
        return sum(terms, 0.0)

    terms = [
        {j: total(row[i] * row[j] for row in by_state if i in row and j in row) for j in range(h.nx)}
        for i in range(h.nx)
    ]
    q = Matrix("q", [{j: v for j, v in row.items() if v != 0.0} for row in terms], h.nx)
    square = total(r * r for r in roots)
    half = [
        total(row[i] * r for row, r in zip(by_state, roots, strict=True) if i in row) for i in range(h.nx)
    ]
    parts = [
        function(f"static void advance({_ROWS}, real *after)", put("after", after), networks),
        function("static real square(const real *x, const real *ref)", [("", square)], networks),
        function(
            f"static void step_slopes({_ROWS}, real *restrict a, real *restrict b, real *restrict after)",
            [*put("after", after), *a.entries, *b.entries],
            networks,
            slopes=True,
        ),
        function(
            "static real cost_slopes(const real *x, const real *ref, real *restrict q, real *restrict g)",
            [*q.entries, *put("g", half), ("", square)],
            networks,
            slopes=True,
        ),
        products(a, b, q, h.nz),
    ]
    rows = {"low": h.steps, "high": h.steps, "input_weight": 1, "input_centre": 1}
    names = h.predictor.system.input_names
    height = h.nz + h.nu * rate
    return _filled(
        ("sizes.h", "work.h", "common.c", "solver.c"),
        {
            **_sizes(h.predictor),
            **{name: max(len(m.entries), 1) for name, m in (("na", a), ("nb", b), ("nq", q))},
            **{k: ", ".join(map(number, o.of_inputs(k, names) * n)) for k, n in rows.items()},
            "rate_weight": number(float(o.rate_weight)),
            **{"steps": h.steps, "rows": height, "stride": -(-height // 4) * 4},
            **{"changes": CHANGES, "left": number(LEFT)},
            "shares": ", ".join(map(number, (*SHARES, 0.0))),
            "MODEL": "\n".join((*networks.code(), *parts)),
        },
    )


def estimator(made: Estimator, predictor: Predictor, networks: Networks) -> dict[str, str]:
    """Parts of a file that hold the update of the estimator, by the name that it asks for them by."""
    p, sizes = predictor, {"z": predictor.nz, "u": predictor.nu, "d": predictor.nd}
    later = scalars(lambda z, u, d: (p(z, u, d),), sizes, p.dtype)[1]
    known = {"x": p.nx, "z": p.nz, "d": p.nd}
    learned = scalars(lambda x, z, d: (made.learned(x, z, d),), known, p.dtype)[1]
    head = "static void learn(const real *x, const real *z, const real *d, real *restrict learned)"
    parts = [
        function(f"void nsde_predict({_ROWS}, real *after)", put("after", later[0]), networks),
        function(head, put("learned", learned[0]), networks),
    ]
    return {
        "PREDICTION": "\n".join((*networks.code(), *parts)),
        **_filled(
            ("sizes.h", "common.c", "estimator.c"), {**_sizes(p), "past": made.past, "ahead": made.ahead}
        ),
    }


_TEMPLATES = Path(__file__).parent / "templates"


def _sizes(p: Predictor) -> dict[str, object]:
    precision = "NSDE_FLOAT" if p.dtype == torch.float32 else "NSDE_DOUBLE"
    return {"nx": p.nx, "nu": p.nu, "nz": p.nz, "nd": p.nd, "PRECISION": precision}


def _filled(files: Iterable[str], values: Mapping[str, object]) -> dict[str, str]:
    return {file.partition(".")[0].upper(): template(_TEMPLATES / file, values) for file in files}


def solver_library(method: GaussNewton | AcceleratedGradient) -> str:
    """Source of a library of `nsde_iterate`, see `templates/solver_rows.c`."""
    own, newton = ("gauss_newton.c", method) if isinstance(method, GaussNewton) else ("apg.c", method.newton)
    with scalar.of_their_own():
        parts = solver(newton, Networks())
    values = {"factors": ", ".join(map(number, FACTORS)), "first_step": number(FIRST_STEP)}
    rows = [template(_TEMPLATES / file, values) for file in (own, "solver_rows.c")]
    return "\n".join(
        ("#define NSDE_DOUBLE", *(parts[k] for k in ("SIZES", "WORK", "COMMON", "SOLVER")), *rows)
    )


def estimator_library(made: Estimator, predictor: Predictor) -> str:
    """Source of a library of `nsde_estimate`, see `templates/estimator_rows.c`."""
    with scalar.of_their_own():
        parts = estimator(made, predictor, Networks())
    rows = template(_TEMPLATES / "estimator_rows.c", {})
    names = ("SIZES", "COMMON", "PREDICTION", "ESTIMATOR")
    return "\n".join(("#define NSDE_DOUBLE", *(parts[k] for k in names), rows))
