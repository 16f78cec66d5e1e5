"""The search for the most informative experiment: random proposals, then changes of the best, judged by the worst case.

An experiment's value is its evidence in the less favourable draws of the parameters (a fifth of the way up from the
worst), whichever member is true: for a tie the expected evidence [nats], for parameters the logarithm of how much
smaller than their usual size the standard errors become. One that leaves a limit under any member and draw is out.

Expected evidence, without noise and fits: member A is true, and d is what B's filter leaves of A's experiment, in units
of the noise. B's parameters may move, at the price of what the runs there are say of them (information M),

    2 nats = min_b |d - J b|^2 + b' M b = d'd - g' (J'J + M)^-1 g,        g = J'd

(Atkinson and Fedorov, The design of experiments for discriminating between two rival models, Biometrika 62 (1975), with
what a refit takes away linearised). The standard errors of A's own parameters are those of J'J + M.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import final

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.design.experiment import PlannedRun
from nsde_torch.design.limits import MARGIN, ExperimentLimits
from nsde_torch.design.members import Branch, Drive, Member, Rollouts, as_run, width_columns
from nsde_torch.design.paths import Paths
from nsde_torch.errors import ConfigError
from nsde_torch.inference.posterior import LogWithPrior
from nsde_torch.progress import Say

# Inputs of an open loop: pieces of equal length, each a hold, ramp, sine, chirp, square wave or two sines.
#
#     u(t) = middle + half range * clip(offset + amplitude * wave(t), -1, 1)
#
# Each piece of each input has six genes in [0, 1]: kind, offset, amplitude, two frequencies (on a logarithmic
# scale) and a phase. They are few, a person can fly them, and a search can change one at a time. Offset and
# amplitude are on a scale that is fine about rest, value = sinh(5 g) / sinh(5): what a machine does may hang
# on forces that are a hundredth of those that its runs held, a dry friction for one.

KINDS = ("hold", "ramp", "sine", "chirp", "square", "two sines")
PIECES = 4
GENES = 6
SCALES = (1.0, 0.5, 0.25, 0.1)  # shares of the range of the inputs that a baseline is tried at
_FINE = 5.0
_SMALLEST = 0.1


@dataclass(frozen=True)
class Signals:
    """Inputs of one length within limits."""

    limits: ExperimentLimits
    dt: float
    steps: int
    hertz: tuple[float, float]  # lowest and highest frequency [Hz]

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Genes (count, pieces, nu, 6)."""
        genes = rng.uniform(0.0, 1.0, (count, PIECES, len(self.limits.low), GENES))
        same = rng.uniform(size=count) < 0.4  # one wave throughout
        genes[same, 1:] = genes[same, :1]
        size = rng.uniform(_SMALLEST, 1.0, count)[:, None, None]  # of the whole experiment
        genes[..., 1] = 0.5 + (genes[..., 1] - 0.5) * size * rng.choice([0.0, 0.3, 1.0], count)[:, None, None]
        genes[..., 2] *= size
        return genes

    def gentle(self, count: int, rng: np.random.Generator) -> Array:
        """Genes of inputs of small amplitude about where the machine is left alone (count, pieces, nu, 6)."""
        genes = self.random(count, rng)
        genes[..., 1] = 0.5 + 0.02 * (genes[..., 1] - 0.5)
        genes[..., 2] *= np.linspace(0.03, 0.5, count)[:, None, None]
        return np.clip(genes, 0.0, 1.0 - 1e-9)

    def mutated(self, genes: Array, rng: np.random.Generator) -> Array:
        """Genes near others (count, pieces, nu, 6)."""
        out = genes.copy()
        for g in out:
            size = rng.choice([0.03, 0.1, 0.3])
            chosen = rng.uniform(size=g.shape) < rng.choice([0.1, 0.3, 1.0])
            g += size * chosen * rng.standard_normal(g.shape)
            if rng.uniform() < 0.25:  # one piece as another
                a, b = rng.integers(len(g), size=2)
                g[a] = g[b]
            if rng.uniform() < 0.2:
                g[rng.integers(len(g)), :, 0] = rng.uniform()
        return np.clip(out, 0.0, 1.0 - 1e-9)

    def shrunk(self, genes: Array, shares: Array) -> Array:
        """Genes of the same inputs with shares (count,) of their distance from rest (count, pieces, nu, 6)."""
        out, share = genes.copy(), shares[:, None, None]
        out[..., 1] = 0.5 + 0.5 * _gene(share * _fine(2.0 * genes[..., 1] - 1.0))
        out[..., 2] = _gene(share * _fine(genes[..., 2]))
        return out

    def inputs(self, genes: Array) -> Array:
        """Inputs (count, steps, nu) of genes (count, pieces, nu, 6)."""
        t = self.dt * np.arange(self.steps, dtype=np.float64)
        edges = np.linspace(0, self.steps, PIECES + 1).round().astype(int)
        out = np.empty((len(genes), self.steps, genes.shape[2]))
        for p, (a, b) in enumerate(pairwise(edges.tolist())):
            out[:, a:b] = np.moveaxis(self._piece(genes[:, p], t[a:b]), 2, 1)
        return self._scaled(out)

    def words(self, genes: Array) -> list[str]:
        """What a person reads of the genes (pieces, nu, 6) of one experiment."""
        edges = self.dt * np.linspace(0, self.steps, PIECES + 1).round()
        out = []
        (middle, half), (low, high) = self._range, np.log(self.hertz)
        for p, (a, b) in enumerate(pairwise(edges.tolist())):
            for i, name in enumerate(self.limits.inputs):
                g = genes[p, i]
                f1, f2 = np.exp(low + g[3:5] * (high - low))
                offset = self._offset(genes[p, :, 1])[i]
                about, swing = middle[i] + half[i] * offset, half[i] * float(_fine(g[2]))
                told = {
                    "hold": f"hold {about:.3g}",
                    "ramp": f"ramp from {about - swing:.3g} to {about + swing:.3g}",
                    "sine": f"sine of {f1:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "chirp": f"chirp from {f1:.2g} to {f2:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "square": f"to and fro at {f1:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                    "two sines": f"sines of {f1:.2g} and {f2:.2g} Hz, +- {swing:.3g} about {about:.3g}",
                }[KINDS[int(g[0] * len(KINDS))]]
                out.append(f"{a:.4g} to {b:.4g} s: {name} {told}")
        return out

    def baselines(self, rng: np.random.Generator, before: Array) -> dict[str, tuple[Array, tuple[str, ...]]]:
        """Usual inputs (scales, steps, nu), with words; `before` are inputs (n, nu) of a run there is, given again."""
        t = self.dt * np.arange(self.steps, dtype=np.float64)
        n = len(self.limits.low)
        low, high = self.hertz
        top = min(high, max(2.0, 4.0 * low))
        f = np.exp(rng.uniform(np.log(low), np.log(top), (n, 8)))
        sines = np.sin(2 * np.pi * f[..., None] * t + rng.uniform(0, 2 * np.pi, (n, 8, 1))).sum(1)
        rate = np.log(high / low) / t[-1]
        chirp = np.sin(2 * np.pi * low * np.expm1(rate * t) / rate)
        period = 4.0 * max(0.5, 2.0 * self.dt)
        place = np.mod(t, period) / period
        doublet = np.where(place < 0.25, 1.0, np.where(place < 0.5, -1.0, 0.0))
        sines /= np.abs(sines).max(1, keepdims=True)
        waves = {
            "multisine": (sines, f"8 sines of random phase, {low:.2g} to {top:.2g} Hz"),
            "chirp": (np.tile(chirp, (n, 1)), f"a chirp from {low:.2g} to {high:.2g} Hz"),
            "doublets": (np.tile(doublet, (n, 1)), f"a doublet of {period:.2g} s, again and again"),
        }
        sizes = np.array(SCALES)[:, None, None]
        out: dict[str, tuple[Array, tuple[str, ...]]] = {
            name: (self._scaled(sizes * wave.T[None]), (told,)) for name, (wave, told) in waves.items()
        }
        again = before[np.arange(self.steps) % len(before)]
        table = np.clip(sizes * again, self.limits.low, self.limits.high)
        return {**out, "the longest run again": (table, ("the inputs of the longest run",))}

    def _scaled(self, unit: Array) -> Array:
        middle, half = self._range
        return np.asarray(middle + half * np.clip(unit, -1.0, 1.0))

    @property
    def _range(self) -> tuple[Array, Array]:
        """Middle and half of the range of the inputs."""
        low, high = self.limits.low, self.limits.high
        return np.asarray(0.5 * (high + low)), np.asarray(0.5 * (high - low))

    def _offset(self, gene: Array) -> Array:
        """Offsets in [-1, 1] of genes (..., nu): 0.5 is rest, or the nearest to it, 0 and 1 the ends of the range."""
        middle, half = self._range
        rest, away = np.clip(-middle / half, -1.0, 1.0), _fine(2.0 * gene - 1.0)
        return np.asarray(rest + away * np.where(away < 0, 1.0 + rest, 1.0 - rest))

    def _piece(self, g: Array, t: Array) -> Array:
        """Unit inputs (count, nu, n) of the genes (count, nu, 6) of one piece at times (n,)."""
        low, high = np.log(self.hertz)
        f1, f2 = (np.exp(low + g[..., k, None] * (high - low)) for k in (3, 4))
        phase = 2 * np.pi * g[..., 5, None]
        s = (t - t[0]) / max(t[-1] - t[0], self.dt)
        length = max(t[-1] - t[0], self.dt)
        one = np.sin(2 * np.pi * f1 * t + phase)
        ratio = np.log(f2 / f1)
        ratio = np.where(np.abs(ratio) < 1e-6, 1e-6, ratio)
        waves = np.stack(
            [
                np.zeros_like(one),
                np.broadcast_to(2.0 * s - 1.0, one.shape),
                one,
                np.sin(2 * np.pi * f1 * length * np.expm1(ratio * s) / ratio + phase),
                np.where(one >= 0, 1.0, -1.0),
                0.5 * (one + np.sin(2 * np.pi * f2 * t)),
            ]
        )
        kind = (g[..., 0] * len(KINDS)).astype(int)
        wave = np.take_along_axis(waves, kind[None, ..., None], 0)[0]
        return np.asarray(self._offset(g[..., 1])[..., None] + _fine(g[..., 2, None]) * wave)


def _fine(gene: Array) -> Array:
    """Values in [-1, 1] of genes in [-1, 1], with the more room the nearer to 0."""
    return np.asarray(np.sinh(_FINE * gene) / np.sinh(_FINE))


def _gene(value: Array) -> Array:
    """Genes in [-1, 1] of values in [-1, 1]."""
    return np.asarray(np.arcsinh(value * np.sinh(_FINE)) / _FINE)


CAUTIOUS = 0.2  # quantile over draws of the parameters that an experiment is judged by
_MEAN = 0.1
_PARENTS = 8
_SMALLER = 4  # of so many proposals, one is what left the limits, made smaller
_ALIKE = 0.1  # of an experiment's size
_PASSES = 1  # simulated states are without noise: further ones moved expected evidence by less than 0.1 %
_NOTHING = -1e9  # what an experiment is worth that is not finite


# ---- expected --------------------------------------------------------------------------------------------


@final
@dataclass
class Separation:
    """Expected evidence for one member against another."""

    truth: Member  # the member that is true
    other: Member  # the one that is fitted instead

    def __post_init__(self) -> None:
        truth, other = self.truth, self.other
        # how the fit of the other moves with the truth's parameters in the runs there are (k_other, k_truth)
        log = LogWithPrior(other.log.runs, other.theta, other.known)
        both = other.posteriors.cross_information(log, truth.system, other.log.run_in)
        self._follow = np.asarray(np.linalg.solve(other.known, both))
        if len(truth.branches) > 1:  # widths are followed by branches
            self._follow[:, width_columns(truth.vector)] = 0.0
        if len(other.branches) > 1:
            self._follow[width_columns(other.vector)] = 0.0

    def nats(self, states: Array, inputs: Array, thetas: Array) -> Array:
        """Expected evidence (S, C) of experiments in which the truth has parameters `thetas` (S, k).

        Of true states (S, C, N + 1, nx) and inputs (S, C, N, nu).
        """
        b = self.other
        dt = b.log.logged_dt
        near = [nearest(self.truth, theta) for theta in thetas]
        problems = [
            LogWithPrior((as_run(x, u, dt),), self._there(branch, theta, own.theta), branch.known)
            for branch in b.branches
            for theta, own, xs, us in zip(thetas, near, states, inputs, strict=True)
            for x, u in zip(xs, us, strict=True)
        ]
        found = b.posteriors.at_centres(problems, passes=_PASSES)
        left = np.array([b.posteriors.left_by_refit(here) for here in found])
        left = left.reshape(len(b.branches), *states.shape[:2])
        # a width that explains the runs worse has that to make good
        worse = np.array([branch.nats - b.nats for branch in b.branches])[:, None, None]
        nearer = np.array([own.nats - self.truth.nats for own in near])[:, None]
        return np.asarray((left - worse).min(0) + nearer)

    def _there(self, branch: Branch, theta: Array, near: Array) -> Array:
        """Where the other member's fit of the runs there are goes when the truth has some parameters (k,)."""
        a, b = self.truth, self.other
        there = branch.theta + self._follow @ (theta - near)
        if len(a.branches) > 1 and len(b.branches) > 1:
            # runs that leave the widths of both open let a fit have that of the truth, which no branch may have
            width, columns = _width(a, theta), width_columns(b.vector)
            if branch is min(b.branches, key=lambda own: abs(np.log(_width(b, own.theta) / width))):
                there[columns] *= width / _width(b, there)
        return b.vector.inside(there)


@final
@dataclass(frozen=True)
class Precision:
    """Expected standard errors of parameters."""

    member: Member  # physics that has them
    columns: list[int]  # their numbers
    sizes: Array  # what a good standard error is small beside (len(columns),)

    @classmethod
    def of(cls, member: Member, labels: Sequence[str]) -> "Precision":
        """That of the parameters of these labels, or vectors of them, beside what they usually are."""
        v, columns = member.vector, list[int]()
        for label in labels:
            at = [i for i, own in enumerate(v.labels) if own == label or own.startswith(f"{label}[")]
            if not at:
                raise ConfigError(f"`parameters` names {label!r}; the physics has: {', '.join(v.labels)}.")
            columns += at
        return cls(member, columns, np.maximum(v.scale[columns], np.abs(member.theta[columns])))

    def nats(self, states: Array, inputs: Array, thetas: Array) -> Array:
        """How much smaller than these sizes standard errors become (S, C), in the mean; see `Separation.nats`."""
        m, out = self.member, []
        for theta, xs, us in zip(thetas, states, inputs, strict=True):
            runs = [as_run(x, u, m.log.logged_dt) for x, u in zip(xs, us, strict=True)]
            problems = [LogWithPrior((run,), theta, m.known) for run in runs]
            found = m.posteriors.at_centres(problems, passes=_PASSES)
            errors = np.array([here.standard_errors for here in found])[:, self.columns]
            out.append(-np.log(errors / self.sizes).mean(1))
        return np.array(out)


def _width(member: Member, theta: Array) -> float:
    """Geometric mean of the widths of a member."""
    return float(np.exp(np.log(theta[width_columns(member.vector)]).mean()))


def nearest(member: Member, theta: Array) -> Branch:
    """The branch of a member whose widths are the nearest to those of some parameters (k,)."""
    columns = width_columns(member.vector) if len(member.branches) > 1 else []
    away = [float(np.abs(np.log(b.theta[columns] / theta[columns])).sum()) for b in member.branches]
    return member.branches[int(np.argmin(away))]


# ---- search ---------------------------------------------------------------------------------------------


def worth_of(told: Array, axis: int) -> Array:
    """What draws are worth together: the less favourable ones and, where these carry no evidence, a little the mean."""
    return np.asarray(np.quantile(told, CAUTIOUS, axis=axis) + _MEAN * told.mean(axis))


Family = Signals | Paths  # what makes experiments of genes in [0, 1], one array each


@dataclass(frozen=True)
class Judged:
    """What a batch of experiments is worth."""

    worth: Array  # of each (C,); -inf beyond the limits
    told: Array  # the same, whatever the limits; far below 0 where it was not judged
    use: Array  # largest share of each state's range (C, nx), nan where a state is not finite


@final
@dataclass
class Judge:
    """Flies experiments of every member at every draw, and judges them."""

    members: Sequence[Member]  # what may be true
    precision: Precision | None  # what is asked of one member's parameters; None asks which member is true
    limits: ExperimentLimits
    start: Array  # first state (nx,)
    draws: Sequence[Array]  # draws of the parameters of each member (S, k)
    drive: Callable[[Array], Drive]  # makes the inputs of a batch of tables (B, N, m)

    def __post_init__(self) -> None:
        members = self.members
        self._rollouts = [Rollouts(m.system, dt=members[0].log.dt) for m in members]
        self._asked: list[Sequence[Separation | Precision]] = [
            [self.precision] if self.precision else [Separation(a, b) for b in members if b is not a]
            for a in members
        ]

    def flown(self, member: int, tables: Array) -> tuple[Array, Array]:
        """States (S, C, N + 1, nx) and inputs (S, C, N, nu) of experiments (C, N, m) at every draw of a member."""
        draws, c = self.draws[member], len(tables)
        whole = np.tile(tables, (len(draws), 1, 1))
        start, drive = np.tile(self.start, (len(whole), 1)), self.drive(whole)
        x, _, u = self._rollouts[member].run(np.repeat(draws, c, 0), start, drive, tables.shape[1])
        return x.reshape(len(draws), c, *x.shape[1:]), u.reshape(len(draws), c, *u.shape[1:])

    def judge(self, tables: Array) -> Judged:
        """Judge experiments (C, N, m)."""
        uses, each = [], []
        for i in range(len(self.members)):
            states, inputs = self.flown(i, tables)
            uses.append(self.limits.use(states).max(0))
            fine = np.isfinite(states).all((0, 2, 3)) & (uses[-1] < 3.0).all(1)
            for asked in self._asked[i]:
                each.append(np.full((len(self.draws[i]), len(fine)), -np.inf))
                if fine.any():
                    each[-1][:, fine] = asked.nats(states[:, fine], inputs[:, fine], self.draws[i])
        use, table = np.stack(uses).max(0), np.stack(each)
        worth = worth_of(np.maximum(table, _NOTHING), 1).min(0)
        inside = np.nan_to_num(use, nan=np.inf).max(1) <= 1.0 - MARGIN
        return Judged(np.where(inside, worth, -np.inf), worth, use)


def best_of_each(judge: Judge, made: Mapping[str, tuple[Array, tuple[str, ...]]]) -> list[PlannedRun]:
    """The best of each family of experiments (sizes, N, m), with words; without those that all leave the limits.

    All are judged in one batch: a rollout of many costs little more than one of few.
    """
    judged = judge.judge(np.concatenate([tables for tables, _ in made.values()]))
    out, at = [], 0
    for name, (tables, words) in made.items():
        k = at + int(judged.worth[at : at + len(tables)].argmax())
        if np.isfinite(judged.worth[k]):
            out.append(PlannedRun(name, tables[k - at], tuple(words), float(judged.worth[k])))
        at += len(tables)
    return out


def search(
    judge: Judge,
    family: Family,
    *,
    proposals: int,
    generations: int,
    keep: int,
    rng: np.random.Generator,
    say: Say,
) -> tuple[list[PlannedRun], float, Array]:
    """So many experiments to `keep`, the best first, from some rounds of so many `proposals`.

    With them the most evidence of any tried, within the limits or beyond, and the largest share of each state's range
    that this one takes (nx,). Where none stays within the limits, a ConfigError says which is in the way.
    """
    genes = np.concatenate((family.random(proposals, rng), family.gentle(proposals // 4, rng)))
    found: list[tuple[Array, PlannedRun]] = []
    nearest: tuple[float, int] = (np.inf, 0)
    most, widest = -np.inf, np.zeros(0)
    for generation in range(generations + 1):
        say("proposing experiments", generation, generations + 1)
        tables = family.inputs(genes)
        judged = judge.judge(tables)
        for k in np.argsort(-judged.worth):
            if np.isfinite(judged.worth[k]):
                found.append((genes[k], PlannedRun("designed", tables[k], (), float(judged.worth[k]))))
        top = int(judged.told.argmax())
        if judged.told[top] > most:
            most, widest = float(judged.told[top]), judged.use[top]
        over = np.nan_to_num(judged.use, nan=np.inf)
        at = int(over.max(1).argmin())
        nearest = min(nearest, (float(over[at].max()), int(over[at].argmax())))
        found = sorted(found, key=lambda f: -f[1].worth)[: max(4 * _PARENTS, keep)]
        parents = np.stack([g for g, _ in found[:_PARENTS]]) if found else family.gentle(_PARENTS, rng)
        fresh = family.mutated(parents[rng.integers(len(parents), size=proposals)], rng)
        best = found[0][1].worth if found else -np.inf
        genes = np.concatenate((fresh, _within(family, genes, judged, best, proposals // _SMALLER)))
    say("proposing experiments", generations + 1, generations + 1)
    if not found:
        (share, state), limits = nearest, judge.limits
        name, low, high = limits.states[state], limits.floor[state], limits.ceiling[state]
        room = f"limits.{name}=[{low:.4g},{high:.4g}]"
        room += "" if name in limits.given else " (what the runs held)"
        reached = f"takes {share:.0%} of it" if np.isfinite(share) else "leaves it"
        raise ConfigError(
            f"no experiment stays within the limits: what limits it is {room}; the gentlest input tried {reached}, "
            f"where {1 - MARGIN:.0%} is allowed, as the members do not know all. Widen it, start inside of it "
            "(start.NAME=...), or plan a shorter experiment (duration=...)."
        )
    kept: list[PlannedRun] = []
    for g, p in found:
        # rehearsing nearly the same twice says nothing new
        before = [other.table for other in kept]
        new = all(np.linalg.norm(p.table - t) > _ALIKE * np.linalg.norm(t) for t in before)
        if len(kept) < keep and new:
            kept.append(replace(p, words=tuple(family.words(g))))
    return kept, most, widest


def _within(family: Family, genes: Array, judged: Judged, worth: float, most: int) -> Array:
    """Genes of experiments worth more than `worth` that leave the limits, made so small that they may stay inside."""
    use = np.nan_to_num(judged.use, nan=np.inf).max(1)
    left = np.flatnonzero((use > 1.0 - MARGIN) & (use < 3.0) & (judged.told > worth))
    chosen = left[np.argsort(-judged.told[left])][:most]
    return family.shrunk(genes[chosen], (1.0 - 2.0 * MARGIN) / use[chosen])
