"""What an identification found."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import stdtrit

from nsde_torch.arrays import Array, Mask
from nsde_torch.inference import MaximumLikelihood, Optimum
from nsde_torch.sysid.feedback_test import FACTOR, FeedbackTest
from nsde_torch.sysid.guard import Guarded, of_longer_boxes
from nsde_torch.sysid.instruments import Instrumented, adopted
from nsde_torch.sysid.physics import Channel
from nsde_torch.sysid.regression import Shown, sentences
from nsde_torch.sysid.standstill import in_words
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.texts import rendered


@dataclass(frozen=True)
class Identification:
    """Declared parameters as the data show them."""

    vector: ParameterVector  # names, units, bounds
    method: str  # "weak" or "differences"
    values: Array  # estimate (k,), inside the bounds
    covariance: Array  # of the estimate (k, k); nothing along what the data do not show
    degrees: Array  # degrees of freedom of each variance (k,)
    shown: Shown  # what the data show
    channels: tuple[Channel, ...]  # one entry per channel that depends on a parameter
    sensor_std: Array  # white noise of each state (nx,)
    unexplained: float
    """Root mean square of residuals over that of the rates, each block predicted without its own data."""
    width_s: float  # length of the test functions of `channels` [s]
    box_s: float  # length of the boxes that the equations were integrated over [s]
    iterations: int  # steps of the iteration
    converged: bool  # whether its last step was a fiftieth of a standard error at most
    linear: bool  # whether the drift is linear in the parameters
    blocks: int  # number of blocks of time that the covariance comes from
    loop: FeedbackTest | None = None  # test of the loop; None where it was not asked for
    instrumented: Instrumented | None = None  # what instruments say; None without any
    # what half-widths are widened by, because feedback may have biased the estimate (k,), nan for anything; None for
    # nothing
    doubt: Array | None = None
    guard: Guarded | None = None  # how the fit stands beside simple ones; None where it was not asked for
    finer: "Identification | None" = None
    """The fit over shorter boxes that the guard rejected; None where these are the first ones."""
    standstill: float = 0.0
    """Share of the rows that were left out because what has dry friction stands in them."""
    # the fit of largest likelihood, whose values these are where nothing speaks against it; None where there was none
    likelihood: MaximumLikelihood | None = None
    optimum: Optimum | None = field(default=None, repr=False, compare=False)
    """Where that is, for networks to begin at."""

    @property
    def likelihood_used(self) -> bool:
        """Whether values and intervals are those of largest likelihood."""
        return self.likelihood is not None and not self.likelihood.objections

    @property
    def believed(self) -> bool:
        """Whether it has settled and nothing speaks against it."""
        return self.converged and not (self.guard is not None and self.guard.objections)

    @property
    def standard_errors(self) -> Array:
        """Standard error of each parameter (k,); nan where the data do not show it, or it is not reliable."""
        known = self.shown.known & self.believed
        return np.where(known, np.sqrt(np.diag(self.covariance).clip(0.0)), np.nan)

    def half_widths(self, level: float) -> Array:
        """Half-widths of the intervals of this level (k,); nan where there is no standard error."""
        by_chance = stdtrit(self.degrees.clip(1.0), 0.5 * (1 + level)) * self.standard_errors
        return np.asarray(by_chance if self.doubt is None else by_chance + self.doubt)

    @property
    def of_the_loop(self) -> list[str]:
        """What was found of feedback and by instruments, in words."""
        out = [] if self.loop is None else self.loop.findings
        moved = None
        if self.instrumented is not None and self.loop is not None:
            printed = adopted(self.instrumented, self.loop)
            moved = self.instrumented.moved if printed else None
            out += self.instrumented.findings(printed)
        if self.finer is not None:  # widened by what changes with the boxes too, which a warning says
            return out
        return [*out, *self._widened(moved)]

    def _widened(self, moved: Mask | None) -> list[str]:
        """Which intervals are widened by what the data cannot show, and why; `moved` are those by instruments."""
        labels, doubt, errors = self.vector.labels, self.doubt, self.standard_errors
        if doubt is None:
            return []
        wide = [i for i in range(len(labels)) if errors[i] == errors[i] and doubt[i] > 0.5 * errors[i]]
        by = [labels[i] for i in wide if moved is not None and moved[i]]
        rest = [labels[i] for i in wide if moved is None or not moved[i]]
        return rendered(__file__, "widened.txt", by=by, rest=rest, factor=FACTOR).splitlines()

    @property
    def findings(self) -> list[str]:
        """What the data cannot show, and what they hardly show, in words."""
        v = self.vector
        out = sentences(self.shown, v.labels, v.units, v.scale)
        half = self.half_widths(0.95)
        room = v.high - v.low
        for i in np.flatnonzero(np.isfinite(half) & (2 * half > room)):
            out.append(
                f"{v.labels[i]}: hardly shown; its 95 % interval is wider than its bounds "
                f"({v.low[i]:g} to {v.high[i]:g} {v.units[i]})"
            )
        if not self.converged:
            out.append(f"the iteration had not settled after {self.iterations} steps: no interval is given")
        return out

    @property
    def warnings(self) -> list[str]:
        """What speaks against the fit, in words, with what the guard noted beside it."""
        notes = [] if self.guard is None else list(self.guard.notes)
        if self.finer is not None and self.finer.guard is not None:
            return [of_longer_boxes(self.box_s, self.finer.guard), *notes]
        if self.guard is None or not self.guard.objections:
            return []
        told = [str(objection) for objection in self.guard.objections]
        return [*told, *notes, "the fit is not reliable: no interval is given"]

    @property
    def notes(self) -> list[str]:
        """What was left out, and what the guard noted of a fit that nothing speaks against."""
        left_out = in_words(self.standstill)
        return left_out if self.guard is None or self.warnings else [*left_out, *self.guard.notes]

    def parameters(self) -> dict[str, dict[str, object]]:
        """Declared parameters as `metrics.json` holds them."""
        half = _finite(self.half_widths(0.9))
        why = "something speaks against the fit" if self.converged else "the fit had not settled"
        unknown = np.zeros(len(self.values), dtype=bool) if self.doubt is None else np.isnan(self.doubt)
        out: dict[str, dict[str, object]] = {}
        for p in self.vector.places:
            value = self.values[p.columns].tolist()
            out[p.name] = {"value": value, "half_width_90": half[p.columns], "unit": p.unit}
            if not self.believed:
                out[p.name]["note"] = f"no interval: {why}"
            elif unknown[p.columns].any():
                out[p.name]["note"] = "no interval: in a closed loop whose inputs add little to the states"
        return out

    def as_dict(self) -> dict[str, Any]:
        v, errors, half = self.vector, _finite(self.standard_errors), _finite(self.half_widths(0.95))
        each = {
            label: {
                "value": float(self.values[i]),
                "unit": v.units[i],
                "standard_error": errors[i],
                "interval_95": None if h is None else [float(self.values[i] - h), float(self.values[i] + h)],
                "degrees_of_freedom": float(self.degrees[i]),
            }
            for i, (label, h) in enumerate(zip(v.labels, half, strict=True))
        }
        finer, doubt = self.finer, self.doubt
        asked_for = {
            "standing_share": self.standstill or None,
            "guard": self.guard and self.guard.as_dict(),
            "finer": finer and finer.guard and {"box_s": finer.box_s, "guard": finer.guard.as_dict()},
            "likelihood": self.likelihood and self.likelihood.as_dict(),
            "feedback": self.loop and self.loop.as_dict(),
            "instruments": self.instrumented and self.instrumented.as_dict(),
            "feedback_may_bias_by": doubt
            if doubt is None
            else dict(zip(v.labels, _finite(doubt), strict=True)),
        }
        return {
            "method": self.method,
            "linear": self.linear,
            "iterations": self.iterations,
            "converged": self.converged,
            "rank": self.shown.rank,
            "parameters": len(v),
            "condition_number": self.shown.condition,
            "blocks": self.blocks,
            "box_s": self.box_s,
            "estimates": each,
            "not_shown": self.findings,
            "channels": {c.name: c.as_dict() for c in self.channels},
            "test_function_s": self.width_s,
            "unexplained": self.unexplained,
            **{name: part for name, part in asked_for.items() if part is not None},
        }


def _finite(values: Array) -> list[float | None]:
    """Values for JSON, where null is anything or nothing known."""
    return [v if np.isfinite(v) else None for v in values.tolist()]
