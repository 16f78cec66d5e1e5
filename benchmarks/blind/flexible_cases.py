"""How much of what is missing effects and functions explain on blocks left out, beside an oracle and PySINDy.

    pip install 'pysindy>=2.0,<3'
    python benchmarks/blind/flexible_cases.py --machine odd_spring --seed 1 --count 12 --out runs/flexible

Cases are those of `laws.py`: springs, carts and two joints with one law that no catalogue has, and nulls; of
`odd_spring` and `odd_cart` the law cannot be written with few terms. Everything is judged by the log likelihood of
blocks of time that it was not fitted to, over that of the declared physics [nats]:

- effects: those of the diagnosis;
- all: these and the functions of what was measured beside them;
- oracle: polynomials of the true law, as the only variable that functions may be of.

PySINDy (`peers.Sparse`: polynomials of degree 3 and waves of angles, smoothed differences, STLSQ with its threshold
chosen on a run of the training part) counts as right where it could have written the law and the terms of its equation
are those of the declared physics and of the law.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import laws
import numpy as np
from law_machines import ODD, SYSTEMS, TEXTS, Law
from peers import Sparse, held_apart
from study import Json, answers, numbered, options, written

DECLARED = {"mass_spring_damper": {"q", "q_dot", "force"}, "cartpole": set()}
TERMS = {t: t.partition(" c1 ")[2] for t in TEXTS["spring"] if "max" not in t and "^5" not in t}
"""Laws that PySINDy's library has as one term."""


def case(machine: str, seed: int, i: int) -> Json:
    """Make, diagnose and judge one case."""
    import nsde_torch

    system, data = SYSTEMS[machine], None

    def read(folder: Path) -> Law | None:
        nonlocal data
        law = laws.write(machine, seed, i, folder)
        data = nsde_torch.read(folder, system=system)
        return law

    law, found, answer = written(read, system)
    flexible = found.content()["flexible"]
    keys = ("why_not", "explained", "explained_90", "left", "left_nats")
    out: Json = {
        "case": i,
        "machine": machine,
        "truth": None if law is None else {"law": law.kind.text, "c1": law.size},
        **answer,
        "ceiling_seconds": found.seconds["ceiling"],
        "flexible": {k: flexible[k] for k in keys},
        "sentence": flexible["sentence"],
        "variables": [v for r in flexible["rows"] for v in r["variables"]],
    }
    if law is None or found.explanation.ceiling.gain is None:
        return out
    out["nats"] = shares(found, law)
    if law.kind.text in TERMS:
        out["sindy_terms"] = terms(data, found.system)
        extra = set(out["sindy_terms"]) - DECLARED[system] - {"1"}
        out["sindy_right"] = extra == {TERMS[law.kind.text]}
    return out


def shares(found: Any, law: Law) -> Json:
    """Log likelihood that effects, all, and functions of the true law bring to blocks left out [nats]."""
    import torch

    from nsde_torch.diagnosis.ceiling import optimum_of
    from nsde_torch.inference.functions import Variables, learned

    outcome, most = found.outcome, found.explanation.ceiling
    near = most.gain.at if outcome.joint is None else outcome.joint.declared.at
    at = optimum_of(outcome.declared_system, near)

    def true(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(law(x.numpy(), u.numpy()))[:, None]

    oracle = learned(at, Variables(("the law",), true), range(len(at.of.space.disturbances)))
    return {"effects": most.effects, "all": most.effects + most.left, "oracle": sum(oracle.nats.values())}


def terms(data: Any, system: Any) -> list[str]:
    """Terms of PySINDy's equation of the last rate, of the training runs."""
    training, _ = held_apart(data)
    sparse = Sparse(system, training)
    names = sparse.model.get_feature_names()
    plain = {"x0": "q", "x1": "q_dot", "u0": "force"}
    row = np.asarray(sparse.model.coefficients())[-1]
    out = []
    for name, value in zip(names, row, strict=True):
        if value != 0.0:
            for short, long in plain.items():
                name = name.replace(short, long)
            out.append(name)
    return out


def table(done: list[Json]) -> list[str]:
    """Counts and medians by machine."""
    out = []
    for machine in dict.fromkeys(d["machine"] for d in done):
        own = [d for d in done if d["machine"] == machine]
        nulls = [d for d in own if d["truth"] is None and "error" not in d]
        cases = [d for d in own if d.get("nats") and d["nats"]["oracle"] > 0]
        line = f"{machine}: {sum(d['flexible']['left'] for d in nulls)} of {len(nulls)} nulls with something left"
        if cases:
            share = {
                k: np.array([d["nats"][k] / d["nats"]["oracle"] for d in cases]) for k in ("effects", "all")
            }
            line += f"; of {len(cases)} laws, median share of the oracle's nats: "
            line += str({k: round(float(np.median(v)), 2) for k, v in share.items()})
            line += f"; at least 0.8: { {k: int((v >= 0.8).sum()) for k, v in share.items()} }"
            wrong = [d for d in cases if d["sure"] and d["nats"]["effects"] < 0.8 * d["nats"]["oracle"]]
            line += f"; sure of effects that have less: {len(wrong)}"
            right = [d["sindy_right"] for d in cases if "sindy_right" in d]
            line += f"; PySINDy's terms right: {sum(right)} of {len(right)}"
        line += f"; median {np.median([d['ceiling_seconds'] for d in own if 'error' not in d]):.1f} s for the ceiling"
        out.append(line)
    return out


def line(answer: Json) -> str:
    keys = ("truth", "added", "leads", "sure", "flexible", "variables", "nats", "sindy_terms", "sindy_right")
    return f"{answer['case']} { {k: answer[k] for k in (*keys, 'seconds', 'error') if k in answer} }"


def main() -> None:
    parser = options(__doc__, "seed", "out", first=0, count=12)
    parser.add_argument("--machine", choices=["spring", "cart", "joints", *ODD], required=True)
    a = parser.parse_args()
    cases = numbered(a, partial(case, a.machine), a.machine, machine=a.machine, truth=None)
    print("\n".join(table(answers(a.out, cases, line))))


if __name__ == "__main__":
    main()
