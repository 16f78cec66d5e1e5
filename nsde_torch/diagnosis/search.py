"""Physics fitted to the data of a diagnosis by regression: how it is searched, and what its fit says of parameters."""

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data import Run
from nsde_torch.diagnosis.candidates import of_each_run, on_coordinates
from nsde_torch.diagnosis.decisions import BUDGETS, Budgets, Decisions, Options
from nsde_torch.effects import Effect, Law, effect_class, register
from nsde_torch.errors import NonFiniteError
from nsde_torch.inference.steps import Steps, steps_of
from nsde_torch.progress import Say
from nsde_torch.recording.fault import STAGES, level
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

if TYPE_CHECKING:
    from nsde_torch.diagnosis.joint_selection import FittedPhysics
    from nsde_torch.diagnosis.outcome import Outcome

_AT_BOUND = 2e-6  # typical sizes from a bound; the optimiser keeps values a millionth off it
_EVERYWHERE = 0.95  # of the rows, which are nearly all
_MOVES = 1e-6  # of the largest slope of a parameter: below that is rounding


def dynamic_rows(system: System) -> Labels:
    """Channels that physics moves: not positions, nor a quaternion, which kinematics tie to others."""
    tied = {position for position, _, _ in system.position_derivatives}
    turned = range(system.nx)[system.quaternion or slice(0)]
    kept = [i for i, name in enumerate(system.state_names) if name not in tied and i not in turned]
    return np.array(kept, dtype=np.int64)


def moved_channels(regression: Regression, effect: str) -> tuple[str, ...]:
    """Names of the channels that the parameters of an effect move: whose whitened slopes are not zero."""
    return channels_of(regression, regression.vector.of(effect))


def channels_of(regression: Regression, columns: Sequence[int]) -> tuple[str, ...]:
    """Names of the channels that some parameters move, by number."""
    size = np.linalg.norm(regression.slopes[:, :, columns], axis=1)
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


def nonlinear(vector: ParameterVector) -> Mask:
    """Parameters that say where or how fast an effect sets in, not how strong it is, nor smooth ones (k,)."""
    out = np.zeros(len(vector), dtype=bool)
    effects = {e.name: type(e) for e in vector.system.effects if isinstance(e, Effect)}
    for j, label in enumerate(vector.labels):
        effect, dot, _ = label.partition(".")
        if dot and effects[effect].amplitudes:
            out[j] = own_name(label) not in effects[effect].amplitudes + effects[effect].smooth
    return out


def at_bounds(regression: Regression) -> Mask:
    """Parameters that stand at a bound (k,)."""
    v = regression.vector
    margin = _AT_BOUND * v.scale
    return np.asarray((regression.theta <= v.low + margin) | (regression.theta >= v.high - margin))


def bent_shape(v: ParameterVector, theta: Array, name: str) -> str:
    """Label of a shape of an effect that is at the end of what the data distinguish from another law; empty if none.

    A friction that is developed only beyond the speeds of the data is no dry one, whatever explains the data; a force
    that repeats less than once in a turn does not repeat; and what hardly resonates is no hidden mass (beside dry
    friction one of 1.6 %, damped by 0.8 of the critical damping, was sure, where Dahl's friction was all there was).
    """
    effect = next(e for e in v.system.effects if isinstance(e, Effect) and e.name == name)
    low, high = theta <= v.low + _AT_BOUND * v.scale, theta >= v.high - _AT_BOUND * v.scale

    def bent(j: int) -> bool:
        own = own_name(v.labels[j])
        return bool(
            high[j] or (low[j] and own in effect.ends)
            if own in effect.relative or effect.estimated
            else low[j] and own in effect.shapes and isinstance(effect, Law)
        )

    return next((v.labels[j] for j in v.of(name) if bent(j)), "")


