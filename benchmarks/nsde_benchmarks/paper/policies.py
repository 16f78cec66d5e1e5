"""Figures 13 and 14 of the supplement: policies that learned in a model, judged on the truth.

Read from the folder of a policy study: `policies.json` and one `policy.json` for each policy.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nsde_torch.errors import DataError
from nsde_torch.plots.evaluation import policy_rewards

from .outcome import Check, ExperimentOutcome

_ENOUGH = 0.95
_NUMBERS = ("reward", "reward_std_over_seeds", "score", "score_std_over_seeds", "seeds")
_WORDS = {
    "nsde": "policies that learned in the neural SDE score at least {}",
    "ensemble": "those that learned in the ensemble do not",
    "ensemble_redrawn": "nor those where its members are redrawn at every step",
}
_NAMES = {
    "truth": "truth",
    "limited": "truth, 20,000 interactions",
    "nsde": "neural SDE",
    "blackbox_nsde": "SDE without physics",
    "node": "neural ODE",
    "ensemble": "Gaussian ensemble",
    "ensemble_redrawn": "members redrawn",
}


def learned_in(study: Path, kinds: Sequence[str], *, title: str, source: str) -> ExperimentOutcome:
    """Scores of policies by where they learned; DataError where the folder holds no study."""
    try:
        rows = _report(study / "policies.json")["rows"]
        outcome = ExperimentOutcome(title=title, source=source)
        for data in dict.fromkeys(r["data"] for r in rows if r["environment"] in kinds):
            own = [r for r in rows if r["data"] == data and r["environment"] in kinds]
            judges = [r for r in rows if r["environment"] in ("truth", "limited")]
            truth = [r for r in judges if r["data"] == own[0]["truth"]]
            outcome.checks += [_check(r) for r in own if r["environment"] in _WORDS]
            outcome.checks += _with_physics({r["environment"]: r for r in own})
            outcome.values[data] = {r["environment"]: {k: r[k] for k in _NUMBERS} for r in (*truth, *own)}
            shown = [*(r for r in truth if r["environment"] == "truth"), *own]
            outcome.figures[data] = policy_rewards(
                {
                    _NAMES[r["environment"]]: [
                        _report(Path(f) / "policy.json")["curve"] for f in r["policies"]
                    ]
                    for r in shown
                },
                random=own[0]["random_reward"],
                truth=own[0]["truth_reward"],
                limited=next((r["reward"] for r in truth if r["environment"] == "limited"), None),
                title=f"{title}: {data.replace('_', ' ')} data",
            )
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise DataError(
            f"`policies`: {study} holds no finished study of policies ({error}); benchmarks/bench_policy.py makes one."
        ) from error
    return outcome


def _report(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _score(row: dict[str, Any]) -> str:
    if row["seeds"] == 1:
        return f"{row['score']:.3f} (one seed)"
    return f"{row['score']:.3f} ± {row['score_std_over_seeds']:.3f} over {row['seeds']} seeds"


def _with_physics(rows: Mapping[str, dict[str, Any]]) -> list[Check]:
    """Models with physics against the one without."""
    without = rows.get("blackbox_nsde")
    if without is None:
        return []
    where = f"{without['data'].replace('_', ' ')} data"
    return [
        Check(
            f"{where}: policies of the {_NAMES[kind]} with physics earn more than those of the SDE without",
            f"{_score(rows[kind])} against {_score(without)}",
            rows[kind]["score"] > without["score"],
        )
        for kind in ("nsde", "node")
        if kind in rows
    ]


def _check(row: dict[str, Any]) -> Check:
    measured = _score(row)
    where = f"{row['data'].replace('_', ' ')} data"
    claim = f"{where}: {_WORDS[row['environment']].format(_ENOUGH)}"
    enough = row["score"] >= _ENOUGH
    return Check(claim, measured, enough if row["environment"] == "nsde" else not enough)
