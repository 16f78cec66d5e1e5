"""Estimates from signals outside the loop: instrumental variables (docs/content/theory/feedback.md).

A signal z that no disturbance moves (a pilot's stick, a setpoint) moves the inputs all the same, and what of them it
moves is free of disturbances:

    sum_i H_i' e_i(theta) = 0,    H_i: slopes of the whitened residuals e_i, predicted from whitened z of now and before
    covariance of theta: the jackknife over blocks of time, theta moves by (A - A_c)^-1 H_c' e_c, A = sum_i H_i' J_i

(two-stage least squares: Soderstrom and Stoica, Instrumental Variable Methods for System Identification, 1983), the
first stage fitted on other blocks than it predicts (Angrist, Imbens and Krueger, Journal of Applied Econometrics 14
(1999)). Tested are exogeneity; strength, by F of the slope of each parameter on its own part of H (Staiger and Stock,
Econometrica 65 (1997)), below which it keeps its own slopes; the difference from the ordinary estimate (Hausman,
Econometrica 46 (1978)), by its jackknife; and whether all that instruments do is explained (Sargan, Econometrica 26
(1958)), which a missing lag is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.special import chdtrc, stdtr, stdtrit

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.inference.spread import Spread
from nsde_torch.sysid import signals
from nsde_torch.sysid.feedback_test import ALPHA, FeedbackTest, own_innovations, own_past
from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.texts import rendered

MISSING = 1e-3  # chance below which instruments show that an effect is missing
_SURE = 0.05  # chance below which two estimates differ
_WEAK = 10.0
_ROWS = (-1, 0, 1, 2)  # rows before that the first stage knows: sticks move between rows too
_LAGS_S = (0.03, 0.1, 0.3, 1.0)  # time constants of its knowledge of the past
_FOLDS = 5
_ROUNDS, _SETTLED = 10, 0.02  # standard errors
_BINS = (1, 2, 3, 4, 6, 9, 14, 21, 31, 46)  # rows after a disturbance between which an answer is summed up
_FOREKNOWN = 1e-8  # share of a signal that is new: below, it is known beforehand and answers nothing


@dataclass(frozen=True)
class Instrumented:
    """What instruments say of the parameters."""

    names: tuple[str, ...]
    refused: dict[str, str]  # those that were not, name -> why
    labels: tuple[str, ...]
    values: Array  # estimates (k,): by instruments where they are strong, else ordinary ones
    covariance: Array  # of `values` (k, k)
    degrees: Array  # degrees of freedom (k,)
    strength: Array  # F of each parameter's first stage (k,); nan where the data do not show it
    moved: Mask  # whether the instruments show a parameter (k,)
    ordinary: Array  # ordinary estimates (k,)
    difference: Array
    """Chance of so large a difference from the ordinary estimate (k,), adjusted (Holm); 1 where not moved."""
    unexplained: float  # chance that declared physics explains all that the instruments do (Sargan)
    misfit: float = 0.0
    between_rows: bool = False
    """Whether inputs were taken to move between rows of the log, and not to be held."""
    leans: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Change of each estimate by instruments per error of each ordinary one beside it (k, k)."""

    @property
    def differs(self) -> bool:
        """Whether any estimate surely differs from the ordinary one."""
        return bool((self.difference < _SURE).any())

    def half_widths(self, level: float) -> Array:
        """Half-widths of intervals of this level (k,)."""
        wide = np.sqrt(np.diag(self.covariance).clip(0.0))
        return np.asarray(stdtrit(self.degrees.clip(1.0), 0.5 * (1 + level)) * wide)

    def findings(self, adopted: bool) -> list[str]:
        """What instruments say, in words; `adopted` says whether their estimates are those that are printed."""
        apart = [
            f"{label} {self.ordinary[i]:.4g} becomes {self.values[i]:.4g}"
            for i, label in enumerate(self.labels)
            if self.difference[i] < _SURE
        ]
        rows = [*zip(self.labels, self.moved, self.strength, strict=True)]
        told = {
            "apart": apart,
            "moved": [name for name, moved, _ in rows if moved],
            "weak": [name for name, moved, f in rows if not moved and f == f],
            "missing": self.unexplained < MISSING,
        }
        return rendered(__file__, "instruments.txt", by=self, adopted=adopted, **told).splitlines()

    def as_dict(self) -> dict[str, Any]:
        half = self.half_widths(0.9)
        return {
            "used": list(self.names),
            "refused": dict(self.refused),
            "inputs_move_between_rows": self.between_rows,
            "explains_all_that_they_do_chance": self.unexplained,
            "estimates": {
                label: {
                    "ordinary": float(self.ordinary[i]),
                    "by_instruments": float(self.values[i]),
                    "half_width_90": float(half[i]),
                    "first_stage_f": float(self.strength[i]),
                    "difference_chance": float(self.difference[i]),
                }
                for i, label in enumerate(self.labels)
                if self.moved[i]
            },
            "not_shown_by_the_instruments": [self.labels[i] for i in np.flatnonzero(~self.moved)],
        }


