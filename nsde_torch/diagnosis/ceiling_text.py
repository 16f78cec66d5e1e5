"""What a flexible model could win, as `diagnosis.json`, the terminal and the page have it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.evaluation.report import number
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import vocabulary

FLEXIBLE = (  # caption of the picture of a flexible model
    "Fitted to all runs, beside everything that was found, as far as it hangs on these variables alone. Grey: no "
    "logged sample is near (eta above 0.5), so that nothing is known there."
)

_NAMED = 3  # variables that a sentence names


def ceiling_content(found: Ceiling, outcome: Outcome, runs: int) -> dict[str, Any]:
    """The key `flexible` of `diagnosis.json`.

    Args:
        found: What a flexible model could win.
        outcome: What was concluded.
        runs: Number of runs.
    """
    whole = runs >= outcome.decisions.folds_fewest_runs
    units = row_units(outcome)
    out: dict[str, Any] = {
        "why_not": found.why_not or None,
        "measured_on": "runs left out" if whole else "stretches left out",
        "explained": found.explained,
        "explained_90": _pair(found.explained_interval),
        "effects_nats": found.effects,
        "alone_nats": found.alone,
        "left_nats": found.left,
        "left_90": _pair(found.interval),
        "p": found.p,
        "left": found.more,
        "channels": {name: vars(c) for name, c in found.channels.items()},
        "variables": [
            {"row": t.row, "unit": units.get(t.row, ""), "variable": t.variable, "nats": t.nats}
            for t in found.telling
        ],
        "pairs": found.pairs,
    }
    out["sentence"] = " ".join(filter(None, (_explained(out, bool(outcome.found)), _left(out))))
    out["remedy"] = _remedy(out)
    return out


def row_units(outcome: Outcome) -> dict[str, str]:
    """Unit of each row that a flexible model may stand on."""
    system: System = outcome.final.regression.vector.system
    out = {}
    for port, rows in dict(vocabulary(type(system)).ports).items():
        for name, unit in zip(rows.names, rows.units, strict=True):
            out[f"{port}[{name}]" if name else port] = unit
    return out


def wanted(variables: Sequence[Mapping[str, Any]]) -> str:
    """The variables that a flexible model needs, in words: `q and q_dot on force`."""
    if not variables:
        return "all that was measured"
    row = variables[0]["row"]
    names = [v["variable"] for v in variables if v["row"] == row][:_NAMED]
    told = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{told} on {row}"


def ceiling_lines(content: Mapping[str, Any]) -> list[str]:
    """Lines for the terminal."""
    own = content["flexible"]
    out = ["", f"ceiling: {own['sentence']}"]
    if own["left"]:
        out.append(f"  a lead, unverified: {own['remedy']}")
    return out


def ceiling_html(
    content: Mapping[str, Any], figure: str, table: Callable[[Sequence[str], Sequence[Sequence[str]]], str]
) -> str:
    """The section of the page.

    Args:
        content: As `diagnosis.json` has it.
        figure: The picture; empty without one.
        table: Makes a table from its head and rows.
    """
    own = content["flexible"]
    text = f"<h2>What a flexible model could win</h2><p>{escape(own['sentence'])}</p>"
    if own["left"]:
        text += f'<p><span class="lead">a lead, unverified</span> {escape(own["remedy"])}</p>'
    head, rows = ceiling_rows(content)
    return f"{text}{table(head, rows) if rows else ''}{figure}"


def ceiling_rows(content: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of held-out residuals; no rows where a flexible model wins nothing."""
    own = content["flexible"]
    head = [
        "rate of",
        "declared physics",
        "with effects",
        "with a flexible model too",
        "unit",
        "log-likelihood [nat]",
    ]
    rows = [
        [name, *(number(c[k]) for k in ("physics", "effects", "flexible")), c["unit"], f"{c['nats']:+.1f}"]
        for name, c in own["channels"].items()
    ]
    return head, rows if own["left"] else []


def _explained(own: Mapping[str, Any], found: bool) -> str:
    """How much of the ceiling the effects explain."""
    if own["why_not"]:
        return f"What a flexible model could win was not measured: {own['why_not']}."
    if not found:
        return "" if own["left"] else f"A flexible model finds nothing to explain on {own['measured_on']}."
    if own["explained"] is None:
        return f"Neither the effects nor a flexible model win anything on {own['measured_on']}."
    if own["effects_nats"] <= 0:
        beside = (
            f", where a flexible model in their place wins {own['alone_nats']:.1f}"
            if own["alone_nats"] > 0
            else ""
        )
        return (
            f"The effects win no log-likelihood on {own['measured_on']} ({own['effects_nats']:+.1f} nats{beside}): "
            "evidence for them is in the data that they were fitted to alone."
        )
    ends = own["explained_90"]
    if own["explained"] >= 0.995:
        least = "" if ends is None or ends[0] >= 0.995 else f" (90 % interval: from {ends[0]:.0%} on)"
        return f"The effects explain at least all that a flexible model can on {own['measured_on']}{least}."
    between = "" if ends is None else f" ({ends[0]:.0%} to {ends[1]:.0%})"
    return (
        f"The effects explain {own['explained']:.0%}{between} of what a flexible model can, in log-likelihood on "
        f"{own['measured_on']}."
    )


def _left(own: Mapping[str, Any]) -> str:
    """What a flexible model still wins."""
    if not own["left"]:
        return ""
    ends = own["left_90"]
    between = "" if ends is None else f" ({ends[0]:+.1f} to {ends[1]:+.1f})"
    text = f"A flexible model of {wanted(own['variables'])} still wins {own['left_nats']:.1f} nats{between} there"
    channels = own["channels"]
    if channels:
        name = max(channels, key=lambda k: channels[k]["nats"])
        c = channels[name]
        unit = "" if c["unit"] == "1" else f" {c['unit']}"
        change = 1.0 - c["flexible"] / c["effects"] if c["effects"] > 0 else 0.0
        text += f": the residual of {name} goes from {number(c['effects'])} to {number(c['flexible'])}{unit}"
        text += f", {change:.0%} of it" if change > 0 else ""
    return f"{text}; no formula that holds says why."


def _remedy(own: Mapping[str, Any]) -> str | None:
    if not own["left"]:
        return None
    return (
        f"look for what depends on {wanted(own['variables'])}, and fly or drive these variables apart from each other; "
        "until it has a name, the networks of `nsde train model=nsde system.effects=effects.yaml` learn it, and their "
        "eta says where to trust them."
    )


def _pair(ends: tuple[float, float] | None) -> list[float] | None:
    return None if ends is None else list(ends)