def acts_everywhere(steps: Steps, system: System, name: str) -> bool:
    """Whether a law of one place acts in nearly all rows: a stop that all are beyond is a spring and a steady force.

    It was as likely as the steady force alone, a tie (tests/diagnosis/test_report.py).
    """
    effect = next(e for e in system.effects if isinstance(e, Effect) and e.name == name)
    if not (isinstance(effect, Law) and effect.local):
        return False
    x = steps.x0[:, : system.nx].to(next(effect.parameters()))
    return float((effect.term(0.0, x, x[:, :0], x[:, :0]) != 0).double().mean()) > _EVERYWHERE


def repeats_seldom(search: "Search", vector: ParameterVector, theta: Array, name: str) -> bool:
    """Whether an effect repeats, but too seldom for anybody to know that it does.

    In time, in the longest run (of a knee whose rows at rest were left out no stretch held 1.5 periods of a push, and
    each run 60); or with an angle, within its range: of a boat's heading a ripple of order 2.2 was what a product of
    three variables left, surely.
    """
    steps = search.steps
    rows = np.bincount(steps.runs, [b - a for a, b in steps.segments]).max()
    fewest, seconds = search.decisions.least_periods, float(rows) * steps.dt
    times = [abs(theta[j]) * seconds for j in vector.of(name) if vector.units[j] == "Hz"]
    effect = next(e for e in vector.system.effects if e.name == name)
    if isinstance(effect, Law) and effect.at.position is not None:
        turns = np.ptp(search.steps.x0[:, effect.at.position].numpy()) / (2.0 * np.pi)
        times += [abs(theta[j]) * turns for j in vector.of(name) if own_name(vector.labels[j]) == "order"]
    return bool(min(times, default=fewest) < fewest)


def carried(vector: ParameterVector, before: Regression) -> Array:
    """First values: those of a regression where it has the parameter, else the system's."""
    return vector.first_values(dict(zip(before.vector.labels, before.theta.tolist(), strict=True)))


def without_effect(system: System, declared: System, name: str) -> System:
    """The system without an effect that was added; a declared one that it stood in for is back."""
    left = system.without_effects(name)
    contained = effect_class(name).includes
    back = [e for e in declared.effects if e.name in contained and e.name not in left.effect_names]
    return left.with_effects(*back) if back else left  # type: ignore[arg-type]


# ---- the search ----------------------------------------------------------------------------------------

_BOX_S = 0.01  # over which steps are summed: what the weak form resolves
_SHORTEST = 20  # steps of a stretch that is looked at