def adopted(instrumented: Instrumented, loop: FeedbackTest) -> bool:
    """Whether estimates by instruments are those to print."""
    wanted = instrumented.differs or bool(loop.hidden) or bool(loop.functions_of_state)
    return bool(instrumented.moved.any()) and wanted and instrumented.unexplained >= MISSING


def with_columns(system: System, runs: Sequence[Run], names: Sequence[str]) -> tuple[System, list[Run]]:
    """A copy of the machine that is given the instruments' columns, and the runs with them behind the inputs.

    Raises:
        DataError: a run lacks one, or one never changes.
    """
    for name in names:
        for run in runs:
            if name not in run.extra:
                raise DataError(
                    f"`instruments` names {name!r}, which run {run.name!r} does not have; further columns: "
                    f"{', '.join(sorted(run.extra)) or 'none'}."
                )
        if not any(np.ptp(run.extra[name]) > 0 for run in runs):
            raise DataError(
                f"`instruments` names {name!r}, which never changes in these runs and can show nothing. Leave it out."
            )
    new = [n for n in dict.fromkeys(names) if n not in system.exogenous]
    # columns of `reading` come first
    made = system.reading(*new)
    at = {n: system.nu + i for i, n in enumerate(system.exogenous)}
    out = []
    for run in runs:
        parts = [run.u[:, : system.nu]]
        parts += [(run.u[:, at[n]] if n in at else run.extra[n])[:, None] for n in made.exogenous]
        out.append(replace(run, u=np.concatenate(parts, 1)))
    return made, out


def exogenous(regression: Regression, names: Sequence[str]) -> dict[str, str]:
    """Instruments that answer what the physics does not explain, name -> in words how."""
    series = extended(regression.series)
    z = signals.spread_out(regression, _boxes(regression, names))
    new = own_innovations(z, own_past(z, series))
    live = signals.late(series, _BINS[-1])
    nothing = np.ones((int(live.sum()), 1)) / np.sqrt(max(int(live.sum()), 1))
    scores = []
    for white in regression.white:
        late = series.lagged(white[:, None], range(1, _BINS[-1]))
        scores.append(signals.score_tests(new[live], signals.binned(late[live], _BINS), nothing))
    found = []
    for j, name in enumerate(names):
        if signals.foreknown(new[live, j], z[live, j], _FOREKNOWN):
            continue
        for of_channel, channel in zip(scores, regression.rows, strict=True):
            chance, share = of_channel[j]
            found.append((name, regression.physics.names[channel], chance, share))
    out: dict[str, str] = {}
    for (name, channel, _, share), chance in zip(found, signals.holm([f[2] for f in found]), strict=True):
        if chance < ALPHA and name not in out:
            out[name] = (
                f"not exogenous: it answers what the physics does not explain of {channel} ({share:.1%} of what is new "
                f"in it, p = {chance:.1g})"
            )
    return out


