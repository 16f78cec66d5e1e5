"""Logs whose rates no sensor measured: their columns are missing, or were made of the positions (`derived`).

Rates are inferred from the positions (`nsde_torch.data.tracking`), and marked (`Run.inferred`): identification and
diagnosis infer them again, with the physics (`nsde_torch.sysid.inferred_rates`), and take equations of the positions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, changed, rate_pairs
from nsde_torch.data.tracking import rates
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.derived import derived_rates

POLICIES = ("infer", "keep")


def to_infer(system: SystemInfo, raw: Sequence[RawRun], *, policy: str, report: Report) -> tuple[str, ...]:
    """Rates to infer; their columns hold something to go on with until `inferred` fills them.

    Args:
        system: Names and derivative pairs.
        raw: Recordings in the order of time.
        policy: "infer", or "keep" for derived columns as they are.
        report: Takes what was found.

    Raises:
        ConfigError: an unknown policy.
        DataError: a rate is missing in some runs only.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`derived_rates` must be {' or '.join(POLICIES)}; got {policy!r}.")
    without = {run.name: _without(system, run) for run in raw}
    absent = {name for names in without.values() for name in names}
    for name in sorted(absent):
        lacking = [run for run, names in without.items() if name in names]
        if len(lacking) < len(raw):
            raise DataError(
                f"run {lacking[0]!r} has no value of {name!r} and others have; leave it out of all of them, and it is "
                "inferred from the position, or read the runs apart."
            )
    if absent:
        report(
            Finding(
                "no_rate",
                "",
                len(absent),
                f"no column {', '.join(sorted(absent))}: inferred from the positions, of which alone a fit and a "
                "diagnosis make their equations",
                "inferred",
                {"states": sorted(absent)},
            )
        )
    found = [one for one in derived_rates(system, raw) if one.rate not in absent]
    for one in found:
        what = f"{one.rate} is {one.how} {one.position}, and no sensor's: it knows nothing that {one.position} does not"
        done = {
            "infer": f"taken out, and inferred from {one.position} alone; `data.derived_rates=keep` takes it as it is",
            "keep": "kept as it is: errors of fits are too small, and friction is found wrong",
        }[policy]
        report(
            Finding(
                "derived_rate",
                "",
                1,
                f"{what}; {done}",
                "inferred" if policy == "infer" else "reported",
                {"state": one.rate, "position": one.position, "how": one.how.removesuffix(" of")},
            )
        )
    names = absent | ({one.rate for one in found} if policy == "infer" else set())
    for run in raw if names else ():
        run.x = run.x.copy()
        for i, j in _pairs(system, names):
            q, good = run.x[:, i], np.isfinite(run.x[:, i])
            if good.sum() < 2:
                continue  # `missing` says what is wrong
            filled = np.interp(run.t, run.t[good], q[good])
            filled = np.unwrap(filled) if system.state_units[i] == "rad" else filled
            run.x[:, j] = np.where(good, rates([filled], float(np.median(np.diff(run.t))))[0][0], np.nan)
    return tuple(name for name in system.state_names if name in names)


def measured_part(system: SystemInfo, names: Collection[str]) -> SystemInfo:
    """The system as checks of kinematics see it: a rate that was inferred says nothing of its position."""
    if not names:
        return system
    pairs = tuple(pair for pair in system.position_derivatives if pair[1] not in names)
    return changed(system, position_derivatives=pairs)


def inferred(system: SystemInfo, runs: Sequence[Run], names: Collection[str], clock: float) -> list[Run]:
    """Runs with rates inferred from positions without any physics.

    Args:
        system: Names and derivative pairs.
        runs: Recordings on one step.
        names: Rates to infer.
        clock: Physical seconds per logged second.
    """
    if not names:
        return list(runs)
    states, unknown = [np.array(run.x) for run in runs], {}
    for i, j in _pairs(system, names):
        places = [(x, a, b) for run, x in zip(runs, states, strict=True) for a, b in run.segments]
        found, unknown[system.state_names[j]] = rates([x[a:b, i] for x, a, b in places], runs[0].dt * clock)
        for (x, a, b), values in zip(places, found, strict=True):
            x[a:b, j] = values
    return [replace(run, x=x, inferred=unknown) for run, x in zip(runs, states, strict=True)]


def _without(system: SystemInfo, run: RawRun) -> set[str]:
    """Rates of positions without any value in a run."""
    if system.quaternion is not None:
        return set()
    empty = np.asarray(np.isnan(run.x).all(axis=0))
    return {system.state_names[j] for i, j in rate_pairs(system) if empty[j] and not empty[i]}


def _pairs(system: SystemInfo, names: Collection[str]) -> list[tuple[int, int]]:
    return [(i, j) for i, j in rate_pairs(system) if system.state_names[j] in names]
