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

import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import law_machines as machines
import laws
from laws import Json
from peers import Sparse, held_apart
from study import answers, options

DECLARED = {
    "mass_spring_damper": {"q", "q_dot", "force"},
    "cartpole": set(),
}
TERMS = {
    "force = c1 q q_dot": "q q_dot",
    "force = c1 q^2": "q^2",
    "force = c1 q^2 q_dot": "q^2 q_dot",
    "force = c1 q_dot^3": "q_dot^3",
    "force = c1 q force": "q force",
    "force = c1 q q_dot^2": "q q_dot^2",
}
"""Laws that PySINDy's library has as one term."""


def case(machine: str, seed: int, i: int) -> Json:
    """Make, diagnose and judge one case."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    system = laws.SYSTEMS[machine]
    with tempfile.TemporaryDirectory() as folder:
        law = laws.write(machine, seed, i, Path(folder))
        data = nsde_torch.read(folder, system=system)
    started = time.perf_counter()
    found = nsde_torch.diagnose(data, system=system)
    seconds = time.perf_counter() - started
    most, content = found.explanation.ceiling, found.content()
    out: Json = {
        "case": i,
        "machine": machine,
        "truth": None if law is None else {"law": law.kind.text, "c1": law.size},
        "seconds": seconds,
        "ceiling_seconds": found.seconds["ceiling"],
        "verdict": content["verdict"],
        "added": content["added"],
        "leads": [f["name"] for f in content["findings"] if f["lead"]],
        "sure": laws.sure(content),
        "flexible": {
            k: content["flexible"][k] for k in ("why_not", "explained", "explained_90", "left", "left_nats")
        },
        "sentence": content["flexible"]["sentence"],
        "variables": [v for r in content["flexible"]["rows"] for v in r["variables"]],
    }
    if law is None or most.gain is None:
        return out
    out["nats"] = shares(found, law)
    if law.kind.text in TERMS:
        out["sindy_terms"] = terms(data, found.system)
        extra = set(out["sindy_terms"]) - DECLARED[system] - {"1"}
        out["sindy_right"] = extra == {TERMS[law.kind.text]}
    return out


def shares(found: Any, law: machines.Law) -> Json:
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
    return {
        "effects": most.effects,
        "all": most.effects + most.left,
        "oracle": sum(oracle.nats.values()),
    }


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


def main() -> None:
    """Judges cases one after another, and counts."""
    parser = options("Functions beside effects, an oracle and PySINDy.", count=12)
    parser.add_argument(
        "--machine", choices=["spring", "cart", "joints", "odd_spring", "odd_cart"], required=True
    )
    a = parser.parse_args()

    def line(answer: Json) -> str:
        keys = (
            "truth",
            "added",
            "leads",
            "sure",
            "flexible",
            "variables",
            "nats",
            "sindy_terms",
            "sindy_right",
            "seconds",
            "error",
        )
        return f"{answer['case']} { {k: answer[k] for k in keys if k in answer} }"

    numbers = range(a.first, a.first + a.count)
    cases = [
        (
            f"{a.machine}_{a.seed}_{i:03d}",
            partial(case, a.machine, a.seed, i),
            {"case": i, "machine": a.machine, "truth": None},
        )
        for i in numbers
    ]
    print("\n".join(table(answers(a.out, cases, line))))


if __name__ == "__main__":
    main()
