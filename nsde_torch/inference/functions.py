"""What no declared term explains, as smooth functions of the state on the ports, chosen by held-out likelihood.

    f(x, u; theta) + sum_j B_j g_j(x),      g_j(x) = sum_g Phi_g(x) w_g,      w_g ~ N(0, tau_g^2)

Each function is a column of the likelihood's Gram matrices (`nsde_torch.inference.sensitivity`). A group of functions
(of one variable or of two, coarse or fine) is one candidate with one variance, that of largest marginal likelihood. The
group that explains most of blocks of time that it was not fitted to is added, beside the declared parameters, until
none explains surely anything. Noise levels are then found anew, and the choice goes on: those of the physics alone have
learned a part of the functions. Groups are not fitted where the scores of their forces (`force_scores`) find no trace:
with s those of all weights of a group, the test of tau^2 = 0 that is most powerful near 0 (Lin, Biometrika 84 (1997))
is of

    |s|^2  ~  a chi^2_b       where tau is 0,  a and b by its mean and variance over draws (Satterthwaite)

What an input did before is a group of its own: in a closed loop the state follows from past inputs, and a lag that
nobody declared would else be learned as a function of the state (docs/content/theory/likelihood.md).

The functions are polynomials, also of sign and size, and Gaussian processes in reduced rank,

    f(s) = sum_j w_j sqrt(S(omega_j)) sin(omega_j (s + L)),    omega_j = j pi / 2 L,    S a Matern spectrum

on the range of the data scaled to [-1, 1], L = 1.5 (Solin and Sarkka, Statistics and Computing 30 (2020)). Those of
two variables are products of few waves of each, and f(z_i) z_j with as many waves as a function of one has: a damping
or a gain that changes with the place (varying coefficients; Hastie and Tibshirani, Journal of the Royal Statistical
Society B 55 (1993)). Fine functions of one and of two have more waves and a length of a fifth of half the range; those
of two have the spectrum of the plane, which falls with their joint frequency.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import combinations, groupby, pairwise
from math import inf, log
from typing import Literal, TypeAlias

import numpy as np
import torch
from scipy.linalg import block_diag
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Labels
from nsde_torch.inference.estimate import Optimum
from nsde_torch.inference.filtering import Linearisation, Pass, filtered, forced, with_parameters
from nsde_torch.inference.force_scores import FunctionScores, force_scores
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.maximum import likeliest
from nsde_torch.inference.sensitivity import (
    KNOWN,
    Grams,
    WhitenedRows,
    bounded_step,
    grams,
    inverted,
    rows_of,
    solved,
)
from nsde_torch.inference.state_space import StateSpace
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import named_inputs
from nsde_torch.time_limit import check_time

_FOLDS = 5
# without these two a spring of which nothing is missing learns functions (tests/inference/test_functions.py)
_SURE = 2.0  # standard errors by which a group has to explain blocks left out
_CHANCE = 3.0  # nats beyond the logarithm of the number of groups
MOST_GROUPS = 4  # groups of one row of a port
_ROUNDS = 2  # choices, the second under noise levels found beside the first
_VARIANCES = np.geomspace(1.0, 1e4, 13)  # tau, in units that move the rows by one standard deviation in all
_ROUNDING = 1e-10
# without it a function linear in the speed took a weight of 87 beside a viscous damping, on a spring with quadratic one
_NEW = 0.03  # share of the length of a direction that the declared parameters must leave
_AT_ONCE = 96  # columns of one recursion
# with 4,000 rows and 6 groups the ground effect of blind hexacopter case_000 (seed 8124) is missed
_SCREENED = 8000  # rows on which groups are ranked
_JUDGED = 10  # of the best of these, how many are held against all rows
# without it groups of which nothing is there take four fifths of the time (1.3 of 3 s of a spring, 8 of 60 of a
# hexacopter)
_TRACE = 0.05  # chance of the scores of a group without any effect, above which it is not fitted
_PAIRED = 3  # variables of groups chosen before, and those that explain most alone, whose pairs are tried
# a wave in the plane shows in no coarse function: 0.06 of an oracle's nats without it (odd_spring, seed 8601, case 2)
# up to this number of variables fine functions of two are tried at once; of more where coarse ones were chosen
_FEW = 4
_PAST = (1, 2, 4, 8, 16)  # rows before, of an input


Kind = Literal["polynomial", "signed", "product", "smooth", "fine", "varying", "past"]

_SIGN = 0.05  # of the root mean square: what a sign is rounded over
_REACH = 1.5  # L, of the half range of the data
_ONE, _TWO = 12, 5  # waves of one variable, and of each of two
_FINE, _FINE_LENGTH = 16, 0.2  # waves of each of two where they are fine, and length of their process
_LENGTH = 1.0  # of the Matern process with nu = 3/2, of the half range
EXTENDED: tuple[Kind, ...] = ("polynomial", "signed", "product")
"""Functions that go on beyond the data; waves say nothing about it."""


@dataclass(frozen=True)
class Scale:
    """How a variable is scaled: centre and half of its range, and its root mean square."""

    centre: float
    half: float
    size: float


def functions(
    of: Sequence[str], kind: Kind, values: Mapping[str, Array], scaled: Mapping[str, Scale]
) -> Array:
    """Values (n, q) of the functions of a group at values of the variables (n,).

    Kinds are `polynomial`, `signed` (sign of one, size, and square with its sign; of two, each times the size of the
    other), `product` of both, `smooth`, `fine`, and `varying`: waves of the first one times the second.
    """
    if kind in EXTENDED:
        plain = [values[name] / scaled[name].size for name in of]
        if kind == "product":
            return np.prod(plain, 0)[:, None]
        if kind == "signed" and len(plain) == 2:
            return np.stack((np.abs(plain[0]) * plain[1], plain[0] * np.abs(plain[1])), 1)
        if kind == "signed":
            size = np.abs(plain[0])
            return np.stack((np.tanh(plain[0] / _SIGN), size, plain[0] * size), 1)
        if len(plain) == 1:
            return np.stack([plain[0] ** k for k in (1, 2, 3)], 1)
        a, b = plain
        return np.stack((a * b, a * a * b, a * b * b), 1)
    ranged = [(values[name] - scaled[name].centre) / scaled[name].half for name in of]
    if kind == "varying":
        return _waves(ranged[0], _ONE) * (values[of[1]] / scaled[of[1]].size)[:, None]
    if kind == "fine":
        return _fine(*ranged)
    if len(ranged) == 1:
        return _waves(ranged[0], _ONE)
    first, second = (_waves(s, _TWO) for s in ranged)
    return (first[:, :, None] * second[:, None, :]).reshape(len(first), -1)


def _waves(s: Array, count: int) -> Array:
    """Waves (n, count) whose weights have a prior of one variance."""
    waves, omega = _sines(s, count)
    spectrum = (3.0 / _LENGTH**2 + omega**2) ** -2.0
    return np.asarray(waves * np.sqrt(spectrum / spectrum.sum()))


def _fine(*ranged: Array) -> Array:
    """Products of waves of one or two variables (n, q) up to one joint frequency, with a prior of one variance."""
    waves, omega = zip(*(_sines(s, _FINE) for s in ranged), strict=True)
    squared = reduce(np.add.outer, [w**2 for w in omega])
    at = np.nonzero(squared <= omega[0][-1] ** 2 * (1.0 + 1e-9))
    spectrum = (3.0 / _FINE_LENGTH**2 + squared[at]) ** -(1.5 + 0.5 * len(ranged))
    out = reduce(np.multiply, [w[:, k] for w, k in zip(waves, at, strict=True)])
    return np.asarray(out * np.sqrt(spectrum / spectrum.sum()))


def _sines(s: Array, count: int) -> tuple[Array, Array]:
    """Sines (n, count) that vanish at the ends of [-L, L], and their frequencies (count,)."""
    omega = np.arange(1, count + 1) * np.pi / (2.0 * _REACH)
    waves = np.sin(omega * (np.clip(s, -_REACH, _REACH)[:, None] + _REACH))
    return np.asarray(waves), np.asarray(omega)


@dataclass(frozen=True)
class BasisGroup:
    """Functions that are chosen together."""

    port: int  # number of the disturbance of the likelihood on which they act
    variables: tuple[str, ...]  # what they are functions of: one or two
    kind: Kind
    """See `functions`; `past`: an input some rows before, less what it is now."""


_Gains: TypeAlias = dict[BasisGroup, tuple[float, float]]  # nats of each, and their standard errors


@dataclass(frozen=True)
class Variables:
    """What functions may be of."""

    names: tuple[str, ...]  # names of the variables
    values: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    """Their values (N, len(names)) at states (N, nx) and inputs (N, nu + n)."""
    inputs: Callable[[torch.Tensor], Mapping[str, torch.Tensor]] = lambda _: {}
    """Inputs by name (N,), of inputs (N, nu + n), whose past is looked at."""


def seen_by_networks(system: System) -> Variables:
    """The variables that residual networks of a machine may see."""
    return Variables(
        system.network_names,
        lambda x, u: system.network_features(x[:, : system.nx]),
        lambda u: named_inputs(system, u),
    )


@dataclass(frozen=True)
class Functions:
    """Functions that were chosen."""

    groups: tuple[BasisGroup, ...]
    weights: tuple[Array, ...]  # of the functions of each
    covariance: Array  # of all weights, one after the other
    scaled: Mapping[str, Scale]  # scales of the variables
    theta: Array  # declared parameters beside them
    # held-out log likelihood that the groups of each port's row bring, by number of the disturbance, but for those
    # of the past of inputs
    nats: Mapping[int, float] = field(default_factory=dict)
    error: Mapping[int, float] = field(default_factory=dict)  # its standard error over blocks of time
    lost: tuple[float, ...] = ()  # held-out log likelihood that is lost without each group, as the others are
    blocks: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
    """Log density of each block of time (B,) without and with the functions, each fitted to other blocks."""
    levels: Levels | None = None  # noise levels found beside the functions; None where there are none
    errors: Array = field(default_factory=lambda: np.zeros(1))  # standard errors of theta beside them (k,)

    def importance(self, port: int) -> dict[str, float]:
        """Log likelihood that is lost without the functions of each variable on a row [nats], the most first."""
        out: dict[str, float] = {}
        for group, lost in zip(self.groups, self.lost, strict=True):
            if group.port == port and group.kind != "past":
                for name in group.variables:
                    out[name] = out.get(name, 0.0) + lost
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def force(
        self, values: Mapping[str, Array], port: int, within: Mapping[str, Array] | None = None
    ) -> tuple[Array, Array]:
        """The force (N,) of the functions on one row of a port, and its variance (N,); without what inputs did before.

        Args:
            values: Values of the variables, each (N,).
            port: Number of the disturbance.
            within: The nearest values inside the range of the data: waves stay there, as they say nothing about values
                beyond; polynomials go on, but for those of variables that waves are of too.
        """
        waves = [g for g in self.groups if g.port == port and g.kind not in (*EXTENDED, "past")]
        # what is a polynomial and what are waves is any division of a sum inside the data: of a dry friction of 0.1 N m
        # it went to 2 N m at 1.2 times the range (joints of bench_networks.py, seed 2)
        bound = {name for g in waves for name in g.variables}
        count = len(next(iter(values.values())))
        columns = [np.zeros((count, len(w))) for w in self.weights]
        for k, group in enumerate(self.groups):
            if group.port == port and group.kind != "past" and {*group.variables} <= values.keys():
                on = group.kind in EXTENDED and not bound & {*group.variables}
                at = values if within is None or on else within
                columns[k] = functions(group.variables, group.kind, at, self.scaled)
        if not columns:
            return np.zeros(count), np.zeros(count)
        phi = np.concatenate(columns, 1)
        spread = np.einsum("ni,ij,nj->n", phi, self.covariance, phi).clip(0.0)
        return phi @ np.concatenate(self.weights), spread


@torch.no_grad()
def learned(
    at: Optimum,
    variables: Variables,
    ports: Sequence[int],
    *,
    most: int = MOST_GROUPS,
    among: Sequence[BasisGroup] | None = None,
) -> Functions:
    """Functions that explain what the physics of an optimum does not.

    Args:
        at: The optimum; theta of it is in use.
        ports: Numbers of the disturbances on which functions may act.
        most: Most groups of one row of a port.
        among: Groups to choose from; None takes all that there are.
    """
    return _Choice(at, variables, ports, most, among).made()


@torch.no_grad()
def held_out_density(at: Optimum) -> Array:
    """Log density of each block of time (B,) under parameters that were fitted to others [nats]; theta is in use."""
    return _Choice(at, Variables((), lambda x, u: x[:, :0]), (), 0).density()


class _View:
    """Some chunks of the log, with `most` rows if that is given, and the values of the variables there."""

    def __init__(self, at: Optimum, variables: Variables, most: int | None = None) -> None:
        chunks = at.of.space.chunks
        count = chunks.count
        if most is not None:
            count = min(count, max(_FOLDS, round(most * chunks.count / float(chunks.counted.sum()))))
        self.space, self.about = at.of.space, at.about
        self._passes: list[tuple[Levels, Pass]] = []
        if count < chunks.count:
            some = torch.linspace(0, chunks.count - 1, count).round().long()
            self.space, self.about = self.space.some(some), self.about.of(some)
        else:
            self._passes.append((at.levels, at.at))
        x, u = self.about.x, self.space.chunks.u
        middle = self.space.midway(x, self.about.after)
        flat = variables.values(middle.flatten(0, 1), u.flatten(0, 1)).numpy()
        self.values = {name: np.ascontiguousarray(flat[:, k]) for k, name in enumerate(variables.names)}
        self.past = _past(self.space, variables)
        self.base = self.space.columns(x, self.about.slopes, range(len(self.space.vector)), self.about.after)
        owners, firsts = self.space.chunks.places()
        self.fold = np.empty(len(owners), dtype=np.int64)
        # a stretch of each run: where whole runs are left out, what one alone shows cannot be predicted (a spring that
        # hardens, bench_networks.py seed 3: no functions, in place of all that the law wins)
        for run in np.unique(owners):
            own = np.flatnonzero(owners == run)
            own = own[np.argsort(firsts[own], kind="stable")]
            self.fold[own] = np.arange(len(own)) * _FOLDS // len(own)
        self._turns: tuple[Levels, dict[BasisGroup, Array]] | None = None
        # rows of 200 columns are then 150 MB at most; longer logs are held against ten groups a turn alone
        self._keeps = int(self.space.chunks.counted.sum()) <= 2 * _SCREENED
        self._rows: tuple[tuple[BasisGroup, ...], WhitenedRows, Array] | None = None

    def at(self, levels: Levels) -> Pass:
        """The pass under some noise levels."""
        known = next((at for of, at in self._passes if of is levels), None)
        if known is None:
            known = filtered(self.space, levels, self.about, self.space.chunks.counted)
            self._passes.append((levels, known))
        return known

    def force(self, group: BasisGroup, scaled: Mapping[str, Scale]) -> torch.Tensor:
        """Values of functions at the steps (T, C, q)."""
        if group.kind == "past":
            values = self.past[group.variables[0]]
        else:
            values = functions(group.variables, group.kind, self.values, scaled)
        return torch.from_numpy(values).view(*self.about.x.shape[:2], -1)

    def blocks(
        self, groups: Sequence[BasisGroup], levels: Levels, scaled: Mapping[str, Scale]
    ) -> tuple[Array, list[slice], list[Array]]:
        """Gram matrices by block of [e, theta, groups], columns of each group, and what these are of its functions.

        Directions of a group that the declared parameters can do already are left out: what is left of them is
        rounding, and weights of it could be anything.
        """
        known_turns = self._turns_at(levels)
        rest = [g not in known_turns for g in groups]
        each = [self._turned(g, known_turns, scaled) for g in groups]
        theta = 1 + self.base.shape[-1]
        own = _slices(theta, [force.shape[-1] for force in each])
        held = grams(*self._of(levels), self.base, forces=_on_ports(groups, each))
        known = inverted(held.total[1:theta, 1:theta])
        for g, s in zip(groups, own, strict=True):
            if g not in known_turns:
                known_turns[g] = _new(held.total[s, s], held.total[1:theta, s], known)
        turns = [known_turns[g] for g in groups]

        def turned(values: Array) -> Array:
            """Rows of theta and of the groups (B, n, q) in the directions that these keep (B, n', q)."""
            kept = [
                turn.T @ values[:, s] if new else values[:, s]
                for s, turn, new in zip(own, turns, rest, strict=True)
            ]
            return np.concatenate([values[:, :theta], *kept], 1)

        slices = _slices(theta, [turn.shape[1] for turn in turns])
        if not any(rest):
            return held.blocks, slices, turns
        return turned(turned(held.blocks).transpose(0, 2, 1)), slices, turns

    def beside(
        self,
        groups: Sequence[BasisGroup],
        apart: Sequence[BasisGroup],
        levels: Levels,
        scaled: Mapping[str, Scale],
    ) -> tuple[Array, list[slice], list[tuple[Array, Array]]]:
        """Gram matrices by block and columns of some groups, as `blocks` has them, and what each of others adds.

        Of each of `apart` products with [e, theta, groups] (B, n, q), and of its own (B, q, q). Rows of the groups are
        kept where they are few: what was chosen is soon the larger part of each recursion.
        """
        turns = self._turns_at(levels)
        if any(g not in turns for g in groups):
            self.blocks(groups, levels, scaled)
        theta = 1 + self.base.shape[-1]
        slices = _slices(theta, [turns[g].shape[1] for g in groups])
        each = [self._turned(g, turns, scaled) for g in (*groups, *apart)]
        chosen, further = each[: len(groups)], each[len(groups) :]
        if self._keeps:
            if self._rows is None or self._rows[0] != tuple(groups):
                self._rows = None  # before others take its place
                rows = rows_of(self._of(levels), self.base, _on_ports(groups, chosen))
                self._rows = tuple(groups), rows, rows.blocks
            _, rows, head = self._rows
            pieces = rows.beside([(g.port, force) for g, force in zip(apart, further, strict=True)])
        else:
            first = slices[-1].stop if slices else theta
            parted = _slices(first, [force.shape[-1] for force in further])
            forces = _on_ports([*groups, *apart], each)
            whole = grams(*self._of(levels), self.base, forces=forces, apart=parted).blocks
            head = whole[:, :first, :first]
            pieces = [(whole[:, :first, s], whole[:, s, s]) for s in parted]
        known = inverted(head.sum(0)[1:theta, 1:theta])
        for k, (group, (across, inner)) in enumerate(zip(apart, pieces, strict=True)):
            if group not in turns:
                turns[group] = turn = _new(inner.sum(0), across[:, 1:theta].sum(0), known)
                pieces[k] = across @ turn, turn.T @ inner @ turn
        return head, slices, pieces

    def _of(self, levels: Levels) -> tuple[StateSpace, Levels, Linearisation, Pass]:
        return self.space, levels, self.about, self.at(levels)

    def _turns_at(self, levels: Levels) -> dict[BasisGroup, Array]:
        """What columns under these noise levels are of the functions of each group, where that is known."""
        if self._turns is None or self._turns[0] is not levels:
            self._turns, self._rows = (levels, {}), None
        return self._turns[1]

    def _turned(
        self, group: BasisGroup, turns: Mapping[BasisGroup, Array], scaled: Mapping[str, Scale]
    ) -> torch.Tensor:
        """Values of a group's columns at the steps (T, C, q): of its functions where these are not known."""
        force = self.force(group, scaled)
        return force if group not in turns else force @ torch.from_numpy(turns[group])


@dataclass(frozen=True)
class _Fit:
    groups: tuple[BasisGroup, ...]
    blocks: Array
    slices: list[slice]
    turns: list[Array]  # blocks, slices, turns: see `_View.blocks`
    left: Array  # half the squares left of each block by what was fitted without its fold (B,)
    ridge: list[float]  # 1 / tau^2 of each group


class _Choice:
    """See `learned`."""

    def __init__(
        self,
        at: Optimum,
        variables: Variables,
        ports: Sequence[int],
        most: int,
        among: Sequence[BasisGroup] | None = None,
    ) -> None:
        self._optimum, self._ports, self._most = at, list(ports), most
        self._variables, self._among = variables, among
        self._all = self._few = _View(at, variables)
        self._beside_chosen = at  # what scores are of: with what was chosen under noise levels before
        self._scored: tuple[Optimum, _View] | None = None  # what scores are of, and its rows
        if among is None and self._all.about.x.shape[:2].numel() > _SCREENED:
            self._few = _View(at, variables, _SCREENED)
        counted = at.of.space.chunks.counted.flatten().numpy()
        live = {name: v[counted] for name, v in self._all.values.items()}
        self._scaled = {name: _scale(v) for name, v in live.items() if np.ptp(v) > 1e-9}
        self._levels = at.levels
        self._chances: dict[BasisGroup, float] = {}
        self._inflated: tuple[Levels, float] | None = None

    def made(self) -> Functions:
        """See `learned`."""
        chosen: list[BasisGroup] = []
        for turn in range(_ROUNDS):
            before = len(chosen)
            # noise levels changed where something was found
            for port in self._ports if turn == 0 else sorted({g.port for g in chosen}):
                chosen = self._chosen(port, chosen)
            if not chosen or len(chosen) == before:
                break
            self._levels = self._relevelled(self._solved(self._fitted(chosen)))
        space = self._optimum.of.space
        space.use(space.theta.numpy())  # scores beside what was chosen are at another theta
        return self._judged(self._fitted(chosen))

    def density(self) -> Array:
        """See `held_out_density`."""
        levels = self._optimum.levels
        blocks, _, _ = self._all.blocks([], levels, self._scaled)
        return self._sizes(levels) - self._held_out(self._all, blocks, [])[0]

    # ---- what is tried ----------------------------------------------------------------------------------

    def _chosen(self, port: int, chosen: list[BasisGroup]) -> list[BasisGroup]:
        """Groups chosen so far and those of one port's row."""
        # of quadratic damping and dry friction waves are right within the data, where linear damping makes up for the
        # rest, and wrong beyond (bench_networks.py, springs of seed 2: 0.50 and 0.42 without `signed`)
        kinds: tuple[Kind, ...] = ("polynomial", "signed", "smooth")
        singles = [BasisGroup(port, (name,), kind) for name in self._scaled for kind in kinds]
        singles += [BasisGroup(port, (name,), "past") for name in self._all.past]
        if self._among is not None:
            known = self._scaled.keys() | self._all.past.keys()
            singles = [g for g in self._among if g.port == port and {*g.variables} <= known]
        nothing = {g for g in singles if not self._shows(g)}
        likely = sorted(singles, key=lambda g: self._chances.get(g, 0.0))
        gains: _Gains = {}
        while sum(g.port == port for g in chosen) < self._most:
            tried = [g for g in singles if g not in chosen and g not in nothing]
            before, gains = gains, self._gains_again(tried, chosen, gains)
            ranked = sorted((g for g in gains if g.kind != "past"), key=lambda g: -gains[g][0])
            near = [v for g in chosen if g.port == port and g.kind != "past" for v in g.variables]
            near += [g.variables[0] for g in (*ranked, *likely) if g.kind != "past"]
            near = list(dict.fromkeys(near))[:_PAIRED]
            if self._among is None:
                finer = [g for g in self._finer(port, near, chosen) if g not in nothing and self._shows(g)]
                gains |= self._gains_again(finer, chosen, before)
            # what explains nothing alone is not looked at again
            nothing |= {g for g, (nats, _) in gains.items() if nats <= 0.0}
            among = len(gains)
            gains = {g: won for g, won in gains.items() if g not in nothing}
            judged = gains
            if self._few is not self._all:
                best = sorted(gains, key=lambda g: -gains[g][0])[:_JUDGED]
                judged = self._gains(self._all, best, chosen)
            if not judged:
                break
            best_of = max(judged, key=lambda g: judged[g][0])
            nats, error = judged[best_of]
            # half the square of a score is known to the root of twice itself, where scores scatter as they should: what
            # acts in a few blocks alone scatters over blocks, and is sure (a spring that hardens, 111 +- 55 nats)
            error = min(error, (2.0 * max(nats, 0.0) * self._inflation()) ** 0.5)
            if not (nats > _CHANCE + log(among) and nats > _SURE * error):
                break
            chosen = [*chosen, best_of]
        return chosen

    def _inflation(self) -> float:
        """How far scores of the declared parameters scatter over blocks beyond what they should (`Grams.inflation`)."""
        if self._inflated is None or self._inflated[0] is not self._levels:
            blocks, _, _ = self._all.blocks([], self._levels, self._scaled)
            count = blocks.shape[1] - 1
            self._inflated = self._levels, Grams(blocks, 0, count).inflation(np.arange(count))
        return self._inflated[1]

    def _shows(self, group: BasisGroup) -> bool:
        """Whether scores show any trace of a group; it is not asked where groups are given."""
        if self._among is not None:
            return True
        if group not in self._chances:
            check_time()
            forces = force_scores(self._beside_chosen)
            if self._scored is None or self._scored[0] is not forces.at:
                whole = forces.at is self._beside_chosen
                self._scored = forces.at, self._all if whole else _View(forces.at, self._variables)
            values = self._scored[1].force(group, self._scaled).transpose(0, 1).numpy()
            self._chances[group] = log_chance(forces.of_rows(values, group.port))
        return self._chances[group] < log(_TRACE)

    def _finer(self, port: int, near: Sequence[str], chosen: Sequence[BasisGroup]) -> list[BasisGroup]:
        """Products of all variables, and fine functions of one and smooth ones of two of some of them."""
        out = [BasisGroup(port, (name,), "fine") for name in near]
        # a drag |w| v shows in no product of both (tests/diagnosis/test_own_machines.py)
        products: tuple[Kind, ...] = ("product", "signed")
        out += [BasisGroup(port, pair, kind) for pair in combinations(self._scaled, 2) for kind in products]
        out += [BasisGroup(port, pair, "polynomial") for pair in combinations(near, 2)]
        # a ridge across a plane: 0.33 of an oracle's nats without these (flexible_cases.py, odd_spring, seed 8601)
        pairs = {tuple(sorted(g.variables)) for g in chosen if g.port == port and len(g.variables) == 2}
        pairs |= {tuple(sorted(pair)) for pair in combinations(near, 2) if len(self._scaled) <= _FEW}
        out += [BasisGroup(port, pair, "fine") for pair in sorted(pairs)]
        for a, b in combinations(near, 2):
            out += [BasisGroup(port, (a, b), "varying"), BasisGroup(port, (b, a), "varying")]
        return [g for g in out if g not in chosen]

    def _gains_again(
        self, groups: Sequence[BasisGroup], chosen: Sequence[BasisGroup], before: _Gains
    ) -> _Gains:
        """Held-out nats of each group, exact of the best: what a group brings falls where others are chosen.

        So those that brought less before than the best bring now are left as they were.
        """
        out = self._gains(self._few, [g for g in groups if g not in before], chosen)
        rest = sorted((g for g in groups if g in before), key=lambda g: -before[g][0])
        while rest:
            best = sorted((nats for nats, _ in out.values()), reverse=True)[:_JUDGED]
            if len(best) == _JUDGED and before[rest[0]][0] < best[-1]:
                break
            # what was chosen is a part of each recursion, and soon the larger one
            some = self._at_once(self._few, rest)
            out |= self._gains(self._few, some, chosen)
            rest = rest[len(some) :]
        return out | {g: before[g] for g in rest}

    def _gains(self, view: _View, groups: Sequence[BasisGroup], chosen: Sequence[BasisGroup]) -> _Gains:
        """Held-out nats of each group beside those chosen, and their standard errors."""
        out: _Gains = {}
        rest, before, ridge = groups, np.zeros(0), list[float]()
        while rest:
            check_time()
            some = self._at_once(view, rest)
            rest = rest[len(some) :]
            head, kept, pieces = view.beside(chosen, some, self._levels, self._scaled)
            if not len(before):  # without any of them
                before, ridge = self._held_out(view, head, kept)
            for width in {inner.shape[-1] for _, inner in pieces}:
                alike = [k for k, (_, inner) in enumerate(pieces) if inner.shape[-1] == width]
                across, inner = (np.stack([pieces[k][part] for k in alike]) for part in (0, 1))
                after = self._beside(view, head, kept, ridge, across, inner)[0]
                for k, won in zip(alike, before - after, strict=True):
                    out[some[k]] = float(won.sum()), float(won.std() * len(won) ** 0.5)
        return out

    def _at_once(self, view: _View, groups: Sequence[BasisGroup]) -> Sequence[BasisGroup]:
        """As many of the first groups as one recursion takes, one at least."""
        total = 0
        for count, group in enumerate(groups):
            total += _width(group, view, self._scaled)
            if count and total > _AT_ONCE:
                return groups[:count]
        return groups

    # ---- linear algebra ---------------------------------------------------------------------------------

    def _held_out(
        self, view: _View, blocks: Array, groups: Sequence[slice], known: Sequence[float] = ()
    ) -> tuple[Array, list[float]]:
        """Half the squares left of each block by what was fitted without its fold (B,); 1 / tau^2 of the groups."""
        ridge, total = list(known), blocks.sum(0)
        declared = np.arange(1 + self._optimum.of.space.vector.scale.size)
        for k in range(len(ridge), len(groups)):
            before, own = np.concatenate((declared, _columns(groups[:k]))), groups[k]
            shared, across = total[np.ix_(before, before)], total[before, own]
            ridge += self._ridges(shared, across[None], total[None, own, own]).tolist()
        some = np.concatenate((declared, _columns(groups)))
        head = blocks if len(some) == blocks.shape[1] else blocks[:, some[:, None], some]
        none = head[None, :, :, :0]
        return self._beside(view, head, groups, ridge, none, none[:, :, :0])[0][0], ridge

    def _beside(
        self,
        view: _View,
        head: Array,
        groups: Sequence[slice],
        ridge: Sequence[float],
        across: Array,
        inner: Array,
    ) -> tuple[Array, Array]:
        """The same beside each of G further groups: (G, B), and their 1 / tau^2 (G,).

        What all of them share is solved for once in a fold; each is then a small matrix of its own.

        Args:
            head: Gram matrices of [e, theta, groups] by block (B, n, n).
            across, inner: Products of each further group with these (G, B, n, q), and its own (G, B, q, q).
        """
        theta = 1 + self._optimum.of.space.vector.scale.size
        total, total_across, total_inner = head.sum(0), across.sum(1), inner.sum(1)
        further = self._ridges(total, total_across, total_inner)
        each = np.repeat(np.array(ridge, dtype=float), [s.stop - s.start for s in groups])
        held = np.concatenate((KNOWN * np.diag(total)[1:theta], each))
        weights = np.repeat(further[:, None], across.shape[-1], 1)
        out = np.empty((len(across), len(head)))
        for f in range(_FOLDS):
            inside = view.fold == f
            own, own_across, own_inner = head[inside], across[:, inside], inner[:, inside]
            rest, rest_across = total - own.sum(0), total_across - own_across.sum(1)
            # of e and of the columns of each group, what the shared ones do not explain
            inverse = inverted(rest[1:, 1:] + np.diag(held))
            taken, of_e = inverse @ rest_across[:, 1:], inverse @ rest[1:, 0]
            turned = rest_across[:, 1:].swapaxes(1, 2)
            alone = np.zeros((len(across), 1 + across.shape[-1], 1 + across.shape[-1]))
            alone[:, 1:, 0] = rest_across[:, 0] - turned @ of_e
            alone[:, 1:, 1:] = total_inner - own_inner.sum(1) - turned @ taken
            step = solved(alone, weights)
            less = np.ones((len(across), len(total)))  # what e is less, by what they share
            less[:, 1:] = (taken @ step[..., None])[..., 0] - of_e
            squares = ((less @ own) * less).sum(-1).T
            column = step[:, None, :, None]
            squares -= 2.0 * ((own_across @ column)[..., 0] * less[:, None]).sum(-1)
            out[:, inside] = 0.5 * (squares + ((own_inner @ column)[..., 0] * step[:, None]).sum(-1))
        return out, further

    def _ridges(self, shared: Array, across: Array, inner: Array) -> Array:
        """1 / tau^2 of largest marginal likelihood of groups (G,), each beside [e, theta, ...] (n, n).

        `across` are their products with these (G, n, q), and `inner` their own (G, q, q).
        """
        if not inner.shape[-1]:
            return np.ones(len(inner))
        inverse = inverted(shared[1:, 1:])
        taken = across[:, 1:].swapaxes(1, 2) @ inverse
        left = inner - taken @ across[:, 1:]
        pull = across[:, 0] - taken @ shared[1:, 0]
        value, turned = np.linalg.eigh(left)
        value, along = value.clip(0.0), np.square(turned.swapaxes(1, 2) @ pull[..., None])[..., 0]
        square = np.square(_VARIANCES[:, None]) / value.max(1).clip(1e-100)
        gain = 1.0 + square[..., None] * value
        evidence = (square[..., None] * along / gain).sum(-1) - np.log(gain).sum(-1)
        best = evidence.argmax(0)
        return np.asarray(1.0 / square[best, np.arange(len(inner))])

    def _fitted(self, chosen: Sequence[BasisGroup]) -> _Fit:
        """Some groups together, under the noise levels found so far."""
        blocks, slices, turns = self._all.blocks(chosen, self._levels, self._scaled)
        return _Fit(tuple(chosen), blocks, slices, turns, *self._held_out(self._all, blocks, slices))

    def _solved(self, fit: _Fit) -> Functions:
        """The functions at their most probable weights, beside the declared parameters."""
        space, slices, turns = self._optimum.of.space, fit.slices, fit.turns
        start = np.asarray(space.theta.numpy(), dtype=np.float64)
        if not slices:
            return Functions((), (), np.zeros((0, 0)), self._scaled, start)
        weights = np.zeros(fit.blocks.shape[1] - 1)
        for s, value in zip(slices, fit.ridge, strict=True):
            weights[s.start - 1 : s.stop - 1] = value
        total = fit.blocks.sum(0)
        first = slices[0].start - 1
        joint = inverted(total[1:, 1:] + np.diag(weights))
        whole = block_diag(*turns)
        covariance = whole @ joint[first:, first:] @ whole.T
        errors = np.sqrt(np.diag(joint)[:first].clip(0.0))
        # what parameters and functions can both do is done by either: held as in every fold, and between bounds, beyond
        # which functions made up for it (a damping cut at 0 from below lost all that a spring's friction wins, of 10 h)
        weights[:first] = KNOWN * np.diag(total)[1 : 1 + first]
        low, high = (end - start for end in space.vector.reach(start))
        free = np.full(len(weights) - first, np.inf)
        inner = total[1:, 1:] + np.diag(weights)
        step = bounded_step(inner, total[1:, 0], 0.0, np.append(low, -free), np.append(high, free))
        own = tuple(turn @ step[s.start - 1 : s.stop - 1] for s, turn in zip(slices, turns, strict=True))
        theta = space.vector.inside(start + step[:first])
        return Functions(fit.groups, own, covariance, self._scaled, theta, errors=errors)

    def _judged(self, fit: _Fit) -> Functions:
        """The functions, and what they bring under the noise found beside them."""
        out, chosen, after = self._solved(fit), fit.groups, self._sizes(self._levels) - fit.left
        if not chosen:
            return replace(out, blocks=(after, after))

        def lost(barred: Sequence[BasisGroup]) -> float:
            rest = [k for k, g in enumerate(chosen) if g not in barred]
            some = [fit.slices[k] for k in rest], [fit.ridge[k] for k in rest]
            return max(float((self._held_out(self._all, fit.blocks, *some)[0] - fit.left).sum()), 0.0)

        before = self.density()
        nats, error = float((after - before).sum()), float((after - before).std() * len(after) ** 0.5)
        # what is won in all is divided by what is lost without each
        of_port: dict[int, list[BasisGroup]] = {}
        for g in chosen:
            of_port.setdefault(-1 if g.kind == "past" else g.port, []).append(g)
        share = {port: lost(groups) for port, groups in of_port.items()}
        whole = max(sum(share.values()), 1e-300)
        ports = sorted(share.keys() - {-1})
        won = {k: nats * share[k] / whole for k in ports}
        errors = {k: error * (share[k] / whole) ** 0.5 for k in ports}
        each, blocks = tuple(lost([g]) for g in chosen), (before, after)
        return replace(out, nats=won, error=errors, lost=each, blocks=blocks, levels=self._levels)

    def _sizes(self, levels: Levels) -> Array:
        """Log determinants of the whitening matrices of the innovations of each block (B,)."""
        space, at = self._all.space, self._all.at(levels)
        live = space.chunks.counted[..., None]
        rows = at.rows + 0.5 * torch.where(live, at.white, 0.0).square().sum(-1)
        return space.chunks.blocks(torch.stack([rows[a:b].sum(0) for a, b in space.chunks.parts]))

    def _relevelled(self, found: Functions) -> Levels:
        """Noise levels beside the functions; scores are of what is left by these from then on."""
        space, about = self._optimum.of.space, self._optimum.about
        at = space.theta.numpy().copy()
        space.use(found.theta)
        start = self._optimum.of.start
        about = with_parameters(space, about, start)
        push = torch.zeros_like(about.missed)
        for group, weights in zip(found.groups, found.weights, strict=True):
            force = self._all.force(group, self._scaled) @ torch.from_numpy(weights)
            push += forced(space, about, group.port, force)
        push[-1] = 0.0
        about = replace(about, missed=about.missed + push)
        levels, _, _ = likeliest(space, self._levels, self._levels, about, rows=_SCREENED)
        # all chunks of the likelihood again, which keep the pass beside the functions for themselves
        of = self._optimum.of.some(torch.arange(space.chunks.count))
        passed = filtered(space, levels, about, space.chunks.counted)
        self._beside_chosen = Optimum(of, levels, about, passed, self._optimum.free)
        self._chances = {}
        space.use(at)
        return levels


def log_chance(scores: FunctionScores) -> float:
    """Logarithm of the chance of as large scores of a group of functions where their weights have no variance."""
    drawn = np.square(scores.drawn.sum(0)).sum(0)
    mean, variance = float(drawn.mean()), float(drawn.var())
    if not variance:
        return 0.0
    p = float(chdtrc(2.0 * mean**2 / variance, 2.0 * mean / variance * np.square(scores.total).sum()))
    return log(p) if p else -inf


def _on_ports(groups: Sequence[BasisGroup], each: Sequence[torch.Tensor]) -> list[tuple[int, torch.Tensor]]:
    """Forces of some groups (T, C, q), those of neighbours on the same port as one."""
    pairs = groupby(zip(groups, each, strict=True), lambda pair: pair[0].port)
    return [(port, torch.cat([force for _, force in some], -1)) for port, some in pairs]


def _slices(first: int, widths: Sequence[int]) -> list[slice]:
    """Columns of groups of so many each, behind the first ones."""
    return [slice(a, b) for a, b in pairwise(np.cumsum([first, *widths]).tolist())]


def _columns(groups: Sequence[slice]) -> Labels:
    return np.concatenate([np.arange(0), *(np.arange(s.start, s.stop) for s in groups)])


def _width(group: BasisGroup, view: _View, scaled: Mapping[str, Scale]) -> int:
    if group.kind == "past":
        return len(_PAST)
    some = {name: view.values[name][:1] for name in group.variables}
    return functions(group.variables, group.kind, some, scaled).shape[1]


def _past(space: StateSpace, variables: Variables) -> dict[str, Array]:
    """What inputs were some rows before, less what they are (N, lags), in units of their root mean square."""
    steps, row = space.steps, space.chunks.row.flatten()
    begun = steps.starts[row]
    before = [torch.maximum(row - lag, begun) for lag in _PAST]
    return {
        name: (torch.stack([u[at] - u[row] for at in before], 1) / u.square().mean().sqrt()).numpy()
        for name, u in variables.inputs(steps.u).items()
        if float(np.ptp(u.numpy())) > 1e-9
    }


def _scale(v: Array) -> Scale:
    low, high = float(v.min()), float(v.max())
    return Scale(0.5 * (low + high), 0.5 * (high - low), float(np.sqrt(np.square(v).mean())))


def _new(inner: Array, across: Array, known: Array) -> Array:
    """Directions (q, q') of a group's weights that the declared parameters cannot do already.

    `inner` are products of its functions (q, q), `across` those with the parameters (p, q), `known` these inverted.
    """
    value, along = np.linalg.eigh(inner)
    live = value > _ROUNDING * max(float(value.max()), 1e-300)
    unit = along[:, live] / np.sqrt(value[live])
    share, turned = np.linalg.eigh(unit.T @ (inner - across.T @ known @ across) @ unit)
    return np.asarray(np.linalg.qr(unit @ turned[:, share > _NEW**2])[0])
