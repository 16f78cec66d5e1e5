"""What a diagnosis concluded: effects with their estimates, tests of the residuals, the verdict."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.feedback_bias import FeedbackBiased, lengths_of_parameters
from nsde_torch.diagnosis.joint_selection import Evidence, JointSelection
from nsde_torch.diagnosis.regressors import Measured, measured
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.diagnosis.search import Search, fitted_system, without_effect
from nsde_torch.diagnosis.shape import Rates, rates
from nsde_torch.effects.by_run import ByRun
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.inference import Optimum
from nsde_torch.inference.spread import Spread
from nsde_torch.sysid.feedback_test import FeedbackTest
from nsde_torch.sysid.identify import hidden_bias, largest_bias
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

# by whether the ends are those of the search
_BOUNDS: dict[tuple[bool, bool], Literal["below", "above"]] = {(True, False): "below", (False, True): "above"}


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect with its interval."""

    name: str  # `effect.parameter`, with an index where there are axes
    value: float  # estimate
    low: float | None
    high: float | None  # low, high: 90 % interval, inside the bounds; None where the data do not show it
    unit: str  # unit of all
    # `below` or `above` where that end alone is what the data say: the other one is the bound of the search;
    # `reference` of the median of sizes per input of which only differences can be shown
    bound: Literal["below", "above", "reference"] | None = None
    widened: float = 0.0
    """What its half-width is larger by than chance makes it: by what more data do not show."""
    run: str = ""  # name of the run that it is of; empty of what all runs share
    against: str = ""  # name of the run that this one is held against; empty where it has a number of its own


def estimated(
    regression: Regression, sure: Spread, columns: Sequence[int], doubt: Array | None = None
) -> list[Estimate]:
    """Parameters of a regression at its optimum, by number, with 90 % intervals from blocks of time.

    `doubt` is what half-widths are widened by (k,), nan for anything; None for nothing.
    """
    v, basis = regression.vector, regression.shown.basis
    error = np.sqrt(np.clip(np.diag(basis @ sure.covariance @ basis.T), 0.0, None))
    half = stdtrit(sure.degrees(basis).clip(1.0), 0.5 * (1 + INTERVAL_LEVEL)) * error
    half = np.where(regression.shown.known, half if doubt is None else half + doubt, np.nan)
    return [_inside(v, j, float(regression.theta[j]), half, doubt) for j in columns]


def of_identification(found: Identification, labels: Sequence[str]) -> list[Estimate]:
    """Estimates with 90 % intervals of an identification."""
    v, half = found.vector, found.half_widths(INTERVAL_LEVEL)
    columns = [v.labels.index(label) for label in labels]
    return [_inside(v, j, float(found.values[j]), half, found.doubt) for j in columns]


def _inside(v: ParameterVector, j: int, value: float, halves: Array, doubt: Array | None) -> Estimate:
    """A parameter with the interval of its half-width (k,) inside its bounds; without one where that is not finite."""
    half = float(halves[j])
    if not np.isfinite(half):
        relative = any(s.start <= j < s.stop and np.isfinite(halves[s]).any() for s in v.per_input)
        return Estimate(v.labels[j], value, None, None, v.units[j], "reference" if relative else None)
    low, high = float(max(value - half, v.low[j])), float(min(value + half, v.high[j]))
    if low <= v.low[j] and high >= v.high[j]:  # all that a search allows: 0.01 (0.01 to 0.94) m/s, a width
        return Estimate(v.labels[j], value, None, None, v.units[j])
    bound = _BOUNDS.get((low <= v.low[j], high >= v.high[j]))
    widened = 0.0 if doubt is None else float(doubt[j])
    return Estimate(v.labels[j], value, low, high, v.units[j], bound, widened)


_SHARED = 0.9
"""Share of a declared parameter's variance that the coefficients of a law explain, above which its form decides."""

Verdict = Literal["no_effect", "effect_found", "unexplained", "undecided"]


