"""What is said of an experiment: the question, the plan, nats expected and obtained, what stood before and after."""

from __future__ import annotations

from collections.abc import Mapping
from math import log
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsde_torch.design import Standing
from nsde_torch.design.experiment import PLAN

from .limits import limit_key

_NAMED = 3
_NEAR = 0.7
"""Share of a limit from which it is named as one that binds."""


def asked(question: Mapping[str, Any]) -> str:
    """The question in words."""
    if question["kind"] == "tie":
        return f"which is true, {' or '.join(question['names'])}?"
    return f"how large: {', '.join(question['parameters'])}?"


def expected_nats(plan: Mapping[str, Any]) -> float:
    """What is expected of a plan, whichever member is true; of parameters, of all together [nats]."""
    if plan["question"]["kind"] == "tie":
        return float(min(e["nats"]["mean"] for e in plan["expected"]))
    return float(sum(_information(p) for p in _asked_parameters(plan).values()))


def _asked_parameters(plan: Mapping[str, Any]) -> dict[str, Any]:
    names = plan["question"]["parameters"]
    every = plan["expected"][0]["parameters"]
    return {k: p for k, p in every.items() if any(k == n or k.startswith(f"{n}[") for n in names)}


def _information(p: Mapping[str, Any]) -> float:
    then = p["expected_standard_error"]
    return 0.0 if then is None else log(p["standard_error"] / then)


def too_little(plan: Mapping[str, Any], told: float, config: DictConfig) -> str:
    """That no plan is informative, and which limits the best one comes close to."""
    near = [
        f"{name} ({'leaves' if share > 1 else f'takes {share:.0%} of'} {limit_key(name, config)} in rehearsal)"
        for name, share in sorted(plan["plan"]["largest_share_of_limits"].items(), key=lambda kv: -kv[1])
        if share >= _NEAR and name[:2] in ("p_", "v_", "w_")
    ][:_NAMED]
    path = plan["path_limits"] or {}
    for name, what in (("sideways", "acceleration_sideways"), ("up", "acceleration_up")):
        if path and path[f"largest_{name}"] >= 0.99 * path[what]:
            near.append(f"acceleration {name} ({path[what]:g} {path['unit']}, the most that a path asks for)")
    binds = ", ".join(near) or "its length"
    return (
        f"{asked(plan['question'])} No plan within the limits shows much: of the best one {told:.2g} nats are "
        f"expected, less than experiment.least_nats={config.experiment.least_nats:g}. What limits it: {binds}. "
        f"Allow more, or a longer experiment (experiment.duration={config.experiment.duration:g})."
    )


def entry_of(
    place: Path,
    number: int,
    plan: Mapping[str, Any],
    told: Mapping[str, Any],
    before: Standing,
    after: Standing,
    flown: Mapping[str, Any],
) -> dict[str, Any]:
    """What `close_loop.json` says of an experiment."""
    tie = plan["question"]["kind"] == "tie"
    brought = told["nats"][told["speaks_for"]] if tie else told["nats"]
    wanted = told["expected_nats"]
    return {
        "number": number,
        "question": plan["question"],
        "plan": {
            "file": f"{place.name}/{PLAN}",
            "words": plan["plan"]["words"],
            "duration_s": plan["plan"]["duration_s"],
            "largest_share_of_limits": plan["plan"]["largest_share_of_limits"],
        },
        "expected_nats": (
            {e["if_true"]: e["nats"]["mean"] for e in plan["expected"]} if tie else expected_nats(plan)
        ),
        "obtained": dict(told),
        "nats_expected": expected_nats(plan) if wanted is None else wanted,
        "nats_obtained": brought,
        "flight": {k: flown.get(k) for k in ("tracked", "trouble", "rmse_m")},
        "before": before.content(),
        "after": after.content(),
    }


def experiment_lines(entry: Mapping[str, Any]) -> list[str]:
    """What is printed of an experiment."""
    told, question = entry["obtained"], entry["question"]
    lines = [
        f"experiment {entry['number']}: {asked(question)}",
        f"  before: {entry['before']['words']}",
        *(f"  plan: {w}" for w in entry["plan"]["words"]),
    ]
    if entry["flight"]["trouble"]:
        lines.append(f"  the flight was not flown to its end: {entry['flight']['trouble']['text']}")
    if question["kind"] == "tie":
        wanted = ", ".join(f"{n:.1f} if {name}" for name, n in entry["expected_nats"].items())
        broken = "distinguished" if told["broken"] else "still indistinguishable"
        lines.append(
            f"  nats expected: {wanted}; obtained: {entry['nats_obtained']:.1f} for {told['speaks_for']} ({broken})"
        )
    else:
        lines.append(f"  nats expected: {entry['nats_expected']:.1f}; obtained: {entry['nats_obtained']:.1f}")
        for label, p in told["parameters"].items():
            wanted = p["expected_standard_error"]
            lines.append(
                f"    {label}: standard error {p['standard_error_before']:.2g} -> {p['standard_error']:.2g} {p['unit']}"
                + ("" if wanted is None else f" ({wanted:.2g} expected)")
            )
    if told.get("surprise"):
        lines.append(f"  {told['surprise']}")
    if told["doubt"] is not None:
        lines.append(f"  what was thought possible is not all: {told['doubt']}")
    return [*lines, f"  after: {entry['after']['words']}"]