@final
class Search:
    """Looks for effects that explain what a system leaves of the data, in runs whose recording chain was undone.

    Args:
        runs: Columns behind the inputs are logged channels (`with_channels`), which the system reads.
        clock: Physical seconds per logged second.
        inputs: Whether the inputs are what acted, and not restored from an average.
        channels: With feedback: what the residuals of all channels predict.
        stages: Stages of the recording chain that found something (`recording.fault`).
        moved: Whether channels that were late have been moved.
        decisions: But for alpha; None takes the options'.

    Attributes:
        box: Steps per box.
        candidates: Names to choose from; None takes all that the system may have.
        shortest: Lag or delay that is named [s]; below, how inputs are held decides.
        feedback: Take out what kinematic residuals predict, where inputs react to sensors (`sysid.noise`).
    """

    def __init__(
        self,
        system: System,
        runs: Sequence[Run],
        clock: float,
        options: Options,
        *,
        inputs: bool = True,
        channels: bool = False,
        stages: Collection[str] = (),
        moved: bool = False,
        decisions: Decisions | None = None,
        budgets: Budgets = BUDGETS,
        say: Say = lambda stage, done, total: None,
        so_far: "Callable[[Outcome], None]" = lambda outcome: None,
    ) -> None:
        self.box = max(1, int(_BOX_S * runs[0].pace / (runs[0].dt * clock) + 1e-6))
        noisy, shortest = system.sensor_noise, max(self.box, _SHORTEST)
        self.steps = steps_of(
            system, runs, clock=clock, denoise=noisy, shortest=shortest, run_in=True, differences=self.box
        )
        self.candidates: Sequence[str] | None = None
        if options.candidates is not None:
            named = on_coordinates(system, (*options.candidates, *map(register, options.also)))
            self.candidates = [*named, *of_each_run(named)]
        decisions = options.decisions if decisions is None else decisions
        self.decisions = replace(decisions.at_pace(runs[0].pace), alpha=options.alpha)
        self.budgets = budgets
        # what an undeclared resonance makes of held inputs may pass for motion between rows; a delay then takes it back
        # (tests/diagnosis/test_hidden_mass.py)
        self.shortest = self.decisions.resolution * self.steps.dt + clock * max(run.ahead for run in runs)
        self.feedback, self.channels = not system.sensor_noise, channels
        self.inputs, self.moved, self._stages = inputs, moved, frozenset(stages)
        self.say, self.so_far = say, so_far
        self._quick: tuple[System, Regression] | None = None

    def level(self, stage: str, *found: str) -> float:
        """Significance level of a stage, after the recording chain and the stages named (`recording.fault.level`)."""
        return level(stage, self.decisions.alpha, self._stages | set(found))

    def levels(self, *found: str) -> dict[str, float]:
        """Significance levels of all stages, after the recording chain and the stages named."""
        return {stage: self.level(stage, *found) for stage in STAGES}

    @property
    def longest(self) -> int:
        """Steps of the longest stretch of the data."""
        return max(b - a for a, b in self.steps.segments)

    def at(self, place: "FittedPhysics") -> Regression:
        """The regression of physics at its values of largest likelihood: the noise models alone are fitted.

        Values of its own would be others where a noise model learns the physics: of racing flights whose states were
        smoothed (NeuroBEM), the thrust was a tenth of the likelihood's.
        """
        system, best = place.system, place.best
        vector = ParameterVector(system)
        physics = Physics(vector, self.steps)
        vector.low, vector.high = best.vector.low, best.vector.high  # those of the rows of the likelihood
        out = self._of(system, physics, start=best.theta, warm=True)
        out.converged = True
        white, rows = out.own_noises(0), len(out.series)
        gained = sum(n.likelihood(rows) for n in white) - sum(n.likelihood(rows) for n in out.noises)
        if gained >= self.budgets.noise_nats:  # a nat for each parameter
            for row, law in enumerate(white):
                out = out.under(row, law)
        return out

    def apart(self, seconds: float) -> "Search":
        """The same search, its regressions over means of so long."""
        out = copy.copy(self)
        out.box = max(self.box, round(seconds / self.steps.dt))
        return out

    def quick(self, system: System) -> Regression:
        """The regression of a system alone, without what candidates are compared by; the last one is kept."""
        if self._quick is None or self._quick[0] is not system:
            regression = self.regression(system)
            try:
                regression.run(self.budgets.iterations)
            except NonFiniteError:
                # it runs away, and is where the likelihood begins and no more: noise of the angles on both sides of a
                # stiff joint was a stiffness 14 times too large, at which its steps diverge
                regression = self.regression(system)
            self._quick = system, regression
        return self._quick[1]

    def regression(
        self, system: System, before: Regression | None = None, held: Collection[str] = ()
    ) -> Regression:
        """A regression that has not run yet, with values and noise models of one `before`, some parameters `held`."""
        physics = Physics(ParameterVector(system), self.steps)
        if before is None:
            return self._of(system, physics, held=held)
        physics.sensor_std = before.physics.sensor_std
        vector = physics.vector
        first = np.where(np.isin(vector.labels, list(held)), vector.start, carried(vector, before))
        return self._of(system, physics, start=first, noises=before.noises, held=held)

    def _of(self, system: System, physics: Physics, **further: Any) -> Regression:
        """A regression of a system; `further` arguments are those of `Regression`."""
        further |= {"feedback": self.feedback, "channels": self.channels}
        further |= {"rows": dynamic_rows(system), "memory_s": self.decisions.noise_memory}
        return Regression(physics, box=self.box, origin=system, **further)
