"""Which effect is missing: candidates fitted one at a time beside the declared physics, the best one added, again.

A round fits every candidate of the catalogue with all declared parameters free, in the weak form with the noise
law of the round (sysid). What enters nonlinearly is screened on a grid by one linearised step; the most
promising are iterated. They are ranked by evidence on runs left out (`evidence`), less half the logarithm of the number
of blocks of time for each parameter, so that of two that explain alike the simpler one leads. One is added while its
p value, times the number of candidates, is below alpha and the evidence is positive. Then every effect that was
added is dropped if the others have made it superfluous, or exchanged for one that does better in its place.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import log, prod
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from nsde_torch.diagnosis.candidates import Start, alone, candidate_names, make_candidate
from nsde_torch.diagnosis.evidence import Score, folds, p_value, score, sum_error
from nsde_torch.diagnosis.spectrum import SWINGS, lines
from nsde_torch.effects import Effect, effect_class
from nsde_torch.errors import NonFiniteError, NsdeError
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.sizes import data_sizes
from nsde_torch.sysid.spread import Spread
from nsde_torch.sysid.steps import Steps
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

Array = NDArray[np.float64]

_ITERATIONS = 20
_MEMORY_S = 1.0  # of noise: what lasts longer is structure
_REFINE = 8  # iterations of a candidate
_LEAST = 0.5  # nats on runs left out that an effect must bring
_WORTH = 6.0  # twice the log likelihood below which a candidate is not iterated
_CLOSE = 0.3  # of the best gain, above which a candidate is iterated
_FEWEST, _MOST = 3, 9  # candidates that are iterated: those that help at least, all at most
_REFINED, _PROMISING = 2, 0.5  # candidates, and share of the best gain, that get noise laws of their own
_TAKEN_OVER = 0.5  # of what a part of an effect is alone: below, another one has taken over
_RESOLVED = 0.5  # steps, the shortest lag or delay that is believed
_SURELY = 1e-3  # chance below which what contains a simpler effect is preferred to it
_MOVES = 1e-6  # of the largest slope of a parameter: below that is rounding
_KIND = 10.0  # nats by which another kind of noise must be likelier to be needed
_NATS, _SURE = 3.0, 2.0  # evidence, and standard errors of it, within which two candidates are alike


@dataclass(frozen=True)
class Trial:
    """A candidate, fitted.

    Args:
        name: Of the effect.
        regression: With it.
        own: Columns of theta that are the effect's.
        score: On runs left out.
        gain: Log likelihood of runs left out beyond that without the effect [nats].
        error: Standard error of `gain`.
        rank_score: What candidates are ranked by.
        p: Chance of so large a gain if the effect did nothing, for one candidate.
        p_corrected: The same for all candidates of the round.
        sure: Covariance from blocks of time, in the directions shown.
        held: Labels of parameters that were held at nothing.
    """

    name: str
    regression: Regression
    own: slice
    score: Score
    gain: float
    error: float
    rank_score: float
    p: float
    p_corrected: float
    sure: Spread
    held: tuple[str, ...] = ()


@dataclass(frozen=True)
class Base:
    """Where a round starts.

    Args:
        system: Physics so far.
        regression: At its optimum.
        score: On runs left out.
        fold, block: Labels of whitened rows.
    """

    system: System
    regression: Regression
    score: Score
    fold: NDArray[np.int64]
    block: NDArray[np.int64]


@dataclass
class Round:
    """One look at the catalogue.

    Args:
        added: Effects that the physics had already.
        trials: Candidates that were iterated, best first.
        screened: Gain of every candidate at its first step (twice the log likelihood).
        errors: By candidate: standard errors of what is nothing without it, by label; infinite where no data show it.
        failed: Candidates that could not be fitted, and why.
        chosen: The one that was added, or None.
    """

    added: tuple[str, ...]
    trials: list[Trial]
    screened: dict[str, float]
    errors: dict[str, dict[str, float]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    chosen: Trial | None = None


def simplest_first(trials: Sequence[Trial]) -> list[Trial]:
    """Candidates in order, what contains another one behind it unless it is surely better."""
    out = list(trials)
    for trial in trials:
        for simple in trials:
            if simple.name not in effect_class(trial.name).includes or out.index(trial) > out.index(simple):
                continue
            more = max((trial.own.stop - trial.own.start) - (simple.own.stop - simple.own.start), 1)
            ratio = 2.0 * (trial.score.fitted - simple.score.fitted)
            if chdtrc(more, max(ratio, 0.0)) > _SURELY or not surely_above(trial, simple):
                out.remove(trial)
                out.insert(out.index(simple) + 1, trial)
    return out


def surely_above(better: Trial, worse: Trial) -> bool:
    """Whether the evidence for one candidate is above that for another by more than chance."""
    difference = better.score.blocks - worse.score.blocks
    return float(difference.sum()) > max(_NATS, _SURE * sum_error(difference))


def dynamic_rows(system: System) -> NDArray[np.int64]:
    """Channels that physics moves: not positions, nor a quaternion, which kinematics tie to others."""
    tied = {position for position, _, _ in system.position_derivatives}
    q = system.quaternion
    kept = [
        i
        for i, name in enumerate(system.state_names)
        if name not in tied and not (q is not None and q.start <= i < q.stop)
    ]
    return np.array(kept, dtype=np.int64)


def moved_channels(regression: Regression, effect: str) -> tuple[str, ...]:
    """Names of the channels that the parameters of an effect move: whose whitened slopes are not zero."""
    size = np.linalg.norm(regression.slopes[:, :, regression.vector.of(effect)], axis=1)
    moves = (size > _MOVES * np.maximum(size.max(0), 1e-300)).any(1)
    names = [regression.physics.names[c] for c in regression.rows]
    return tuple(name for name, m in zip(names, moves, strict=True) if m)


def fitted_system(regression: Regression) -> System:
    """The physics with the values of a regression."""
    source = regression.origin
    assert isinstance(source, System)
    out = source.with_effects()
    regression.vector.write(out, regression.theta)
    return out


def effect_of(system: System, name: str) -> Effect:
    """The effect of a system that has this name."""
    return next(e for e in system.effects if isinstance(e, Effect) and e.name == name)


def _values(effect: Effect) -> dict[str, float | list[float]]:
    return {
        key: value.tolist() if value.numel() > 1 else float(value)
        for key, (value, _) in effect.declared_parameters().items()
    }


def shapes(regression: Regression, *, smooth: bool = True) -> NDArray[np.bool_]:
    """Parameters that say where or how fast an effect sets in, not how strong it is (k,); or not the smooth of them."""
    out = np.zeros(len(regression.vector), dtype=bool)
    effects = {e.name: type(e) for e in regression.vector.system.effects if isinstance(e, Effect)}
    for j, label in enumerate(regression.vector.labels):
        effect, dot, _ = label.partition(".")
        if dot and effects[effect].amplitudes:
            others = effects[effect].amplitudes + (() if smooth else effects[effect].smooth)
            out[j] = own_name(label) not in others
    return out


@final
class Search:
    """Looks for effects that explain what a system leaves of the data.

    Args:
        steps: The data.
        box: Steps per box.
        alpha: Chance of adding an effect where none is missing.
        candidates: Names to choose from; None takes all that the system may have.
        feedback: Take out what kinematic residuals foretell, where inputs react to sensors (`identify.feedback`).
        inputs: Whether the inputs are what acted, and not restored from an average.
        moved: Whether channels that were late have been moved.
        say: Told what is going on: stage, number done, number in all.
    """

    def __init__(
        self,
        steps: Steps,
        *,
        box: int,
        alpha: float,
        candidates: Sequence[str] | None = None,
        feedback: bool = False,
        inputs: bool = True,
        moved: bool = False,
        say: Callable[[str, int, int], None] = lambda stage, done, total: None,
    ) -> None:
        self.steps, self.box, self.alpha = steps, box, alpha
        self.candidates, self.say = candidates, say
        self.held: set[str] = set()
        self.feedback, self.inputs, self.moved = feedback, inputs, moved

    def base(self, system: System, *, warm: bool = False, like: Regression | None = None) -> Base:
        """The regression of a system, with noise laws of its own.

        Args:
            system: Physics.
            warm: Whether its values are near their optimum.
            like: A regression of physics close to it, whose laws may be better than those that are found from nothing.
        """
        regression = self.quick(system, warm=warm)
        fold, block = folds(regression), regression.whitened_rows(regression.blocks)
        regression, own = self._best_noise(regression, system, fold, block, self.held)
        if like is not None:
            other = self._regression(system, like)
            other.run(_REFINE)
            other, this = self._best_noise(other, system, fold, block, self.held)
            if this.fitted > own.fitted:
                regression, own = other, this
        return Base(system, regression, own, fold, block)

    def grown(self, trial: Trial) -> Base:
        """The physics with a candidate that was fitted."""
        return self.base(fitted_system(trial.regression), warm=True, like=trial.regression)

    def quick(self, system: System, *, warm: bool = False) -> Regression:
        """The regression of a system alone, without what candidates are compared by."""
        regression = self._regression(system, warm=warm)
        regression.run(_ITERATIONS)
        return regression

    def beside(self, system: System, like: Regression) -> Regression:
        """The regression of physics that is compared with another one, with noise laws of the same kind.

        Where each had a kind of its own, chosen by chance where there is nothing to choose, that chance would decide
        the comparison. A channel gets another kind where it needs one: to stand in for an effect that is not there.

        Args:
            system: Physics, its values near their optimum.
            like: The regression of the other.
        """
        regression = self._regression(system, like, ParameterVector(system).start)
        regression.run(_ITERATIONS)
        rows = len(regression.series)
        pairs = list(zip(regression.noises, regression.own_noises(), strict=True))
        needed = [law.likelihood(rows) > kept.likelihood(rows) + _KIND for kept, law in pairs]
        if any(needed):
            laws = [pair[n] for pair, n in zip(pairs, needed, strict=True)]
            regression = self._regression(system, regression, regression.theta, laws)
            regression.run(_REFINE)
        return regression

    def _best_noise(
        self,
        regression: Regression,
        system: System,
        fold: NDArray[np.int64],
        block: NDArray[np.int64],
        held: Collection[str],
    ) -> tuple[Regression, Score]:
        """The regression, or one with noise laws of a kind that suits its residuals better; and its score."""
        still = shapes(regression, smooth=False)
        best = score(regression, fold, block, still=still)
        for orders in (None, 0):
            laws = regression.own_noises(orders)
            if (
                _likelihood(laws, len(regression.series))
                < _likelihood(regression.noises, len(regression.series)) + 1
            ):
                continue
            other = self._regression(system, regression, regression.theta, laws, held)
            other.run(_REFINE)
            this = score(other, fold, block, still=still)
            if this.fitted > best.fitted:
                regression, best = other, this
        return regression, best

    def look(self, base: Base, *, only: Collection[str] | None = None) -> Round:
        """Fit and rank the candidates beside the physics of `base`.

        A candidate that contains an effect which was added before stands in for it.

        Args:
            base: Where the round starts.
            only: Candidates to look at; None for all. p values count all.
        """
        names = candidate_names(base.system)
        if self.candidates is not None:
            names = [n for n in names if n in self.candidates]
        among = max(len(names), 1)
        if only is not None:
            names = [n for n in names if n in only]
        out = Round(added=base.system.effect_names, trials=[], screened={})
        peaks, scales = lines(base.regression), data_sizes(base.system, self.steps)
        frequencies = [peak.frequency for peak in peaks]
        where: dict[str, tuple[System, tuple[str, ...]]] = {}
        for i, name in enumerate(names):
            self.say("screening effects", i, len(names))
            for start in self._starts(base.system, name, scales, frequencies):
                system = self._joined(base.system, name, start)
                vector = ParameterVector(system)
                labels = [vector.labels[j] for j in vector.of(name)]
                for held in alone(name, labels):
                    try:
                        gain, errors = self._screen(base, system, name, held)
                    except (NsdeError, np.linalg.LinAlgError) as error:
                        out.failed[name] = str(error)
                        continue
                    if name not in out.screened or gain > out.screened[name]:
                        out.screened[name], where[name] = gain, (system, held)
                        out.errors[name] = errors
        # from without what it contains, a first step says nothing of a candidate that stands in for it
        sure = [n for n in where if set(effect_class(n).includes) & set(base.system.effect_names)]
        # nor of what swings at a line of the spectrum: the law of the noise has learned the line
        if peaks and peaks[0].p < self.alpha:
            sure += [n for n in where if _swings(n)]
        rest = sorted((n for n in where if n not in sure), key=lambda n: -out.screened[n])
        order = [*sure, *(n for n in rest if out.screened[n] > _WORTH)]
        helped = 0
        for i, name in enumerate(order):
            best_yet = max((2.0 * t.gain for t in out.trials), default=0.0)
            enough = helped >= _FEWEST and out.screened[name] < _CLOSE * best_yet
            # what is part of a candidate that was fitted may do as well as it
            part = any(name in effect_class(t.name).includes for t in out.trials)
            if (enough or i >= _MOST) and name not in sure and not part:
                continue  # a first step says roughly what a candidate is worth
            self.say("fitting effects", i, min(len(order), _MOST))
            system, held = where[name]
            try:
                trial = self.trial(base, system, name, among=among, held=held)
            except (NsdeError, np.linalg.LinAlgError) as error:
                out.failed[name] = str(error)
                continue
            out.trials.append(trial)
            helped += trial.gain > 0 and name not in sure
        out.trials.sort(key=lambda t: -t.rank_score)
        best_gain = out.trials[0].gain if out.trials else 0.0
        for i, trial in enumerate(out.trials):
            if i < _REFINED or trial.gain > _PROMISING * best_gain:
                self.say("comparing effects", i, len(out.trials))
                out.trials[i] = self._finished(base, trial, among)
        out.trials = simplest_first(sorted(out.trials, key=lambda t: -t.rank_score))
        return out

    def _starts(
        self, system: System, name: str, scales: Mapping[str, float], frequencies: Sequence[float]
    ) -> list[Start]:
        """Values that fits of a candidate start from; what it contains lends it the shapes that both have."""
        cls = effect_class(name)
        starts = cls.starts(scales, frequencies)
        for effect in system.effects:
            assert isinstance(effect, Effect)
            if effect.name not in cls.includes:
                continue
            lent = {key: value for key, value in _values(effect).items() if key in cls.shapes}
            starts += [{**start, **lent} for start in starts] if lent else []
        return starts

    def reshaped(self, base: Base, name: str, like: Trial) -> Base:
        """The physics with one of its effects fitted again from the shapes that another one of its kind has found."""
        system = base.system
        own, other = (
            effect_of(s, n) for s, n in ((system, name), (fitted_system(like.regression), like.name))
        )
        lent = {k: v for k, v in _values(other).items() if k in type(own).shapes}
        start = {**_values(own), **lent}
        joined = self._joined(system.without_effects(name), name, start)
        return self.base(joined, warm=True, like=base.regression)

    def shared(self, without: Base, own: Trial, name: str, *, among: int) -> Trial | None:
        """Another effect that takes over a part of one that was found, beside the rest of it; None where it does not.

        Args:
            without: The physics without the effect.
            own: The effect.
            name: Of the other.
            among: Number of candidates.
        """
        effect = type(effect_of(fitted_system(own.regression), own.name))
        alone = dict(zip(own.regression.vector.labels, own.regression.theta.tolist(), strict=True))
        joint = self.quick(self._joined(fitted_system(own.regression), name, {}), warm=True)
        strong = [
            j
            for j in joint.vector.of(own.name)
            if own_name(joint.vector.labels[j]) in (*effect.amplitudes, *effect.smooth)
        ]
        gone = [
            j
            for j in strong
            if own_name(joint.vector.labels[j]) in effect.smooth
            or abs(joint.theta[j]) < _TAKEN_OVER * abs(alone[joint.vector.labels[j]])
        ]
        if not 0 < len(gone) < len(strong):
            return None
        theta = joint.theta.copy()
        theta[gone] = 0.0
        rest = fitted_system(joint)
        joint.vector.write(rest, theta)
        held = tuple(joint.vector.labels[j] for j in gone)
        return self.trial(without, rest, name, among=among, held=held)

    def _joined(self, system: System, name: str, start: Start) -> System:
        """The system with a candidate, without what the candidate contains."""
        contained = set(effect_class(name).includes) & set(system.effect_names)
        if contained:
            system = system.without_effects(*contained)
        return system.with_effects(make_candidate(name, system, start))

    def trial(
        self, base: Base, system: System, name: str, *, among: int, held: tuple[str, ...] = ()
    ) -> Trial:
        """Fit a candidate beside the physics of `base`, with noise laws of the same kind.

        Args:
            base: What it is compared with.
            system: Physics with the candidate.
            name: Of the candidate.
            among: Number of candidates.
            held: Labels of its parameters that stay at nothing.
        """
        regression = self._regression(system, base.regression, held=held)
        regression.run(_REFINE)
        if _swings(name):
            regression, this = self._best_noise(regression, system, base.fold, base.block, held)
        else:
            this = score(regression, base.fold, base.block, still=shapes(regression, smooth=False))
        return self._judged(base, regression, this, name, among, held)

    def _finished(self, base: Base, trial: Trial, among: int) -> Trial:
        """The candidate with noise laws of its own kind, if they are better.

        A law that had to stand for the effect has more orders than the noise alone.
        """
        system = trial.regression.origin
        assert isinstance(system, System)
        regression, this = self._best_noise(trial.regression, system, base.fold, base.block, trial.held)
        return self._judged(base, regression, this, trial.name, among, trial.held)

    def _judged(
        self,
        base: Base,
        regression: Regression,
        this: Score,
        name: str,
        among: int,
        held: tuple[str, ...],
    ) -> Trial:
        still = shapes(regression)
        sure = regression.spread()
        labels = regression.vector.labels
        mine = regression.vector.of(name)
        tested = ~still
        tested[[j for j in range(len(labels)) if j not in mine]] = False
        p = p_value(regression, tested, sure, base=base.score, this=this)
        difference = this.blocks - base.score.blocks
        price = 0.5 * (len(mine) - len(held)) * log(len(difference))
        return Trial(
            name=name,
            regression=regression,
            own=slice(mine[0], mine[-1] + 1),
            score=this,
            gain=float(difference.sum()),
            error=sum_error(difference),
            rank_score=float(difference.sum()) - price,
            p=p,
            p_corrected=min(1.0, p * among * self._tries(name, labels[mine[0] : mine[-1] + 1])),
            sure=sure,
            held=held,
        )

    def _tries(self, name: str, labels: Sequence[str]) -> float:
        """How many starts the best of which was taken: frequencies of the spectrum, or shapes, each for every input."""
        if _swings(name):
            return max(1.0, 0.5 * max(b - a for a, b in self.steps.segments))
        return float(
            prod(len(grid) for grid in effect_class(name).shapes.values()) * len(alone(name, labels))
        )

    def accept(self, trial: Trial) -> bool:
        """Whether a candidate is there, as far as chance goes and the step of the data can tell."""
        return self._sure(trial) and not self._short(trial) and self._swings_back(trial)

    def fraction(self, trials: Sequence[Trial]) -> Trial | None:
        """The candidate that explains most, if it is a time shorter than a step: there, but nothing to name."""
        sure = [t for t in trials if self._sure(t) and self._swings_back(t)]
        best = max(sure, key=lambda t: t.gain, default=None)
        return best if best is not None and self._short(best) else None

    def _sure(self, trial: Trial) -> bool:
        return trial.p_corrected < self.alpha and trial.gain > _LEAST

    def _short(self, trial: Trial) -> bool:
        """Whether a time is a mere fraction of a step: below one, how inputs are held between samples decides."""
        vector, theta = trial.regression.vector, trial.regression.theta
        own = range(len(vector))[trial.own]
        times = [j for j in own if vector.moves_memory[j] and vector.units[j] == "s"]
        return any(theta[j] < _RESOLVED * self.steps.dt for j in times)

    def _swings_back(self, trial: Trial) -> bool:
        """Whether a swing comes back within a run; what is slower than a run is long is no swing."""
        vector, theta = trial.regression.vector, trial.regression.theta
        longest = max(b - a for a, b in self.steps.segments) * self.steps.dt
        swings = [j for j in range(len(vector))[trial.own] if vector.units[j] == "Hz"]
        return all(theta[j] * longest >= SWINGS for j in swings)

    # ---- pieces ---------------------------------------------------------------------------------------

    def _regression(
        self,
        system: System,
        before: Regression | None = None,
        start: Array | None = None,
        noises: Sequence[Noise] | None = None,
        held: Collection[str] = (),
        warm: bool = False,
    ) -> Regression:
        vector = ParameterVector(system)
        physics = Physics(vector, self.steps)
        rows, still = dynamic_rows(system), {*held, *self.held}
        if before is None:
            return Regression(
                physics,
                box=self.box,
                rows=rows,
                origin=system,
                held=still,
                feedback=self.feedback,
                warm=warm,
                memory_s=_MEMORY_S,
            )
        physics.sensor_std = before.physics.sensor_std
        laws = before.noises if noises is None else noises
        first = _carried(vector, before) if start is None else start
        return Regression(
            physics,
            box=self.box,
            rows=rows,
            start=first,
            noises=laws,
            origin=system,
            held=still,
            feedback=self.feedback,
            memory_s=_MEMORY_S,
        )

    def _screen(
        self, base: Base, system: System, name: str, held: Sequence[str]
    ) -> tuple[float, dict[str, float]]:
        """Twice the log likelihood that one linearised step from the start of a candidate gains; standard errors."""
        before = base.regression
        vector = ParameterVector(system)
        physics = Physics(vector, self.steps)
        theta = vector.inside(_carried(vector, before))
        cls = effect_class(name)
        mine = vector.of(name)
        moved = [
            j for j in mine if own_name(vector.labels[j]) in cls.amplitudes and vector.labels[j] not in held
        ]
        beside = len(vector) == len(before.vector) + len(mine)
        old = before.slopes.reshape(-1, len(before.vector)) @ before.shown.basis
        whole = before.white.reshape(-1)
        residual = whole
        if beside and moved and not vector.moves_memory[moved].any():
            slopes = np.concatenate([physics.slopes(theta, slice(j, j + 1)) for j in moved], 2)
            new, columns = self._whitened(before, slopes), moved
        else:
            change = before.single.summed(physics.residual(theta), self.box)
            if not np.isfinite(change[:, before.rows]).all():
                raise NonFiniteError(f"{name} is not finite at its start.")
            pairs = zip(before.noises, before.rows, strict=True)
            residual = np.stack([before.whitened(n, change[:, [c]])[:, 0] for n, c in pairs]).reshape(-1)
            columns = [j for j in range(len(vector)) if vector.labels[j] not in {*held, *self.held}]
            new = self._whitened(before, physics.slopes(theta))[:, columns]
        basis = np.linalg.qr(old)[0]
        before_left = whole - basis @ (basis.T @ whole)
        if beside:
            residual = residual - basis @ (basis.T @ residual)
            new = new - basis @ (basis.T @ new)
        size = np.linalg.norm(new, axis=0)
        new = new / np.maximum(size, 1e-300)
        rest = residual - new @ np.linalg.lstsq(new, residual, rcond=1e-6)[0]
        sizes = cls.amplitudes or cls.null
        live = [i for i, j in enumerate(columns) if j in mine and own_name(vector.labels[j]) in sizes]
        live = live if beside else []  # what the others could do instead was not taken out
        labels = [vector.labels[columns[i]] for i in live]
        errors = dict(zip(labels, standard_errors(new, size, live), strict=True))
        return float(before_left @ before_left - rest @ rest), errors

    def _whitened(self, before: Regression, slopes: Array) -> Array:
        """Slopes over steps as whitened columns (rows * N, q)."""
        summed = before.single.summed(slopes, self.box)
        pairs = zip(before.noises, before.rows, strict=True)
        return np.concatenate([before.whitened(n, summed[:, c]) for n, c in pairs])


def standard_errors(columns: Array, size: Array, which: Sequence[int]) -> list[float]:
    """Standard errors of some coefficients beside each other, under noise of variance 1.

    Args:
        columns: Columns (N, q) of length 1, or of length 0.
        size: What they were divided by (q,).
        which: Numbers of the coefficients; others than these are not free.

    Returns:
        One per coefficient, infinite where its column is nothing beside the others.
    """
    part = columns[:, which]
    inverse = np.linalg.pinv(part.T @ part, rcond=1e-9)
    gone = 1.0 - np.diag(inverse @ (part.T @ part)) > 1e-6
    dead = gone | (size[which] <= 1e-9 * max(float(size.max(initial=0.0)), 1e-300))
    error = np.sqrt(np.clip(np.diag(inverse), 0.0, None)) / np.maximum(size[which], 1e-300)
    return np.where(dead, np.inf, error).tolist()


def _swings(name: str) -> bool:
    """Whether a candidate has a frequency of its own."""
    return "spectrum" in effect_class(name).relative.values()


def _likelihood(laws: Sequence[Noise], rows: int) -> float:
    """Log likelihood of residuals under laws that were fitted to them, less one per parameter of the laws."""
    return sum(n.likelihood(rows) for n in laws)


def _carried(vector: ParameterVector, before: Regression) -> Array:
    """First values: those of a regression where it has the parameter, else the system's."""
    known = dict(zip(before.vector.labels, before.theta.tolist(), strict=True))
    return np.array(
        [known.get(label, v) for label, v in zip(vector.labels, vector.start.tolist(), strict=True)]
    )
