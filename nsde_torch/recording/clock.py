"""What to do about a clock that disagrees with the kinematics: `trust`, `rescale` or `refuse`."""

from __future__ import annotations

from collections.abc import Sequence

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.kinematics import Pooled, Slope, called, pool
from nsde_torch.errors import ConfigError, DataError

POLICIES = ("rescale", "trust", "refuse")
MIN_DEPARTURE = 0.01
"""Departure of the clock from 1 below which it is right for all purposes."""
SIGNIFICANT = 3.0
"""Standard errors by which every group of axes must depart from 1, to the same side."""
SURE = 0.02
"""Largest standard error of a scale that rows are rescaled by without being asked."""
IMPLAUSIBLE = (0.5, 2.0)
"""Slopes outside cannot be a clock: the columns hold other units, signs or frames."""

_CAUSES = (
    (57.29578, "degrees where radians are expected (the angle)", 0.15),
    (1 / 57.29578, "degrees where radians are expected (the rate)", 0.15),
    (-1.0, "the opposite sign or another frame (NED where ENU is expected)", 0.2),
    (1000.0, "mm or ms where m or s are expected", 0.15),
    (0.001, "mm or ms where m or s are expected", 0.15),
    (1e-6, "microseconds where seconds are expected", 0.15),
    (3.28084, "feet and metres mixed", 0.05),
    (0.3048, "feet and metres mixed", 0.05),
)


def _cause(value: float) -> str:
    for factor, text, tolerance in _CAUSES:
        if abs(value / factor - 1.0) < tolerance:
            return text
    return "other units, signs or frames, or the velocity belongs to another position"


def check_units(slopes: Sequence[Slope], names: tuple[str, ...]) -> None:
    """Refuses pairs of columns that cannot be a position and its rate.

    Raises:
        DataError: the slope of a well-excited axis is far from 1.
    """
    for slope in slopes:
        low, high = IMPLAUSIBLE
        sure = slope.error < 0.1 * abs(slope.value) and slope.r2 > 0.5
        if sure and not low <= slope.value <= high:
            raise DataError(
                f"run {slope.run!r}: {slope.axis!r} ({slope.group}) changes {slope.value:.4g} times as fast "
                f"as its rate says (standard error {slope.error:.2g}, {slope.intervals} intervals). Likely "
                f"cause: {_cause(slope.value)}. All columns are SI, ENU world, FLU body, radians: "
                f"{', '.join(names)}."
            )


def by_group(slopes: Sequence[Slope]) -> dict[str, Pooled]:
    """Slopes joined for each group of axes."""
    groups = sorted({s.group for s in slopes})
    return {g: pool([s for s in slopes if s.group == g]) for g in groups}


def decide(slopes: Sequence[Slope], *, policy: str, report: Report) -> float:
    """The clock scale of a data set: physical seconds for each logged second.

    A wrong clock shows in every group of axes (positions and attitude) on the same side. Where only one group
    disagrees, its velocity is at fault, not the clock; that is reported and nothing is scaled.

    Args:
        slopes: Slopes of all axes of all runs.
        policy: `rescale` returns the measured scale where it differs from 1; `trust` returns 1 and reports;
            `refuse` raises.
        report: Takes the findings.

    Raises:
        ConfigError: an unknown policy.
        DataError: the clock is wrong and the policy is `refuse`.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`clock` must be one of {', '.join(POLICIES)}; got {policy!r}.")
    groups = by_group(slopes)
    if not groups:
        return 1.0
    total = pool(slopes)
    axes = {g: list(dict.fromkeys(s.axis for s in slopes if s.group == g)) for g in groups}
    text = ", ".join(f"{called(g, axes[g])}: {p.value:.4f} +- {p.error:.4f}" for g, p in groups.items())
    values = {
        "scale": total.value,
        "standard_error": total.error,
        "spread": total.spread,
        "groups": {g: p.value for g, p in groups.items()},
    }
    off = {g: p for g, p in groups.items() if abs(p.value - 1) > max(MIN_DEPARTURE, SIGNIFICANT * p.error)}
    if not off:
        return 1.0
    sides = {p.value > 1 for p in off.values()}
    clock_like = (
        IMPLAUSIBLE[0] <= total.value <= IMPLAUSIBLE[1]
    )  # a log that stands still has a slope of nothing
    if len(off) < len(groups) or len(sides) > 1 or total.error > SURE or not clock_like:
        report(
            Finding(
                "kinematic_mismatch",
                "",
                len(off),
                f"position and velocity disagree in {', '.join(called(g, axes[g]) for g in off)} but not in every "
                f"group, or not surely enough to blame the clock ({text})",
                "reported",
                values,
            )
        )
        return 1.0
    message = (
        f"the logged clock runs wrong: one logged second holds {total.value:.4f} +- {total.error:.4f} "
        f"physical seconds by the kinematics ({text})"
    )
    if sum(map(len, axes.values())) == 1:
        (axis,) = next(iter(axes.values()))
        scaled = f"or the rate of {axis} is {1 / total.value:.4g} times too large"
        message += f"; {scaled}: a single position and its rate cannot tell"
    if policy == "refuse":
        raise DataError(
            f"{message}. Set `clock` to `rescale` (use the measured scale) or `trust` (keep the logged "
            "time), or correct the time column."
        )
    if policy == "trust":
        report(Finding("clock", "", 1, message, "reported", values))
        return 1.0
    report(Finding("clock", "", 1, message, "rescaled", values))
    return total.value


def of_runs(slopes: Sequence[Slope], runs: Sequence[str], *, measured: float) -> float:
    """Clock scale as some runs alone show it: what a model may know that is to be tested on the others.

    Args:
        slopes: Slopes of all axes of all runs of a data set.
        runs: Names of the runs that may be looked at.
        measured: Scale of the whole data set; 1 says that nothing is to be scaled.

    Returns:
        Physical seconds for each logged second; `measured` where slopes were taken over several short runs
        together and none is of these runs alone.
    """
    own = [s for s in slopes if s.run in set(runs)]
    if measured == 1.0 or not own:
        return measured
    return decide(own, policy="rescale", report=lambda finding: None)