def instrumental(
    regression: Regression, names: Sequence[str], *, ordinary: Regression | None = None
) -> Instrumented:
    """Estimate by instruments; ordinary estimates are those of `ordinary`, or of the same regression."""
    usual = regression if ordinary is None else ordinary
    labels, start = tuple(usual.vector.labels), usual.theta
    refused = exogenous(regression, names)
    used = [n for n in names if n not in refused]
    known = np.flatnonzero(regression.shown.known & usual.shown.known)
    sure, basis = usual.spread(), usual.shown.basis
    plain = Instrumented(
        tuple(used), refused, labels, start, basis @ sure.covariance @ basis.T, sure.degrees(basis),
        np.full(len(labels), np.nan), np.zeros(len(labels), dtype=bool), start, np.ones(len(labels)), 1.0,
        leans=np.zeros((len(labels), len(labels))),
    )  # fmt: skip
    if not used or not len(known):
        return plain
    features = _features(regression, used)
    here, chosen, strength = regression, list(range(len(known))), np.zeros(len(known))
    for turn in range(_ROUNDS):
        stage = _Stage(here, features, known)
        if turn < 2:  # then the choice stands, so that theta can settle
            chosen, strength = stage.choose()
        if not chosen:
            return replace(plain, strength=_placed(strength, known, plain.strength))
        step = stage.step(chosen)
        theta = here.theta.copy()
        theta[known] += step
        moved = here.vector.inside(theta) - here.theta
        here = here.at(here.theta + moved)
        small = np.abs(moved[known]) <= _SETTLED * np.sqrt(np.diag(stage.spread(chosen).covariance))
        if turn >= 1 and small.all():
            break
    stage = _Stage(here, features, known)
    spread = stage.spread(chosen)
    degrees = spread.degrees(np.eye(len(known)))
    apart = spread.parts - (sure.parts @ basis.T)[:, known]
    error = np.sqrt(np.square(apart).sum(0))
    ratio = np.abs(here.theta - start)[known] / np.maximum(error, 1e-300)
    chances = 2.0 * stdtr(degrees.clip(1.0), -ratio)
    unexplained, misfit = stage.sargan(chosen)
    k, shown = len(labels), known[chosen]
    return replace(
        plain,
        values=here.theta,
        covariance=_placed(spread.covariance, known, np.zeros((k, k))),
        degrees=_placed(degrees, known, np.ones(k)),
        strength=_placed(strength, known, np.full(k, np.nan)),
        moved=np.isin(np.arange(k), shown),
        difference=_placed(np.array(signals.holm(chances[chosen].tolist())), shown, np.ones(k)),
        unexplained=unexplained,
        misfit=misfit,
        leans=_placed(stage.leans(chosen), known, np.zeros((k, k))),
    )