@dataclass(frozen=True)
class Found:
    """An effect that was added."""

    name: str  # of the effect
    evidence: Evidence  # beside all other effects that were added
    ties: tuple[str, ...]  # effects that explain the data as well in its place
    moves: tuple[str, ...] = ()  # names of the channels that its parameters move
    provisional: str = ""  # why it is provisional and not the last word; empty where it is


@dataclass(frozen=True)
class Refuted:
    """An effect that is not named because runs that it was not fitted to are surely likelier without it."""

    name: str  # of the effect
    nats: float  # by how much

    @property
    def reason(self) -> str:
        """Why, in words."""
        return f"runs that it was not fitted to are likelier without it, by {self.nats:.0f} nats"


@dataclass
class Outcome:
    """What was concluded."""

    verdict: Verdict
    """`no_effect`, `effect_found` or `unexplained`; `undecided` where what is left was not tested."""
    declared: Regression  # the declared physics, fitted, with what is shorter than a step
    final: Regression  # the physics with everything that was added, fitted
    found: list[Found]  # effects, in the order in which they were added
    joint: JointSelection | None  # what the joint likelihood selected; None where it could not be computed
    inputs: bool = True  # whether the inputs are what acted, and not restored from an average
    before: list[Dependence] = field(default_factory=list)
    after: list[Dependence] = field(default_factory=list)
    """before, after: what the residual depends on without and with the effects, all tests."""
    structured: list[Dependence] = field(default_factory=list)
    """The tests that remain significant after correction for their number, what explains most first."""
    # effects that are not named because feedback may have made them, or runs left out refute them
    hidden: tuple[FeedbackBiased | Refuted, ...] = ()
    test: FeedbackTest = field(default_factory=FeedbackTest)
    """What the data say of the loop that they were recorded in, by `final`."""
    known: frozenset[str] = frozenset()
    """Channels on which what is left depends most of all on inputs a moment before, and no more than they may know."""
    of_band: Array | None = None
    """How far parameters of `final` depend on the band up to which smoothed states were restored (k,)."""
    # estimates to print in place of those of `final`: by signals from outside the loop, or of largest likelihood
    printed: Identification | None = None
    levels: Mapping[str, float] = field(default_factory=dict)
    """Significance level of each stage (`recording.fault`)."""
    decisions: Decisions = DECISIONS  # what was decided by
    doubted: bool = False
    """Whether the guard speaks against the final physics, so that nothing that was found is sure."""
    doubted_channels: frozenset[str] = frozenset()
    """Channels that it speaks of, where that is not all: what moves them is not sure."""
    optimum: Optimum | None = None
    """Where the likelihood of the final physics is largest; None where it was not computed."""

    @cached_property
    def variables(self) -> Measured:
        """What the residuals with the effects may be drawn against."""
        return measured(self.final, inputs=self.inputs)

    @cached_property
    def rates(self) -> Rates:
        """Mean residual rates with the effects."""
        return rates(self.final, self.variables)

    @cached_property
    def declared_rates(self) -> Rates:
        """Mean residual rates without the effects."""
        return rates(self.declared, measured(self.declared, inputs=self.inputs))

    @property
    def aside(self) -> tuple[str, ...]:
        """Effects that joined what is declared because they are shorter than a step."""
        return () if self.joint is None else self.joint.aside

    @cached_property
    def system(self) -> System:
        """The physics with everything that was added and its values."""
        out = fitted_system(self.final)
        if self.printed is not None:
            self.printed.vector.write(out, self.printed.values)
        return out

    @cached_property
    def declared_system(self) -> System:
        """The declared physics and its fitted values; `system` where nothing was added."""
        return fitted_system(self.declared) if self.found else self.system

    def provisional(self, why: Callable[[Found], str]) -> "Outcome":
        """The outcome, each effect provisional for the reason that `why` gives, "" for none; the first one stays."""
        return replace(self, found=[replace(f, provisional=f.provisional or why(f)) for f in self.found])

    def without(self, effect: str) -> System:
        """The physics with everything that was added but one effect; the declared physics where that is all."""
        if len(self.found) == 1:
            return self.declared_system
        return without_effect(self.system, self.declared_system, effect)

    def estimates(self, effect: str) -> list[Estimate]:
        """Parameters of an effect that was added or joined what is declared, all others fitted with it."""
        found = self.estimated(self.final.vector.of(effect))
        own = next((e for e in self.final.vector.system.effects if e.name == effect), None)
        if not isinstance(own, ByRun):
            return found
        count = own.value(own.numbers()).numel()  # the first ones; what follows is the same in all runs
        each = [replace(e, run=own.run_of(k), against=own.reference) for k, e in enumerate(found[:count])]
        return each + found[count:]

    def estimated(self, columns: Sequence[int]) -> list[Estimate]:
        """Parameters of `final` with 90 % intervals, which feedback widens where it may hide something."""
        if self.printed is None:
            return estimated(self.final, self.spread, columns, self.doubt)
        printed = self.printed
        if printed.instrumented is None:  # what feedback may hide is asked for when it is printed
            printed = replace(printed, doubt=self.doubt)
        return of_identification(printed, [self.final.vector.labels[j] for j in columns])

    @property
    def unsettled(self) -> bool:
        """Whether the fit that estimates by instruments rest on had not settled, so that none has an interval."""
        doubt = None if self.printed is None else self.printed.doubt
        return doubt is not None and bool(np.isnan(doubt).all())

    @cached_property
    def doubt(self) -> Array:
        """By how much feedback may have biased each parameter of `final` (k,); nan for by anything.

        Effects that were found are biased by what was made from other sensors alone, as in `feedback_bias.allowances`.
        """
        r, found = self.final, {f.name for f in self.found}
        of_effects = np.array([label.partition(".")[0] in found for label in r.vector.labels], dtype=bool)
        by_sensors = largest_bias(r, lengths_of_parameters(self.test, r))
        bias = np.where(of_effects, by_sensors, hidden_bias(r, self.test))
        return bias if self.of_band is None else np.maximum(bias, self.of_band)

    @cached_property
    def given_laws(self) -> dict[str, tuple[str, ...]]:
        """By label of a declared parameter: sure laws beyond the catalogue whose form its value hangs on.

        Data show the sum of a loss to the surroundings and a law of the same temperature; how it is shared out is the
        formula's. Of an oven that radiates the loss was 38 standard errors off beside `c1 expm1(k1 temp)`.
        """
        out = dict[str, tuple[str, ...]]()
        if self.joint is None:
            return out
        best, declared = self.joint.final.best, {*self.declared.vector.labels}
        covariance, free = best.spread.covariance, [best.vector.labels[j] for j in best.free]
        for law in [f.name for f in self.found if is_law(f.name) and not f.provisional]:
            own = [k for k, label in enumerate(free) if label.startswith(f"{law}.")]
            within = np.linalg.pinv(covariance[np.ix_(own, own)], hermitian=True)
            for k, label in enumerate(free):
                share = covariance[k, own] @ within @ covariance[k, own]
                if label in declared and share > _SHARED * covariance[k, k]:
                    out[label] = (*out.get(label, ()), law)
        return out

    @cached_property
    def spread(self) -> Spread:
        """Cluster-robust covariance of the parameters of `final`."""
        return self.final.spread()


def found_by(search: Search, joint: JointSelection) -> list[Found]:
    """The effects of a selection, in the order in which they were added."""
    return [
        Found(name, joint.evidence(search, name), (*one.ties, *([one.law] if one.law else [])))
        for name, one in joint.selected.items()
    ]


def undecided(
    search: Search,
    declared: Regression,
    final: Regression,
    found: Sequence[Found] = (),
    joint: JointSelection | None = None,
) -> Outcome:
    """What is known before what is left is tested."""
    return Outcome(
        "undecided",
        declared,
        final,
        list(found),
        joint,
        inputs=search.inputs,
        test=FeedbackTest(why_not="not done yet"),
        levels=search.levels(),
        decisions=search.decisions,
    )
