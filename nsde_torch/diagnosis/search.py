"""Which effect is missing: candidates fitted one at a time beside the declared physics, the best one added, again.

A round fits every candidate of the catalogue with all declared parameters free, in the weak form with the noise
law of the round (learning.identify). What enters nonlinearly is screened on a grid by one linearised step; the most
promising are iterated. They are ranked by evidence on runs left out (`evidence`), less half the logarithm of the number
of blocks of time for each parameter, so that of two that explain alike the simpler one leads. One is added while its
p value, times the number of candidates, is below alpha and the evidence is positive. Then every effect that was
added is dropped if the others have made it superfluous, or exchanged for one that does better in its place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import log
from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.candidates import candidate_names, make_candidate, starts
from nsde_torch.diagnosis.evidence import Score, folds, p_value, score
from nsde_torch.diagnosis.spectrum import lines
from nsde_torch.effects import EFFECTS, Effect
from nsde_torch.errors import NonFiniteError, NsdeError
from nsde_torch.learning.identify.identify import Regression
from nsde_torch.learning.identify.physics import Physics
from nsde_torch.learning.identify.sizes import data_sizes
from nsde_torch.learning.identify.spread import Spread
from nsde_torch.learning.identify.steps import Steps
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

Array = NDArray[np.float64]

_ITERATIONS = 20
_REFINE = 8  # iterations of a candidate
_WORTH = 6.0  # twice the log likelihood below which a candidate is not iterated
_CLOSE = 0.4  # of the best gain of a screening, above which a candidate is iterated
_FEWEST, _MOST = 4, 10  # candidates that are iterated


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

    @property
    def effect(self) -> Effect:
        """The effect with its fitted values."""
        return fitted_system(self.regression).effects[-1]  # type: ignore[return-value]


@dataclass(frozen=True)
class Base:
    """Where a round starts.

    Args:
        system: Physics so far.
        regression: At its optimum.
        score: On runs left out.
        fold, block: Labels of whitened rows.
        single: Block of each row of `series`.
    """

    system: System
    regression: Regression
    score: Score
    fold: NDArray[np.int64]
    block: NDArray[np.int64]
    single: NDArray[np.int64]
    sure: Spread


@dataclass
class Round:
    """One look at the catalogue.

    Args:
        added: Effects that the physics had already.
        trials: Candidates that were iterated, best first.
        screened: Gain of every candidate at its first step (twice the log likelihood).
        failed: Candidates that could not be fitted, and why.
        chosen: The one that was added, or None.
    """

    added: tuple[str, ...]
    trials: list[Trial]
    screened: dict[str, float]
    failed: dict[str, str] = field(default_factory=dict)
    chosen: Trial | None = None


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


def fitted_system(regression: Regression) -> System:
    """The physics with the values of a regression."""
    return with_values(regression, regression.theta)


def with_values(regression: Regression, theta: Array) -> System:
    """The physics of a regression with some values."""
    source = regression.origin
    assert isinstance(source, System)
    out = source.with_effects()
    regression.vector.write(out, theta)
    return out


@final
class Search:
    """Looks for effects that explain what a system leaves of the data.

    Args:
        steps: The data.
        box: Steps per box.
        alpha: Chance of adding an effect where none is missing.
        candidates: Names to choose from; None takes all that the system may have.
        say: Told what is going on: stage, number done, number in all.
    """

    def __init__(
        self,
        steps: Steps,
        *,
        box: int,
        alpha: float,
        candidates: Sequence[str] | None = None,
        say: Callable[[str, int, int], None] = lambda stage, done, total: None,
    ) -> None:
        self.steps, self.box, self.alpha = steps, box, alpha
        self.candidates, self.say = candidates, say

    def base(self, system: System) -> Base:
        """The regression of a system, with noise laws of its own."""
        regression = self._regression(system)
        regression.run(_ITERATIONS)
        sure, single = regression.spread()
        fold, block = folds(regression), regression.whitened_rows(single)
        return Base(system, regression, score(regression, fold, block), fold, block, single, sure)

    def look(self, base: Base, *, exclude: Sequence[str] = ()) -> Round:
        """Fit and rank the candidates beside the physics of `base`."""
        names = candidate_names(base.system, exclude)
        if self.candidates is not None:
            names = [n for n in names if n in self.candidates]
        out = Round(added=base.system.effect_names, trials=[], screened={})
        peaks = lines(base.regression)
        scales = data_sizes(base.system, self.steps)
        best: dict[str, tuple[System, Array | None]] = {}
        for i, name in enumerate(names):
            self.say("screening effects", i, len(names))
            for start in starts(name, scales, peaks):
                try:
                    system = base.system.with_effects(make_candidate(name, base.system, start))
                    gain = self._screen(base, system, name)
                except (NsdeError, np.linalg.LinAlgError) as error:
                    out.failed[name] = str(error)
                    continue
                if name not in out.screened or gain > out.screened[name]:
                    out.screened[name], best[name] = gain, (system, None)
        order = sorted(best, key=lambda n: -out.screened[n])
        most = out.screened[order[0]] if order else 0.0
        kept = [
            n
            for i, n in enumerate(order[:_MOST])
            if out.screened[n] > _WORTH and (i < _FEWEST or out.screened[n] > _CLOSE * most)
        ]
        for i, name in enumerate(kept):
            self.say("fitting effects", i, len(kept))
            try:
                out.trials.append(self.trial(base, best[name][0], name, among=max(len(names), 1)))
            except (NsdeError, np.linalg.LinAlgError) as error:
                out.failed[name] = str(error)
        out.trials.sort(key=lambda t: -t.rank_score)
        return out

    def trial(self, base: Base, system: System, name: str, *, among: int) -> Trial:
        """Fit a candidate beside the physics of `base`, with noise laws of the same kind."""
        regression = self._regression(system, base)
        regression.run(_REFINE)
        sure, _ = regression.spread()
        this = score(regression, base.fold, base.block)
        own = slice(len(base.regression.vector), len(regression.vector))
        p, _ = p_value(regression, own, sure, base=base.score, this=this)
        difference = this.blocks - base.score.blocks
        price = 0.5 * (this.free - base.score.free) * log(len(difference))
        return Trial(
            name=name,
            regression=regression,
            own=own,
            score=this,
            gain=float(difference.sum()),
            error=float(difference.std(ddof=1) * len(difference) ** 0.5),
            rank_score=float(difference.sum()) - price,
            p=p,
            p_corrected=min(1.0, p * among),
            sure=sure,
        )

    def accept(self, trial: Trial) -> bool:
        """Whether a candidate is there, as far as chance goes."""
        return trial.p_corrected < self.alpha and trial.gain > 0

    # ---- pieces ---------------------------------------------------------------------------------------

    def _regression(self, system: System, base: Base | None = None) -> Regression:
        vector = ParameterVector(system)
        physics = Physics(vector, self.steps, curved=system.sensor_noise)
        rows = dynamic_rows(system)
        if base is None:
            return Regression(physics, box=self.box, rows=rows, origin=system)
        before = base.regression
        physics.sensor_std = before.physics.sensor_std
        start = vector.start.copy()
        start[: len(before.theta)] = before.theta
        return Regression(physics, box=self.box, rows=rows, start=start, noises=before.noises, origin=system)

    def _screen(self, base: Base, system: System, name: str) -> float:
        """Twice the log likelihood that one linearised step from the start of a candidate gains."""
        before = base.regression
        vector = ParameterVector(system)
        physics = Physics(vector, self.steps, curved=False)
        k = len(before.vector)
        theta = vector.inside(np.concatenate((before.theta, vector.start[k:])))
        cls = EFFECTS[name]
        amplitudes = [
            j for j, label in enumerate(vector.labels[k:], k) if _parameter(label) in cls.amplitudes
        ]
        if amplitudes and not vector.moves_memory[amplitudes].any():
            slopes = np.concatenate([physics.slopes(theta, slice(j, j + 1)) for j in amplitudes], 2)
            new = self._whitened(before, slopes)
            residual = before.white.reshape(-1)
            old = before.slopes.reshape(-1, k)
        else:
            physics.sensor_std = before.physics.sensor_std
            physics.curved = system.sensor_noise
            change = before.single.summed(physics.residual(theta), self.box)
            if not np.isfinite(change[:, before.rows]).all():
                raise NonFiniteError(f"{name} is not finite at its start.")
            pairs = list(zip(before.noises, before.rows, strict=True))
            residual = np.stack([n.whiten(change[:, [c]], before.series)[:, 0] for n, c in pairs]).reshape(-1)
            both = self._whitened(before, physics.slopes(theta))
            old, new = both[:, :k], both[:, k:]
        basis, _ = np.linalg.qr(old @ before.shown.basis)
        new = new - basis @ (basis.T @ new)
        rest = residual - basis @ (basis.T @ residual)
        whole = before.white.reshape(-1)
        own = whole - (q := np.linalg.qr(before.slopes.reshape(-1, k) @ before.shown.basis)[0]) @ (
            q.T @ whole
        )
        size = np.linalg.norm(new, axis=0)
        new = new / np.maximum(size, 1e-300)
        step = np.linalg.lstsq(new, rest, rcond=1e-6)[0]
        rest = rest - new @ step
        return float(own @ own - rest @ rest)

    def _whitened(self, before: Regression, slopes: Array) -> Array:
        """Slopes over steps as whitened columns (rows * N, q)."""
        summed = before.single.summed(slopes, self.box)
        pairs = zip(before.noises, before.rows, strict=True)
        return np.concatenate([n.whiten(summed[:, c], before.series) for n, c in pairs])


def _parameter(label: str) -> str:
    return label.partition(".")[2].partition("[")[0]