class _Stage:
    """Both stages where theta stands: slopes J and what instruments predict of them, over all channels."""

    def __init__(self, regression: Regression, features: Array, known: Labels) -> None:
        self.white = regression.white
        self.slopes = regression.slopes[:, :, known]
        self.blocks = regression.whitened_rows(regression.blocks)
        self.z = [regression.whitened(noise, features) for noise in regression.noises]
        fold = self.blocks % _FOLDS
        self.predicted = np.zeros_like(self.slopes)
        for i, z in enumerate(self.z):
            whole, cross = z.T @ z, z.T @ self.slopes[i]
            small = 1e-10 * np.trace(whole) * np.eye(len(whole)) / len(whole)
            for f in range(_FOLDS):
                at = fold == f
                rest = whole - z[at].T @ z[at]
                weights = np.linalg.solve(rest + small, cross - z[at].T @ self.slopes[i][at])
                self.predicted[i, at] = z[at] @ weights

    def used(self, chosen: list[int]) -> Array:
        """H (channels, N, k): predicted slopes of the chosen parameters, own slopes of the others."""
        out = self.slopes.copy()
        out[:, :, chosen] = self.predicted[:, :, chosen]
        return out

    def step(self, chosen: list[int]) -> Array:
        """Change of theta (k,) that brings the moments to zero."""
        h = self.used(chosen)
        a = np.einsum("cnj,cnk->jk", h, self.slopes)
        return np.asarray(np.linalg.lstsq(a, np.einsum("cnj,cn->j", h, self.white), rcond=None)[0])

    def leans(self, chosen: list[int]) -> Array:
        """Change of each chosen parameter per error of each other one (k, k)."""
        k = self.slopes.shape[2]
        others = [j for j in range(k) if j not in chosen]
        out = np.zeros((k, k))
        if chosen and others:
            a = np.einsum("cnj,cnk->jk", self.used(chosen), self.slopes)
            beside = np.ix_(chosen, others)
            out[beside] = -np.linalg.lstsq(a[np.ix_(chosen, chosen)], a[beside], rcond=None)[0]
        return out

    def choose(self) -> tuple[list[int], Array]:
        """Parameters that the instruments move, the weakest left out one after another, and F of all (k,)."""
        k = self.slopes.shape[2]
        # one at a time first: the weak ones would make others look weak
        strength = np.array([self._strength(self.used([j]), j) for j in range(k)])
        chosen = [j for j in range(k) if strength[j] >= _WEAK]
        while chosen:
            h = self.used(chosen)
            for j in chosen:
                strength[j] = self._strength(h, j)
            worst = min(chosen, key=lambda j: float(strength[j]))
            if strength[worst] >= _WEAK:
                break
            chosen.remove(worst)
        return chosen, strength

    def _strength(self, h: Array, j: int) -> float:
        """F of the slope of parameter j, without what the others explain, on its own part of H."""
        k = h.shape[2]
        others = [i for i in range(k) if i != j]
        flat, slopes = h.reshape(-1, k), self.slopes.reshape(-1, k)
        own, slope = flat[:, j], slopes[:, j]
        if others:
            rest = flat[:, others]
            own = own - rest @ np.linalg.lstsq(rest, own, rcond=None)[0]
            a = rest.T @ slopes[:, others]
            slope = slope - slopes[:, others] @ np.linalg.lstsq(a, rest.T @ slope, rcond=None)[0]
        size = float(own @ own)
        if not size > 1e-12 * float(slope @ slope):
            return 0.0
        pi = float(own @ slope) / size
        if pi <= 0:  # cross-fitted predictions that point the wrong way say nothing
            return 0.0
        by_block = np.bincount(np.tile(self.blocks, h.shape[0]), own * (slope - pi * own))
        return float((pi * size) ** 2 / max(np.square(by_block).sum(), 1e-300))

    def spread(self, chosen: list[int]) -> Spread:
        """Covariance by the jackknife over blocks."""
        h = self.used(chosen)
        count, k = int(self.blocks.max()) + 1, h.shape[2]
        a, s, w = np.zeros((count, k, k)), np.zeros((count, k)), np.zeros((count, k, k))
        for c in range(count):
            rows = self.blocks == c
            part = h[:, rows].reshape(-1, k)
            a[c] = part.T @ self.slopes[:, rows].reshape(-1, k)
            s[c] = part.T @ self.white[:, rows].reshape(-1)
            w[c] = part.T @ part
        whole = a.sum(0)
        left = whole - a
        parts = np.stack([np.linalg.lstsq(left[c], s[c], rcond=None)[0] for c in range(count)])
        back = np.linalg.pinv(whole)
        return Spread(parts.T @ parts, parts, back @ w @ back.T)

    def sargan(self, chosen: list[int]) -> tuple[float, float]:
        """Chance of moments as far from zero as these if nothing is missing, and the statistic."""
        bases = [signals.basis_of(z) for z in self.z]
        h = self.slopes.copy()
        for i, z in enumerate(bases):
            h[i][:, chosen] = z @ (z.T @ self.slopes[i][:, chosen])
        moments = np.concatenate([z * e[:, None] for z, e in zip(bases, self.white, strict=True)], 1)
        slopes = np.concatenate([j.T @ z for j, z in zip(self.slopes, bases, strict=True)], 1)
        own = np.einsum("cnk,cn->nk", h, self.white)
        # what does not change as theta does
        moments = moments - own @ np.linalg.pinv(np.einsum("cnj,cnk->kj", h, self.slopes)) @ slopes
        values, vectors = np.linalg.eigh(moments.T @ moments)
        free = len(values) - len(chosen)
        if free < 1:
            return 1.0, 0.0
        score = (moments.sum(0) @ vectors)[-free:]
        statistic = float(np.square(score) @ (1.0 / values[-free:]))
        return float(chdtrc(free, statistic)), statistic


def _boxes(regression: Regression, names: Sequence[str]) -> Array:
    """Means of instruments over boxes (M, n)."""
    system = regression.physics.vector.system
    at = [system.nu + system.exogenous.index(n) for n in names]
    return signals.box_means(regression, np.asarray(regression.physics.steps.u[:, at]))


def _features(regression: Regression, names: Sequence[str]) -> Array:
    """What the first stage knows (boxes, n): a constant, instruments of now and, fading, of before."""
    z = _boxes(regression, names)
    z = (z - z.mean(0)) / np.maximum(z.std(0), 1e-300)
    parts = [np.ones((len(z), 1)), *(regression.series.shifted(z, -rows) for rows in _ROWS)]
    for lag in _LAGS_S:
        fade = float(np.exp(-regression.dt / (lag * regression.pace)))
        held = np.zeros_like(z)
        for a, b in regression.series.edges:
            held[a:b] = lfilter([1.0 - fade], [1.0, -fade], z[a:b], axis=0)
        parts.append(held)
    return np.concatenate(parts, 1)


def _placed(values: Array, at: Labels, among: Array) -> Array:
    """Values at these places of every axis, among others."""
    out = among.copy()
    out[np.ix_(*[at] * out.ndim)] = values
    return out
