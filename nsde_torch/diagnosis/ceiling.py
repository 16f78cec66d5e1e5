"""How much of what can be explained the effects explain: the ceiling, on blocks of time left out.

    explained = G_effects / (G_effects + G_left)

with gains in held-out log likelihood: of the effects over the declared physics, and of functions of all that was
measured (`learned_functions`) beside the effects. Its 90 % interval is from the scatter of both over blocks of time.
What hangs on three variables at once or on what was not logged is in no function: the ceiling is a lower bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.learned_functions import FunctionGain, RowGain, function_gain, optimum_of
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.trust import FAR, distance_from_data
from nsde_torch.diagnosis.views import variable_units
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS
from nsde_torch.evaluation.report import number
from nsde_torch.inference import Optimum
from nsde_torch.inference.functions import held_out_density
from nsde_torch.plots.flexible import Surface, flexible_surface

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_NAMED = 3  # variables that a sentence names
_HALF = 1.645  # standard errors of a 90 % interval
_GRID = {1: 200, 2: 60}  # points along each axis of the picture


@dataclass(frozen=True)
class Ceiling:
    """What functions of all that was measured explain beside the effects.

    Args:
        why_not: Why nothing was measured; empty where it was.
        effects: Held-out log likelihood of the effects [nats].
        left: What the functions bring beside them [nats].
        interval: 90 % interval of it.
        explained: Share of what can be explained that the effects explain; None without effects.
        explained_interval: Its 90 % interval; None where there are too few blocks.
        rows: What is left, by row of a port, the most first; empty where it is no more than chance.
        gain: The functions; None where nothing was measured.
    """

    why_not: str = ""
    effects: float = 0.0
    left: float = 0.0
    interval: tuple[float, float] | None = None
    explained: float | None = None
    explained_interval: tuple[float, float] | None = None
    rows: tuple[RowGain, ...] = ()
    gain: FunctionGain | None = None


def ceiling(log: Log, outcome: Outcome) -> Ceiling:
    """Measure what functions of all that was measured explain beside the effects.

    Args:
        log: The log.
        outcome: What was concluded.
    """
    at = outcome.optimum
    why_not = _why_not(log, outcome)
    if at is None or why_not:
        return Ceiling(why_not or "the likelihood of the log could not be computed")
    log.say("what functions could still explain", 0, 1)
    gain = outcome.beside
    if gain is None or gain.base is not outcome.final:
        most = log.budgets.function_groups
        gain = function_gain(outcome.final, at, outcome.test, most=most)
    before, after = gain.functions.blocks
    left = (after - before) * (gain.nats / max(float((after - before).sum()), 1e-300) if gain.rows else 0.0)
    out = Ceiling(left=float(left.sum()), rows=gain.rows, gain=gain)
    if gain.rows:
        out = replace(out, interval=_ends(out.left, sum_error(left)))
    if not outcome.found:
        return out
    won = before - _declared(outcome, gain.at)
    effects = float(won.sum())
    share = float(np.clip(effects / max(effects + out.left, 1e-300), 0.0, 1.0)) if effects > 0 else 0.0
    ends = None
    if len(won) >= FEWEST_BLOCKS and effects > 0:
        error = sum_error(won * (1.0 - share) - share * left) / (effects + out.left)
        low, high = _ends(share, error)
        ends = max(low, 0.0), min(high, 1.0)
    return replace(out, effects=effects, explained=share, explained_interval=ends)


def ceiling_content(found: Ceiling, outcome: Outcome) -> dict[str, Any]:
    """The key `flexible` of `diagnosis.json`.

    Args:
        found: What functions explain.
        outcome: What was concluded.
    """
    out: dict[str, Any] = {
        "why_not": found.why_not or None,
        "measured_on": "blocks of time left out",
        "explained": found.explained,
        "explained_90": _pair(found.explained_interval),
        "effects_nats": found.effects,
        "left_nats": found.left,
        "left_90": _pair(found.interval),
        "left": bool(found.rows),
        "rows": [
            {
                "row": r.row,
                "unit": r.unit,
                "rms": r.size,
                "nats": r.nats,
                "standard_error": r.error,
                "variables": list(r.variables),
            }
            for r in found.rows
        ],
    }
    out["sentence"] = " ".join(filter(None, (_explained(out, bool(outcome.found)), _left(out))))
    out["remedy"] = _remedy(out)
    return out


def wanted(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the functions are of, in words: `q and q_dot on force`."""
    if not rows:
        return "all that was measured"
    names = rows[0]["variables"][:_NAMED]
    every = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{every} on {rows[0]['row']}"


