"""Every number that a diagnosis decides by, with its meaning and its source, and the settings that a user has.

`Decisions` may change what is found, `Wording` how it is described, `Budgets` how long it takes and nothing else.
Differences of log-likelihood are in nats. Numerical tolerances stand in the module that needs them, and so do the
functions that residuals are tested against (`regressors`, `periodicity`, `residual_tests`): they say what is looked
for, and not what counts as found. Where a field names no source, the number was chosen here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key

INTERVAL_LEVEL = 0.9  # level of all intervals; no field, as the keys of `diagnosis.json` are named after it


@documented
@dataclass(frozen=True)
class Wording:
    """How a dependence is described. Changes no verdict and no name of an effect."""

    odd_share: float = key(0.8, "share by odd functions above which a dependence is odd", low=0.5, high=1)
    even_share: float = key(0.2, "share by odd functions below which it is even", low=0, high=0.5)
    local_power: float = key(
        0.7, "share of the squared bin means that a local dependence has in one part of the range", high=1
    )
    local_range: float = key(0.3, "share of the range that this part may be", high=1)
    one_run_share: float = key(
        0.8, "share of the log-likelihood in one run that makes it a matter of that run"
    )
    holds_share: float = key(0.5, "share of the prediction that must hold elsewhere to be the same there")
    holds_errors: float = key(2.0, "slack of this, what is measured may be low", unit="standard errors")
    sine_factor: float = key(2.0, "times the log-likelihood of a cubic that a periodic dependence must bring")
    sine_angle_factor: float = key(1.1, "the same where the period is a whole part of a turn of an angle")
    sine_nats: float = key(15.0, "least log-likelihood of a periodic dependence", unit="nat")
    sine_parts: int = key(3, "parts of the range in all of which a period must hold", low=2)
    whole_tolerance: float = key(0.1, "relative distance from a whole number that counts as whole")
    same_phase: float = key(
        0.8, "length of the mean phase of a sinusoid, over runs, from which it is the same"
    )
    few_share: float = key(
        0.95,
        "share of the improvement by all effects on runs left out that those listed first reach together",
        high=1,
    )

    def __post_init__(self) -> None:
        check(type(self), vars(self))


@documented
@dataclass(frozen=True)
class Decisions:
    """What counts as found, as alike, as unexplained, as provisional."""

    # ---- error rates ------------------------------------------------------------------------------------
    alpha: float = key(
        0.01, "chance of naming anything where nothing is missing, of all stages (convention)", above=0
    )
    nested_alpha: float = key(
        1e-3,
        "chance above which what contains a simpler effect stands behind it (likelihood-ratio test)",
        above=0,
    )

    # ---- evidence between models ------------------------------------------------------------------------
    alike_nats: float = key(
        3.0,
        "held-out log-likelihood difference within which two candidates, or one and none, are indistinguishable",
        unit="nat",
    )
    alike_errors: float = key(2.0, "the same in its standard errors (Vuong 1989)", unit="standard errors")
    wider_nats: float = key(
        2.0, "nats by which two effects must be better than one that contains one of them", unit="nat"
    )
    most_effects: int = key(8, "most effects to add", low=0)

    # ---- noise models -----------------------------------------------------------------------------------
    noise_memory: float = key(
        1.0, "longest memory of a noise model; what lasts longer is structure", unit="s", above=0
    )
    apart_s: float = key(
        0.05,
        "time between rows that are looked at alone where the innovations of all rows can be predicted",
        unit="s",
    )
    apart_share: float = key(
        0.5, "share of how far innovations of all rows are off, within which those of rows apart have to be"
    )

    # ---- resolution -------------------------------------------------------------------------------------
    resolution: float = key(
        0.5, "shortest lag or delay that is named; below, how inputs are held decides", unit="steps"
    )
    least_periods: float = key(
        1.5,
        "fewest periods of a sinusoid in the longest stretch, or of a ripple in the range of its angle",
        unit="periods",
    )

    # ---- folds and blocks of time -----------------------------------------------------------------------
    folds: int = key(10, "most groups of whole runs that evidence is measured on in turn", low=2)
    fewest_runs: int = key(
        3, "fewest runs of which whole ones are left out, or one can be the odd one", low=2
    )
    folds_stretches: int = key(5, "stretches of each run instead, of one run or two", low=2)
    refit_folds: int = key(5, "most groups of whole runs that all parameters are fitted again without", low=2)
    refit_tail: float = key(0.3, "share of a single run that is left out instead", above=0, high=0.9)
    blocks_per_function: int = key(2, "fewest blocks of time for each function of a test by blocks", low=1)
    blocks_beyond: int = key(4, "fewest blocks beside these", low=2)
    step_blocks: int = key(20, "blocks of time that short data are cut into for one-step densities", low=2)
    step_block_shortest: float = key(1.0, "shortest of these blocks", unit="s", above=0)
    step_block_longest: float = key(4.0, "longest of these blocks", unit="s", above=0)
    replay_block: float = key(4.0, "blocks of time for errors of open-loop predictions", unit="s", above=0)
    replay_finite_share: float = key(
        0.9, "share of open-loop predictions that must stay finite for a horizon to be reported", high=1
    )

    # ---- specification tests ----------------------------------------------------------------------------
    odd_run_prior: float = key(
        8.0, "differences between runs that unit variance counts as (Smyth 2004)", unit="degrees of freedom"
    )
    moments_fewest: int = key(20, "fewest bumps in time of which the largest is tested", low=2)

    # ---- laws beyond the catalogue ----------------------------------------------------------------------
    # without it five terms of one speed are named for a surface that none is (the public drive EMPS: the first wins
    # 0.2 of what functions do, the others 0.1 to 0.16; true laws of blind springs and carts 1.0 to 1.4)
    law_share: float = key(0.18, "share of the functions' evidence that a law has to explain", low=0)

    # ---- verdict ----------------------------------------------------------------------------------------
    provisional_share: float = key(
        0.1,
        "share of what effects bring to its channels, or it alone brings, above which structure, or what functions "
        "explain, makes one provisional",
    )
    # without it the damping of two stops is 0, surely, and dry friction that begins at 11 s is 39 % too small beside a
    # drift of the damping, both surely (160 times white noise left)
    far_above_noise: float = key(
        10.0, "times white noise that is left, from which sizes at bounds and drifts are doubted", low=1
    )

    # ---- what could not be detected ---------------------------------------------------------------------
    detectable_errors: float = key(
        4.0, "minimum detectable effect among tens of candidates at alpha 0.01", unit="standard errors"
    )
    detectable_share: float = key(
        0.25, "share of the usual size of an effect that it may be before the effect is listed as not shown"
    )
    detectable_never: float = key(1e3, "times the usual size from which it is as good as infinite")

    # ---- declared parameters ----------------------------------------------------------------------------
    bound_errors: float = key(
        3.0, "distance beyond its bound that the data pull a parameter to warn of it", unit="standard errors"
    )
    bound_sizes: float = key(0.01, "the same in typical sizes of the parameter", unit="typical sizes")
    far_powers: float = key(
        3.0, "distance of an identifiable parameter from its first value to warn of it", unit="powers of ten"
    )
    lost_powers: float = key(1.5, "the same of one that the data do not show", unit="powers of ten")

    wording: Wording = field(default_factory=Wording)

    def __post_init__(self) -> None:
        check(type(self), {k: v for k, v in vars(self).items() if k != "wording"})

    def at_pace(self, pace: float) -> Decisions:
        """The same with its times for machines of a pace (`nsde_torch.data.pace`)."""
        times = (one.name for one in fields(self) if one.metadata.get("unit") == "s")
        return replace(self, **{name: pace * getattr(self, name) for name in times})


@documented
@dataclass(frozen=True)
class Budgets:
    """How much is tried. More takes longer; a verdict that it changes is a fault."""

    iterations: int = key(20, "most iterations of a regression from its first values", low=1)
    noise_nats: float = key(1.0, "nats by which another noise model must be likelier to be tried", low=0)
    exchanges: int = key(12, "looks at the catalogue beyond which no effect is exchanged any more", low=1)
    spectral_lines: int = key(3, "lines of the spectrum that fits of a sinusoid start from", low=1)
    closer_chance: float = key(0.05, "chance above which one run alone gets no closer look", above=0, high=1)
    shapes: int = key(6, "dependences that are described in words", low=0)
    law_variables: int = key(
        4, "most variables of a row of a port that laws are tried of, of those that functions are of", low=1
    )
    laws_fitted: int = key(4, "terms that are fitted to the end, of which the best is a law", low=1)
    laws: int = key(4, "most laws beyond the catalogue; 0: none are tried", low=0)
    function_groups: int = key(
        4, "most groups of functions on one row of a port, of what effects leave; 0: none are tried", low=0
    )

    def __post_init__(self) -> None:
        check(type(self), vars(self))


DECISIONS, BUDGETS = Decisions(), Budgets()  # what is used where nothing else is said


@documented
@dataclass(frozen=True)
class Options:
    """Settings of a diagnosis."""

    alpha: float = key(DECISIONS.alpha, "chance of naming anything where nothing is missing", above=0)
    max_effects: int = key(DECISIONS.most_effects, "most effects to add", low=0)
    candidates: tuple[str, ...] | None = key(
        None, "effects to try, by name; null: all that the system may have"
    )
    also: tuple[str, ...] = key((), "effects of your own to try beside them, `module:Class`")
    seed: int = key(0, "seed of the resamples", low=0)
    max_minutes: float | None = key(
        None,
        "time after which the diagnosis ends with what is known; null: none. Training does not count",
        unit="min",
        above=0,
    )
    instruments: tuple[str, ...] = key(
        (), "logged columns that nothing inside the control loop moves: sticks, setpoints"
    )

    @property
    def decisions(self) -> Decisions:
        """What a diagnosis with these settings decides by."""
        return Decisions(alpha=self.alpha, most_effects=self.max_effects)

    def __post_init__(self) -> None:
        check(type(self), vars(self))
        if not 0 < self.alpha <= 0.5:
            raise ConfigError(f"`alpha` must lie in (0, 0.5]; got {self.alpha!r}.")
