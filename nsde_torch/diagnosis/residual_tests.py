"""Specification tests: what forces the likelihood still asks for, as functions of everything that was measured.

For each port and each group of functions of one variable (`regressors`), the scores of forces that go with these
(`nsde_torch.inference.force_scores`), orthogonal to the parameters, have mean 0 if nothing is missing. The larger of
two chances counts, or that of what they bring to folds that they were not fitted to, twice: of Hotelling's T^2 under
the filter's own noise, as their information is that of draws, and of the scatter of coefficients over blocks of time
(jackknife), whatever the noise inside a block is like.

Each variable is tested in all runs and in the one run that stands out, as something that repeats along it
(`periodicity`), and all ports at their largest moment (of M bumps all over every stretch; Bonferroni) and at the line
of the spectrum.

**One run.** Functions of the variable in one run, beyond those of all runs and beyond what is constant in a run. With
s_r and I_r the scores and their information in run r, and b what all runs together say,

    u_r = s_r - I_r b,     cov u_r = I_r - I_r I^-1 I_r,      g_r = u_r' (cov u_r)^-1 u_r

nothing special in a run gives, with g what all R runs differ by in q functions each,

    g_r ~ chi2(q),        (g_r / q) / s ~ F(q, n - q + m),        s = (g - g_r + m) / (n - q + m),   n = q (R - 1)

the second whatever the noise has missed in every run (its size s of 1 counts as m differences between runs: Smyth,
Statistical Applications in Genetics and Molecular Biology 3 (2004)), the first in the unit of the residuals of the
blocks of time of the run where that is more than their information says. The larger chance counts, times the number of
runs (docs/content/theory/evidence.md). Where it is small, scores and information are those of the Gram matrices,
without draws.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
import torch
from scipy.special import chdtrc, fdtrc, stdtr

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.diagnosis import regressors
from nsde_torch.diagnosis.evidence import bonferroni, chance, dispersion, folds_of, of_draws
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.periodicity import COUNTS, WHOLE, Line, best_repeat, lines, waves_of
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects.by_run import RUN
from nsde_torch.inference import Optimum
from nsde_torch.inference.force_scores import DRAWS, ForceScores, FunctionScores, directions, force_scores
from nsde_torch.inference.sensitivity import grams, inverted
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.time_limit import check_time


@dataclass(frozen=True)
class Dependence:
    """How a force on one row of a port depends on one variable."""

    channel: str  # name of the channel that the row moves most
    variable: str  # name of the variable ("time", "run" and "x * y" too)
    p: float  # chance of this without any dependence, not corrected for the number of tests
    share: float  # share of the whitened variance that the functions explain, corrected for their number
    odd: float  # share of that by odd functions, the rest by even ones
    gain: float  # log-likelihood that the functions would bring [nats]
    functions: int  # number of functions
    run: int | None = None  # number of the run, of a test of one run alone or of a single moment
    moment: float | None = None  # time of a single moment [s]
    sinusoid: float | None = None  # frequency of a sinusoid that no phase holds together [Hz]
    port: int = 0  # number of the disturbance of the likelihood
    pair: str = ""  # `a * b`, of a variable times others: the product that matters most

    @property
    def excess(self) -> float:
        """Nats beyond what as many functions bring in noise, half a nat each."""
        return self.gain - 0.5 * self.functions

    @property
    def everywhere(self) -> bool:
        """Whether it is one of functions that are the same in all runs."""
        return self.run is None and self.sinusoid is None


@final
class PhysicsResiduals:
    """What fitted physics leaves, and everything that it may depend on.

    Its regression names channels and has the lines of the spectrum.

    Attributes:
        at: The optimum, in an even part of a long log.
        forces: Scores of forces on the ports.
        columns: Variables in the middle of each step, by name (N,).
        t, runs: Time in the run [s], and number of the run, of each step (N,).
        functions: Functions of each variable, product, drift, difference between runs, input before, time and run.
        channels: By disturbance: the channel that it moves most.
    """

    def __init__(self, search: Search, place: FittedPhysics, regression: Regression) -> None:
        self.decisions, self.budgets, self.inputs = search.decisions, search.budgets, search.inputs
        self.regression = regression
        self.forces: ForceScores = force_scores(place.at)
        self.at: Optimum = self.forces.at
        space, about = place.at.of.space, place.at.about
        self.system: System = place.at.of.vector.system
        self.channels = tuple(
            names[0] for names in regressors.moved_channels_of(regression, space.disturbances)
        )
        # given what is known at the start of a step, so that gusts and sensor noise are not in it
        row, steps = space.chunks.row.flatten(), space.steps
        first = torch.zeros(len(steps), dtype=torch.int64)
        order = space.chunks.counted.flatten().argsort(stable=True)
        first[row[order]] = order
        x = space.midway(about.x, about.after).flatten(0, 1)[first]
        table = regressors.machine_variables(self.system, x, steps.u, inputs=search.inputs)
        self.columns = {name: np.asarray(v.numpy()) for name, v in table.items() if float(v.std()) > 1e-9}
        self.t = np.asarray(steps.t.numpy())
        self.edges, self.dt = steps.segments, steps.dt
        self.runs = np.repeat(np.array(steps.runs), [b - a for a, b in steps.segments])
        before = regressors.rows_before(self.dt, steps.pace, moved=search.moved)
        groups = regressors.functions_of_groups(
            self.system, self.columns, self.t, self.runs, self.edges, before=before
        )
        self.functions: Mapping[str, regressors.Functions] = dict(groups)

    def values(self, variable: str) -> Array:
        """A plain variable, or time (N,)."""
        return self.t if variable == "time" else self.columns[variable]

    @cached_property
    def rows(self) -> int:
        """Whitened rows of one channel."""
        return int(self.at.of.space.chunks.counted.sum())

    @cached_property
    def owners(self) -> Labels:
        """Number of the run of each block of time (B,)."""
        return self.forces.blocks

    @cached_property
    def folds(self) -> Labels:
        """Fold of each block of time (B,)."""
        return folds_of(self.decisions, self.owners, np.arange(len(self.owners)))

    @cached_property
    def noise(self) -> dict[int, float]:
        """Mean square of the whitened innovations of each run, at least 1."""
        chunks, white = self.at.of.space.chunks, self.at.at.white
        runs = np.array(self.at.of.space.steps.runs)[chunks.stretch.numpy()]
        squares, counted = white.square().mean(-1).numpy(), chunks.counted.numpy()
        return {
            int(r): max(float(squares[:, runs == r][counted[:, runs == r]].mean()), 1.0)
            for r in np.unique(runs)
        }


def beyond_chance(
    tests: Sequence[Dependence], allowed: Mapping[str, float], *, alpha: float
) -> list[Dependence]:
    """Tests that find something after correction for their number, what explains most first.

    `allowed` is the likelihood ratio that feedback may hide, by channel (`feedback_bias`).
    """
    sure = (d for d in tests if bonferroni(d.p, len(tests)) < alpha)
    found = (d for d in sure if d.excess > 0.5 * allowed.get(d.channel, 0.0))
    out: dict[tuple[str, str, int | None, float | None], Dependence] = {}
    for d in sorted(found, key=lambda d: -d.excess):  # several ports move a channel
        out.setdefault((d.channel, d.variable, d.run, d.sinusoid), d)
    return list(out.values())


def overview(left: PhysicsResiduals) -> list[Dependence]:
    """Every port against each single variable, inputs before, time and run in all runs, the surest first.

    What effects that were found had to explain. It decides nothing.
    """
    names = [
        n for n in left.functions if n in left.columns or n in ("time", RUN) or n.endswith(regressors.BEFORE)
    ]
    out = [found for name in names for found in _of_variable(left, name, alone=False)]
    return sorted(out, key=lambda d: d.p)


def dependences(left: PhysicsResiduals) -> list[Dependence]:
    """Every port against every variable, the surest first."""
    out: list[Dependence | None] = [found for name in left.functions for found in _of_variable(left, name)]
    for port in range(len(left.channels)):
        for name in _places(left):
            out.append(_repeated(left, port, name))
        out.append(largest_moment(left, port))
    # inputs that were restored oscillate at the nulls of the average
    found = lines(left.regression, fewest=WHOLE, decisions=left.decisions, budgets=left.budgets)
    out += [_sinusoid(left, line) for line in found[:1] if left.inputs]
    return sorted(own_of_runs([d for d in out if d is not None]), key=lambda d: d.p)


def own_of_runs(tests: Sequence[Dependence]) -> list[Dependence]:
    """The tests, without chance for what one run alone has where something in all runs explains the channel better.

    What depends on another variable in every run looks like a matter of the run that shows it most.
    """
    best: dict[str, float] = {}
    for d in tests:
        # not what differs between runs: eight slopes of the speed hid a friction in one (test_one_run.py)
        if d.everywhere and not d.variable.endswith((RUN, regressors.BY_RUN)):
            best[d.channel] = max(best.get(d.channel, -np.inf), d.excess)

    def explained(d: Dependence) -> bool:
        alone = d.run is not None and d.moment is None
        return alone and d.excess <= best.get(d.channel, -np.inf)

    return [replace(d, p=1.0) if explained(d) else d for d in tests]


def _of_variable(left: PhysicsResiduals, name: str, *, alone: bool = True) -> Iterator[Dependence]:
    """All ports against one group of functions: in all runs, and of a plain variable in one run alone, if asked for."""
    functions, odd = left.functions[name]()
    for port in range(len(left.channels)):
        check_time()
        scores = left.forces.of(functions, port)
        own, kept = scores.independent()
        if not len(kept):
            continue
        p = chance(own.blocks, own.informations, left.folds, DRAWS, decisions=left.decisions)
        of_odd = _odd(np.square(own.total), odd[kept])
        found = _dependence(left, port, name, p, scores.nats, len(kept), odd=of_odd)
        yield replace(found, pair=_product(left, name, scores)) if name.endswith(regressors.OTHERS) else found
        if alone and name in left.columns:
            in_run = in_one_run(left, port, name, functions, odd)
            if in_run is not None:
                yield in_run


def _dependence(
    left: PhysicsResiduals,
    port: int,
    variable: str,
    p: float,
    gain: float,
    functions: int,
    *,
    odd: float = 0.0,
    run: int | None = None,
    moment: float | None = None,
) -> Dependence:
    """A test of functions on a port, with the share of the whitened variance that they explain."""
    share = max(2.0 * gain - functions, 0.0) / left.rows
    of = left.channels[port]
    return Dependence(
        of, variable, min(1.0, p), share, odd, gain, functions, run=run, moment=moment, port=port
    )


def _odd(squares: Array, odd: Mask) -> float:
    """Share of squares that odd functions have."""
    return float(squares[odd].sum()) / max(float(squares.sum()), 1e-300)


def _product(left: PhysicsResiduals, name: str, scores: FunctionScores) -> str:
    """The product with another variable that brings most by itself."""
    first, names = name.removesuffix(regressors.OTHERS), list(left.columns)
    pull = np.square(scores.total) / np.maximum(np.diag(scores.information), 1e-300)
    other, kind = divmod(int(pull.argmax()), len(regressors.PRODUCTS))
    return regressors.PRODUCTS[kind].format(first, names[names.index(first) + 1 + other])


def _repeated(left: PhysicsResiduals, port: int, name: str) -> Dependence | None:
    """What repeats along a variable, beyond what all functions of it explain: the best of many periods."""
    v = left.columns[name]
    again = best_repeat(left.forces, port, v)
    if again is None:
        return None
    functions, _ = left.functions[name]()
    both, kept = left.forces.of(np.column_stack((functions, again.waves)), port).independent()
    own = both.turned(np.eye(len(kept))[kept >= functions.shape[1]])
    q, draws = own.blocks.shape[1], DRAWS - functions.shape[1]
    if not q:
        return None
    p = chance(own.blocks, own.informations, left.folds, draws, decisions=left.decisions)
    gain = replace(own, draws=draws).nats - float(np.log(len(COUNTS)))
    return _dependence(left, port, name, len(COUNTS) * p, gain, q, odd=0.5)


def _sinusoid(left: PhysicsResiduals, line: Line) -> Dependence:
    """A line of the spectrum as a sine and a cosine of its own in each stretch."""
    channel = left.regression.physics.names[left.regression.rows[line.row]]
    residual = left.regression.residual[:, left.regression.rows[line.row]]
    waves = waves_of(left.regression, line.frequency)
    explained = residual @ waves @ np.linalg.lstsq(waves, residual, rcond=1e-9)[0]
    port = left.channels.index(channel) if channel in left.channels else 0
    angle = 2.0 * np.pi * line.frequency * left.dt * np.arange(len(left.t))
    gain = 0.0
    for a, b in left.edges:
        of_stretch = np.zeros((len(angle), 2))
        of_stretch[a:b] = np.stack((np.sin(angle[a:b]), np.cos(angle[a:b])), 1)
        gain += left.forces.of(of_stretch, port).nats
    share, functions = float(explained) / max(float(residual @ residual), 1e-300), 2 * len(left.edges)
    return Dependence(
        channel, "time", line.p, share, 0.0, gain, functions, sinusoid=line.frequency, port=port
    )


def _places(left: PhysicsResiduals) -> list[str]:
    """Variables along which something may repeat: positions of joints, and angles; not a place in free space."""
    system = left.system
    named = set() if system.quaternion is not None else {p for p, _, _ in system.position_derivatives}
    angles = {n for n, unit in zip(system.feature_names, system.feature_units, strict=True) if unit == "rad"}
    return [name for name in left.columns if name in named | angles]


# ---- one run -------------------------------------------------------------------------------------------

_NEW = 1e-3  # of what a function does in a run that those of all runs and a constant leave


def in_one_run(
    left: PhysicsResiduals, port: int, name: str, functions: Array, odd: Mask
) -> Dependence | None:
    """A variable in the run that stands out; None where no run can be odd."""
    decisions, runs = left.decisions, np.unique(left.owners)
    if len(runs) < decisions.fewest_runs:
        return None
    own = left.forces.of(np.column_stack((functions, np.ones(len(functions)))), port)
    own = own.turned(np.diag(1.0 / np.sqrt(np.maximum(own.least, 1e-300))))
    parts = {int(run): _free_of_constant(own.of(left.owners == run)) for run in runs}
    informations = {run: scores.information for run, scores in parts.items()}
    inverse = np.linalg.pinv(np.sum(list(informations.values()), 0), rcond=1e-6, hermitian=True)
    every = inverse @ np.sum([scores.total for scores in parts.values()], 0)
    tested = slice(0, min(regressors.SMOOTH, functions.shape[1]))
    each: dict[int, tuple[float, Array]] = {}
    in_all = 0.0
    for run, scores in parts.items():
        information = informations[run]
        beyond = (scores.total - information @ every)[tested]
        spread = (information - information @ inverse @ information)[tested, tested]
        turn, _ = directions(spread, _NEW * np.diag(information)[tested])
        each[run] = float(np.square(turn @ beyond).sum()), turn
        every_turn, _ = directions(information[tested, tested], np.zeros(len(spread)))
        in_all += float(np.square(every_turn @ beyond).sum())
    run = max(each, key=lambda r: each[r][0])
    ratio, turn = each[run]
    q, n = len(turn), len(odd[tested]) * (len(runs) - 1)
    if not 0 < q < n:
        return None
    freedom = n - q + decisions.odd_run_prior
    rest = (max(in_all - ratio, 0.0) + decisions.odd_run_prior) / freedom
    like_others = float(fdtrc(q, freedom, ratio / left.noise[run] / q / rest))
    p = len(runs) * max(of_draws(ratio / left.noise[run], q, DRAWS), like_others)
    gain, of_odd = 0.5 * ratio, 0.5
    if p < left.budgets.closer_chance:
        pulls, known, kept, inside = _of_run(left, port, functions, run)
        squares = np.square(pulls.sum(0))
        q, gain = len(squares), 0.5 * float(squares.sum())
        louder = max(left.noise[run], dispersion(pulls[inside], known[inside]))
        p = len(runs) * max(float(chdtrc(max(q, 1), 2.0 * gain / louder)), like_others)
        of_odd = _odd(squares, odd[kept])
    return _dependence(left, port, name, p, gain, q, odd=of_odd, run=run)


def _of_run(
    left: PhysicsResiduals, port: int, functions: Array, run: int
) -> tuple[Array, Array, Labels, Mask]:
    """The first functions in one run, orthogonal to all in all runs and to constants in a run.

    Their scores by block of time in directions of unit information (B, q), the information of these (B, q, q), the
    functions that these begin with (q,), and whether a block is of the run (B,).
    """
    count = min(regressors.SMOOTH, functions.shape[1])
    of_runs = left.runs[:, None] == np.unique(left.owners)
    inside = functions[:, :count] * (left.runs == run)[:, None]
    at = left.at
    force = torch.from_numpy(np.column_stack((functions, of_runs, inside))[at.of.space.chunks.row.numpy()])
    held = grams(at.of.space, at.levels, at.about, at.at, left.forces.columns, forces=[(port, force)])
    own, known = slice(-count, None), slice(1, -count)
    total = held.total
    inverse = inverted(total[known, known])
    turn = np.column_stack((-total[own, known] @ inverse, np.eye(count)))
    blocks, inside_run = held.blocks, at.of.space.chunks.places()[0] == run
    # less what all runs have
    pulls = (blocks[:, 1:, 0] - blocks[:, 1:, known] @ (inverse @ total[known, 0])) @ turn.T
    unit, kept = directions(turn @ total[1:, 1:] @ turn.T, _NEW * np.diag(total)[own])
    turn = unit @ turn
    return pulls @ unit.T, turn @ blocks[:, 1:, 1:] @ turn.T, kept, inside_run


def _free_of_constant(scores: FunctionScores) -> FunctionScores:
    """Scores without the last one, and without what they share with that."""
    whole = scores.information
    share = whole[:-1, -1] / max(float(whole[-1, -1]), 1e-300)
    return scores.turned(np.column_stack((np.eye(len(share)), -share)))


# ---- moments -------------------------------------------------------------------------------------------

_BUMPS_S = (0.25, 1.0)  # widths of bumps


def largest_moment(left: PhysicsResiduals, port: int) -> Dependence | None:
    """The moment at which a port is pushed most, if that is more than all other moments let expect."""
    along, drawn_along = left.forces.along(port, len(left.t))
    sizes, places = [], []
    for width_s in _BUMPS_S:
        n = max(4, round(width_s / left.dt))
        shape = np.hanning(n + 2)[1:-1]
        for a, b in left.edges:
            if b - a <= n:
                continue
            some = np.arange(0, b - a - n, max(1, n // 2))
            scores = np.correlate(along[a:b], shape)[some]
            drawn = np.stack([np.correlate(own, shape)[some] for own in drawn_along[a:b].T], 1)
            spread = np.sqrt(np.square(drawn).mean(1))
            live = spread > 0.0  # of a long log, a part is seen
            if not live.any():
                continue
            # the largest of many is not the one whose spread was drawn small
            sizes.append(np.abs(scores[live]) / np.maximum(spread[live], np.median(spread[live])))
            places.append(a + some[live])
    size = np.concatenate(sizes) if sizes else np.zeros(0)
    if len(size) < left.decisions.moments_fewest:
        return None
    scale = max(1.0, float(np.median(size)) / 0.6745)
    k = int(size.argmax())
    largest, at = float(size[k]) / scale, int(np.concatenate(places)[k])
    p = 2.0 * float(stdtr(DRAWS, -largest)) * len(size)
    return _dependence(
        left, port, "time", p, 0.5 * largest**2, 1, run=int(left.runs[at]), moment=float(left.t[at])
    )