def ceiling_picture(outcome: Outcome, found: Ceiling) -> Figure | None:
    """What functions add to the row that they explain most of; None where nothing is left.

    Args:
        outcome: What was concluded.
        found: What functions explain.
    """
    if found.gain is None or not found.rows:
        return None
    row, at = found.rows[0], outcome.variables.columns
    names = tuple(name for name in row.variables if name in at)[:2]
    if not names:
        return None
    columns = {name: at[name] for name in names}
    axes = [np.linspace(float(v.min()), float(v.max()), _GRID[len(names)]) for v in columns.values()]
    mesh = np.meshgrid(*axes)
    places = {name: m.reshape(-1) for name, m in zip(names, mesh, strict=True)}
    mean, spread = found.gain.functions.force(places, row.port)
    data = np.stack(list(columns.values()), 1)
    eta = distance_from_data(data, np.stack(list(places.values()), 1))
    of, shape = variable_units(outcome.final.regression.vector.system), mesh[0].shape
    surface = Surface(
        row.row,
        row.unit,
        tuple((name, of.get(name, "")) for name in names),
        tuple(axes),
        mean.reshape(shape),
        np.sqrt(spread).reshape(shape),
        (eta > FAR).reshape(shape),
        data,
    )
    beside = "effects" if outcome.found else "the declared physics"
    return flexible_surface(surface, title=f"What functions add to {row.row} beside {beside}")


# ---- pieces -------------------------------------------------------------------------------------------


def _why_not(log: Log, outcome: Outcome) -> str:
    """Why functions would say nothing, in words; empty where they do."""
    if not log.budgets.function_groups:
        return "not asked for"
    if outcome.doubted:
        return "the fit is not believed"
    if log.recorded.inputs_restored:
        return "the inputs were logged as an average and know the future"
    if any(run.band for run in log.runs):
        return (
            "the states were smoothed before they were logged, and what that did to them looks like physics"
        )
    if outcome.final.regression.arithmetic:
        return "what is left is what arithmetic leaves"
    if outcome.optimum is not None and len(outcome.optimum.blocks) < FEWEST_BLOCKS:
        return "the log is too short"
    return ""


def _declared(outcome: Outcome, at: Optimum) -> Array:
    """Held-out log density of each block of time (B,) by the declared physics."""
    near = outcome.declared_optimum
    # rows that bring up memory first are not counted, which shifts blocks
    if near is None or not torch.equal(near.of.space.chunks.counted, at.of.space.chunks.counted):
        near = at
    with torch.no_grad():
        return held_out_density(optimum_of(outcome.declared_system, near))


def _ends(value: float, error: float) -> tuple[float, float]:
    return value - _HALF * error, value + _HALF * error


def _explained(own: Mapping[str, Any], found: bool) -> str:
    """How much of what can be explained the effects explain."""
    where = own["measured_on"]
    if own["why_not"]:
        return f"What functions could still explain was not measured: {own['why_not']}."
    if not found:
        return "" if own["left"] else f"Functions of what was measured explain nothing of {where}."
    if own["effects_nats"] <= 0:
        return (
            f"The effects bring no log-likelihood to {where} ({own['effects_nats']:+.1f} nats): evidence for them is "
            "in the data that they were fitted to alone."
        )
    if not own["left"]:
        return f"The effects explain all that functions of what was measured can, of {where}."
    ends = own["explained_90"]
    between = "" if ends is None else f" ({ends[0]:.0%} to {ends[1]:.0%})"
    share = f"{own['explained']:.0%}{between}"
    return f"The effects explain {share} of what can be explained of {where}, in log-likelihood."


def _left(own: Mapping[str, Any]) -> str:
    """What functions still explain."""
    if not own["left"]:
        return ""
    low, high = own["left_90"]
    row = own["rows"][0]
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    others = len(own["rows"]) - 1
    whole = f"{own['left_nats']:.1f} nats ({low:+.1f} to {high:+.1f})"
    most = f" with {others} other row{'s' if others > 1 else ''} of the ports" if others else ""
    return (
        f"Functions of {wanted(own['rows'])}{most} still explain {whole} there: {number(row['rms'])}{unit} rms; no "
        "formula that holds says why."
    )


def _remedy(own: Mapping[str, Any]) -> str | None:
    if not own["left"]:
        return None
    return (
        f"look for what depends on {wanted(own['rows'])}, and fly or drive these variables apart from each other; "
        "until it has a name, the networks of `nsde train model=nsde system.effects=effects.yaml` learn it, and their "
        "eta says where to trust them."
    )


def _pair(ends: tuple[float, float] | None) -> list[float] | None:
    return None if ends is None else list(ends)
