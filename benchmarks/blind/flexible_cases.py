"""How much of what is missing effects and functions explain on blocks left out, beside an oracle.

    python benchmarks/blind/flexible_cases.py --machine odd_spring --seed 1 --count 12 --out runs/flexible

Cases are those of `laws.py`; of `odd_spring` and `odd_cart` the law cannot be written with few terms. Everything is
judged by the log likelihood of blocks of time that it was not fitted to, over that of the declared physics [nats]: of
the effects of the diagnosis, of all (these and functions of what was measured), and of an oracle, polynomials of the
true law.
"""

from functools import partial
from typing import Any

import laws
import numpy as np
from law_machines import ODD, SYSTEMS, Law
from study import Json, answers, numbered, options, written


def case(machine: str, seed: int, i: int) -> Json:
    law, found, answer = written(lambda folder: laws.write(machine, seed, i, folder), SYSTEMS[machine])
    flexible = found.content()["flexible"]
    keys = ("why_not", "explained", "explained_90", "left", "left_nats", "sentence")
    out: Json = {
        "truth": None if law is None else {"law": law.kind.text, "c1": law.size},
        **answer,
        "ceiling_seconds": found.seconds["ceiling"],
        "flexible": {k: flexible[k] for k in keys},
        "variables": [v for r in flexible["rows"] for v in r["variables"]],
    }
    if law is not None and found.explanation.ceiling.functions is not None:
        out["nats"] = nats_of(found, law)
    return out


def nats_of(found: Any, law: Law) -> Json:
    """Log likelihood that effects, all, and functions of the true law bring to blocks left out [nats]."""
    import torch

    from nsde_torch.diagnosis.ceiling import optimum_of
    from nsde_torch.inference.functions import Variables, learned

    outcome, most = found.outcome, found.explanation.ceiling
    near = outcome.optimum if outcome.joint is None else outcome.joint.declared.at
    at = optimum_of(outcome.declared_system, near)

    def true(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(law(x.numpy(), u.numpy()))[:, None]

    oracle = learned(at, Variables(("the law",), true), range(len(at.of.space.disturbances)))
    return {"effects": most.effects, "all": most.effects + most.left, "oracle": sum(oracle.nats.values())}


def table(done: list[Json]) -> None:
    """Print how many nulls have something left, and the shares of an oracle's nats."""
    done = [d for d in done if "error" not in d]
    nulls = [d for d in done if d["truth"] is None]
    cases = [d for d in done if d.get("nats") and d["nats"]["oracle"] > 0]
    print(f"{sum(d['flexible']['left'] for d in nulls)} of {len(nulls)} nulls with something left")
    for key in ("effects", "all") if cases else ():
        share = np.array([d["nats"][key] / d["nats"]["oracle"] for d in cases])
        most = f"at least 0.8 in {(share >= 0.8).sum()} of {len(cases)} laws"
        print(f"{key}: median share of the oracle's nats {np.median(share):.2f}, {most}")
    sure = sum(bool(d["sure"]) and d["nats"]["effects"] < 0.8 * d["nats"]["oracle"] for d in cases)
    seconds = np.median([d["ceiling_seconds"] for d in done])
    print(f"sure of effects that have less: {sure}; median {seconds:.1f} s for the ceiling")


def line(answer: Json) -> str:
    keys = ("truth", "added", "leads", "sure", "flexible", "variables", "nats", "seconds", "error")
    return str({k: answer[k] for k in keys if k in answer})


def main() -> None:
    parser = options(__doc__, "seed", "out", first=0, count=12)
    parser.add_argument("--machine", choices=["spring", "cart", "joints", *ODD], required=True)
    a = parser.parse_args()
    table(answers(a.out, numbered(a, partial(case, a.machine), a.machine), line))


if __name__ == "__main__":
    main()
