"""How much of what is missing a flexible model wins on runs left out, beside effects, an oracle and PySINDy.

    pip install 'pysindy>=2.0,<3'
    python benchmarks/blind/flexible_cases.py --machine odd_spring --seed 1 --count 12 --out runs/flexible

Cases are those of `laws.py`: springs, carts and two joints with one law that no catalogue has, and nulls; of
`odd_spring` and `odd_cart` the law cannot be written with few terms. Everything is judged on the last fifth of the
runs, which nothing was fitted to, by the rms of the mean residual rates over a quarter of a second in the channel that
the law moves most:

- physics, effects, flexible: of the diagnosis, whose parameters, functions and noise come from the other runs; which
  effects there are was decided on all runs;
- oracle: physics with the true law, its size and the parameters fitted to the other runs;
- sindy: the rates of PySINDy (`peers.Sparse`: polynomials of degree 3 and waves of angles, smoothed differences, STLSQ
  with its threshold chosen on a run of the training part). Of a law that it could have written, its equation counts as
  right where its terms are those of the declared physics and of the law.
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
from laws import NEAR, Array, Json
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
            k: content["flexible"][k]
            for k in ("why_not", "explained", "explained_90", "left", "left_nats", "p")
        },
        "sentence": content["flexible"]["sentence"],
        "variables": [v["variable"] for v in content["flexible"]["variables"]],
    }
    if law is None or most.model is None:
        return out
    out["residual"] = residuals(found, law)
    if law.kind.text in TERMS:
        out["sindy_terms"] = terms(data, found.system)
        extra = set(out["sindy_terms"]) - DECLARED[system] - {"1"}
        out["sindy_right"] = extra == {TERMS[law.kind.text]}
    return out


def residuals(found: Any, law: machines.Law) -> Json:
    """Residual of mean rates on the last fifth of the runs, in the channel that the law moves most."""
    from nsde_torch.diagnosis.decisions import BUDGETS
    from nsde_torch.diagnosis.flexible import flexible
    from nsde_torch.diagnosis.smooth_functions import FunctionGroup

    outcome, most = found.outcome, found.explanation.ceiling
    own = outcome.declared_variables.columns
    x, u = (
        np.stack([own[k] for k in names], 1) for names in (found.system.state_names, found.system.input_names)
    )
    truth = FunctionGroup(("the law",), "past", 1, lambda: law(x, u)[:, None])
    told = flexible(outcome.declared, outcome.declared_variables, BUDGETS, groups=[truth])
    training, test = held_apart(found.data)
    late = told.band_run >= len(training)

    def rms(squares: Array) -> Array:
        return np.asarray(np.sqrt(squares[late].mean(0)))

    physics, oracle = rms(told.plain_squares), rms(told.flexible_squares)
    c = int(np.argmax(physics / oracle))
    sparse = Sparse(found.system, training)
    return {
        "channel": told.names[c],
        "physics": physics[c],
        "effects": rms(most.model.plain_squares)[c],
        "flexible": rms(most.model.flexible_squares)[c],
        "oracle": oracle[c],
        "sindy": _of_sindy(sparse, test, found.system.state_names.index(told.names[c])),
    }


def _of_sindy(sparse: Sparse, test: list[Any], channel: int) -> float:
    from nsde_torch.sysid.explained import bump, smooth_rate

    parts = []
    for run in test:
        middle = 0.5 * (run.x[1:] + run.x[:-1])
        rate = np.asarray(sparse.model.predict(middle, u=run.u[:-1, : sparse.nu]))
        left = run.x[1:, [channel]] - run.x[:-1, [channel]] - sparse.dt * rate[:, [channel]]
        parts.append(smooth_rate(left, [(0, len(left))], bump(sparse.dt), sparse.dt))
    return float(np.sqrt(np.square(np.concatenate(parts)).mean()))


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
        cases = [d for d in own if d.get("residual")]
        line = f"{machine}: {sum(d['flexible']['left'] for d in nulls)} of {len(nulls)} nulls with something left"
        if cases:
            r = {
                k: np.array([d["residual"][k] for d in cases])
                for k in ("physics", "effects", "flexible", "oracle", "sindy")
            }
            near = {k: int((r[k] <= NEAR * r["oracle"]).sum()) for k in r}
            medians = {k: float(np.median(r[k] / r["oracle"])) for k in r}
            line += (
                f"; of {len(cases)} laws, residual within 10 % of the oracle's: {near}; median ratio to it: "
            )
            line += str({k: round(v, 2) for k, v in medians.items()})
            sure = [d for d in cases if not d["added"] or set(d["leads"]) == set(d["added"])]
            wrong = [
                d for d in cases if d["sure"] and d["residual"]["effects"] > NEAR * d["residual"]["oracle"]
            ]
            near_sure = sum(d["residual"]["flexible"] <= NEAR * d["residual"]["oracle"] for d in sure)
            line += f"; of {len(sure)} where nothing was verified, flexible near the oracle: {near_sure}"
            line += f"; sure of effects that are farther from it: {len(wrong)}"
            right = [d["sindy_right"] for d in cases if "sindy_right" in d]
            line += f"; PySINDy's terms right: {sum(right)} of {len(right)}"
        line += f"; median {np.median([d['ceiling_seconds'] for d in own if 'error' not in d]):.1f} s for the ceiling"
        out.append(line)
    return out


def main() -> None:
    """Judges cases one after another, and counts."""
    parser = options("A flexible model beside effects, an oracle and PySINDy.", count=12)
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
            "residual",
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
