"""Rates that no sensor measured: their columns are missing, or somebody differentiated the position column.

Rates are inferred from the positions (`nsde_torch.data.kinematics`), and marked (`Run.inferred`): identification and
diagnosis infer them again, with the physics (`nsde_torch.sysid.identify`), and take equations of the positions.

A rate v that was made of the position q by a linear filter, v = W q, holds the noise of q as W lets it through. From
the rate of a sensor of its own, the best filter of q stays away by that noise at least,

    mean (v - W q)^2  >=  s^2 sum_j w_j^2,          s the noise of q, w the weights of W

with s^2 = mean (D^4 d)^2 / 252, d_k = q_{k+1} - q_k - h (v_k + v_{k+1}) / 2: what q does and the rate does not. Where
there is none (a noiseless simulation, positions that were smoothed) nothing is said. Plain differences are recognised
by their numbers: q and v agree on them far better than on a formula that is nearer to the derivative.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from nsde_torch.arrays import Array
from nsde_torch.data.kinematics import rates
from nsde_torch.data.raw import Finding, RawRun, Report
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, changed, rate_pairs
from nsde_torch.errors import ConfigError, DataError

POLICIES = ("infer", "keep")
SHARE = 0.1
"""Share of the noise that a filter of the position would bring, below which it is what made the rate; sensors of their
own have 0.8 and more."""
PLAIN = 0.1  # share of the difference to a better formula, below which a rate is a plain difference
_REACHES = (15, 60)  # rows to either side that filters are looked for in
_FEWEST = 20  # rows for each weight, at least
_MOST = 6000  # rows that are looked at
_WHITE = 2.5  # times the square of differences grows with their order, from which on they are of noise (3.7)
_KEPT, _KEPT_SQUARE = 0.95, 0.759  # share of values that count, and the mean square of these of normal ones
_ROUNDING = 1e-12  # of how far a position moves: noise below is that of numbers
_EVEN = 1e-3  # of the step, within which times are even


def derived_rates(system: SystemInfo, runs: Sequence[RawRun]) -> list[tuple[str, str, str]]:
    """Rates that are made of positions: both names and how, in words that follow "is".

    Of machines that turn freely none are looked for.
    """
    if system.quaternion is not None:
        return []
    names, out = system.state_names, []
    for i, j in rate_pairs(system):
        parts = [part for run in runs for part in _stretches(run, i, j, system.state_units[i] == "rad")]
        if sum(len(t) for t, _, _ in parts) < 200 or not any(np.ptp(v) for _, _, v in parts):
            continue  # too few, or a rate that stands still, of which `standstill` speaks
        found = (_plain(parts) if _raw(parts) else None) or _filtered(parts)
        if found is not None:
            out.append((names[j], names[i], found))
    return out


def _stretches(run: RawRun, i: int, j: int, angle: bool) -> list[tuple[Array, Array, Array]]:
    """Times, positions and rates (n,) of stretches without a hole."""
    good = np.isfinite(run.x[:, i]) & np.isfinite(run.x[:, j])
    steps = np.diff(run.t)
    step = float(np.median(steps)) if len(steps) else 1.0
    cuts = np.flatnonzero(~good[1:] | ~good[:-1] | (steps > 2.5 * step)) + 1
    out = []
    for rows in np.split(np.arange(len(run.t)), cuts):
        if len(rows) > 20 and good[rows].all():
            q = np.unwrap(run.x[rows, i]) if angle else run.x[rows, i]
            out.append((run.t[rows], q, run.x[rows, j]))
    return out


def _square(parts: Sequence[Array]) -> float:
    """Mean square of normal values, without the largest: single samples that are off are no noise."""
    squares = np.sort(np.square(np.concatenate(parts)))
    return float(squares[: max(round(_KEPT * len(squares)), 1)].mean()) / _KEPT_SQUARE


def _raw(parts: Sequence[tuple[Array, Array, Array]]) -> bool:
    """Whether positions hold the white noise of a sensor; smoothed ones have no noise that a rate could be rid of."""
    fifth, sixth = (_square([np.diff(q, n) for _, q, _ in parts]) for n in (5, 6))
    size = max(float(np.std(q)) for _, q, _ in parts)
    return sixth > _WHITE * fifth > 252.0 * (_ROUNDING * size) ** 2


def _plain(parts: Sequence[tuple[Array, Array, Array]]) -> str | None:
    """Which plain difference the rates are: they are much nearer to it than to a better formula."""
    off, apart = (dict[str, list[Array]](backward=[], forward=[], central=[]) for _ in range(2))
    for t, q, v in parts:
        step = np.diff(q) / np.diff(t)
        backward, forward = step[1:-2], step[2:-1]
        h = np.diff(t)
        central = (h[2:-1] * backward + h[1:-2] * forward) / (h[2:-1] + h[1:-2])  # np.gradient
        wide = (4.0 * central - (q[4:] - q[:-4]) / (t[4:] - t[:-4])) / 3.0
        made_and_better = (backward, central), (forward, central), (central, wide)
        for name, (made, better) in zip(off, made_and_better, strict=True):
            off[name].append(np.abs(v[2:-2] - made))
            apart[name].append(np.abs(better - made))
    for name in off:
        # of both the same quantile: where a machine runs away, a few rows would be all that a mean sees
        mine, size = (float(np.quantile(np.concatenate(part[name]), _KEPT)) for part in (off, apart))
        if size > 0 and mine < PLAIN * size:
            return f"the {name} difference of"
    return None


def _filtered(parts: Sequence[tuple[Array, Array, Array]]) -> str | None:
    """A filter of positions that the rates are: they lack the noise that it should have brought."""
    even = [p for p in parts if np.ptp(np.diff(p[0])) < 2 * _EVEN * np.diff(p[0]).mean()]
    if not even:
        return None
    dt = float(np.median(np.diff(even[0][0])))
    left_over = [np.diff(q) - 0.5 * dt * (v[1:] + v[:-1]) for _, q, v in even]
    fourth, fifth = (_square([np.diff(d, n) for d in left_over]) for n in (4, 5))
    if not fifth > _WHITE * fourth > 0:
        return None
    noise = fourth / 252.0
    for reach in _REACHES:
        rows, wanted = [], []
        for _, q, v in even:
            if len(q) > 2 * reach + 1:
                rows.append(sliding_window_view(np.diff(q) / dt, 2 * reach))
                wanted.append(v[reach:-reach])
        count = sum(len(w) for w in wanted)
        if count < _FEWEST * 2 * reach:
            break
        every = max(1, count // _MOST)
        z, y = (np.concatenate([part[::every] for part in each]) for each in (rows, wanted))
        b = np.linalg.lstsq(z, y, rcond=None)[0]
        left = float(np.square(y - z @ b).sum() / (len(y) - len(b)))
        weights = np.diff(np.concatenate([[0.0], b, [0.0]])) / dt
        if left < SHARE * noise * float(np.square(weights).sum()):
            ahead = float(np.abs(b[reach:]).max()) < 0.02 * float(np.abs(b).max())
            return f"a {'causal ' if ahead else ''}filter of the differences of"
    return None


def to_infer(system: SystemInfo, raw: Sequence[RawRun], *, policy: str, report: Report) -> tuple[str, ...]:
    """Rates to infer, derived ones unless `keep`; their columns hold something until `inferred` fills them.

    A rate that is missing in some runs only is refused.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`derived_rates` must be {' or '.join(POLICIES)}; got {policy!r}.")
    without: dict[str, set[str]] = {}
    for run in raw:
        empty = np.asarray(np.isnan(run.x).all(axis=0))
        pairs = rate_pairs(system) if system.quaternion is None else []
        without[run.name] = {system.state_names[j] for i, j in pairs if empty[j] and not empty[i]}
    absent = {name for names in without.values() for name in names}
    for name in sorted(absent):
        lacking = [run for run, names in without.items() if name in names]
        if len(lacking) < len(raw):
            raise DataError(
                f"run {lacking[0]!r} has no value of {name!r} and others have; leave it out of all of them, and it is "
                "inferred from the position, or read the runs apart."
            )
    if absent:
        text = (
            f"no column {', '.join(sorted(absent))}: inferred from the positions, of which alone a fit and a "
            "diagnosis make their equations"
        )
        report(Finding("no_rate", "", len(absent), text, "inferred", {"states": sorted(absent)}))
    found = [one for one in derived_rates(system, raw) if one[0] not in absent]
    for rate, position, how in found:
        what = f"{rate} is {how} {position}, and no sensor's: it knows nothing that {position} does not"
        done = {
            "infer": f"taken out, and inferred from {position} alone; `data.derived_rates=keep` takes it as it is",
            "keep": "kept as it is: errors of fits are too small, and friction is found wrong",
        }[policy]
        values = {"state": rate, "position": position, "how": how.removesuffix(" of")}
        action = "inferred" if policy == "infer" else "reported"
        report(Finding("derived_rate", "", 1, f"{what}; {done}", action, values))
    names = absent | ({rate for rate, _, _ in found} if policy == "infer" else set())
    for run in raw if names else ():
        run.x = run.x.copy()
        for i, j in _pairs(system, names):
            q, good = run.x[:, i], np.isfinite(run.x[:, i])
            if good.sum() < 2:
                continue  # `times.fill_missing` says what is wrong
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
    """Runs with rates inferred from positions without any physics; `clock` is in physical seconds per logged second."""
    if not names:
        return list(runs)
    states, unknown = [np.array(run.x) for run in runs], {}
    for i, j in _pairs(system, names):
        places = [(x, a, b) for run, x in zip(runs, states, strict=True) for a, b in run.segments]
        found, unknown[system.state_names[j]] = rates([x[a:b, i] for x, a, b in places], runs[0].dt * clock)
        for (x, a, b), values in zip(places, found, strict=True):
            x[a:b, j] = values
    return [replace(run, x=x, inferred=unknown) for run, x in zip(runs, states, strict=True)]


def _pairs(system: SystemInfo, names: Collection[str]) -> list[tuple[int, int]]:
    return [(i, j) for i, j in rate_pairs(system) if system.state_names[j] in names]
