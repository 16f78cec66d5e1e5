"""Whether a loop was closed over the data, and whether the controller saw more than the log holds.

With e_k the innovations of the channels that inputs drive (what a step brings that the fitted physics, the law of the
noise and the past do not foretell), and v_k those of the inputs (against their own past):

- feedback: v_{k+l} on e_k, l = 1, 2, ..., in six bins: later inputs answer what the physics does not explain, one of
  them surely or all together (Fisher's sum over the channels that each drives). Then an input is not independent of
  disturbances, and errors of many open-loop steps under logged inputs do not tell what an input does.
- knowledge: e_k on u_k, u_{k-1}, ..., beyond what the parameters and the noise model took out. Inputs that were
  made from the logged states know nothing of e_k. Where they do, either the controller saw more than the log holds
  (a faster rate, other sensors), or the inputs act in a way that is not declared (a lag, a delay): from second
  moments of inputs and states alone the two cannot be told apart, because the same spectra are had with a controller
  that acts on the log and another response (Ljung, System Identification, 1999, section 13.4).
- other sensors: an input that was made from a logged state answers the noise of its sensor too, which is most of an
  innovation. Of a loop that is closed, a direction that is a function of the state to a quarter at least, and hardly
  answers any channel which it drives, was made from something else. On simulated flights the share of the answer was
  0.27 to 0.77 where the controller had the logged measurement, and at most 0.006 where it had a sensor of its own.
- new: the share of the inputs that is no function (of second degree) of the logged state. Where it is small in a closed
  loop, gains rest on what was assumed of the noise (Soderstrom, Gustavsson and Ljung, International Journal of Control
  21 (1975)): with a share of 8 % a simulated gain of 100 came out as 34.

Assumed, not checked: logged inputs are those that were commanded; the step of the log is the step of the inputs.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sysid import between_rows, signals
from nsde_torch.sysid.identify import regression_of
from nsde_torch.sysid.loop_words import FACTOR, NO_INPUT, sentences
from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.regression import ITERATIONS, Regression
from nsde_torch.sysid.series import Series
from nsde_torch.sysid.signals import Direction
from nsde_torch.systems import System

Array = NDArray[np.float64]

ALPHA = 0.01  # chance of a finding where there is none, for each of the tests
_ANSWER_S, _ANSWERS = 0.2, 20  # how long after a disturbance an answer is looked for [s], [rows]
_BINS = (1, 2, 3, 5, 9, 14, 21)  # rows between which it is summed up: an answer to what lasts is smooth
_KNOWN_S, _KNOWN = 0.08, 8  # how long before a disturbance an input may have known of it
_OWN = 10  # order of the inputs' own past
_FOREKNOWN = 1e-6  # share of an input that is new: below, it is known beforehand and answers nothing
_PLAYED = 0.75  # share of an input that is no function of the logged state, above which no controller made it
_OWN_ANSWER = 0.02  # share of what is new in an input, below which it hardly answers a channel
_UPPER = 1.645  # standard deviations of the upper limit of a share
_NEW = 0.1  # share of an input's variance below which it is nearly a function of the state
_FEWEST = 400  # rows
_MOST_OF_IT = 0.8  # share of an answer by whose time it is told


@dataclass(frozen=True)
class Answer:
    """How inputs of one direction answer, or foretell, one channel.

    Args:
        input: Name of the direction.
        channel: Name of the channel.
        share: Of the variance of what is new in the input (an answer) or in the channel (knowledge).
        chance: p value, adjusted for the number of tests (Holm).
        within_s: Time by which most of it has come [s]; 0 where that means nothing.
        upper: Upper 95 % limit of `share`.
    """

    input: str
    channel: str
    share: float
    chance: float
    within_s: float = 0.0
    upper: float = 0.0


@dataclass(frozen=True)
class LoopTest:
    """What data say of the loop that they were recorded in.

    Args:
        answers: Inputs on what the physics left unexplained before.
        knowledge: Innovations on the inputs at and before their step.
        new: Share of the inputs that is no function of the logged state, by direction.
        driven: Channels that each direction drives.
        together: Chance of all answers of inputs to the channels that they drive, if there is none.
        rows: Number of innovations of each channel.
        between: By channel: standard errors by which inputs that move between rows may bend an estimate.
        still: Names of inputs that never move.
        why_not: Why nothing was tested; empty where it was.
        smoothed: Channels whose states were smoothed before they were logged, and restored.
    """

    answers: tuple[Answer, ...] = ()
    knowledge: tuple[Answer, ...] = ()
    new: dict[str, float] = field(default_factory=dict)
    driven: dict[str, tuple[str, ...]] = field(default_factory=dict)
    together: float = 1.0
    rows: int = 0
    between: dict[str, float] = field(default_factory=dict)
    still: tuple[str, ...] = ()
    why_not: str = ""
    smoothed: tuple[str, ...] = ()

    @property
    def closed(self) -> bool:
        """Whether inputs answer what the physics does not explain."""
        return self.together < ALPHA or any(a.chance < ALPHA for a in self.answers)

    @property
    def open(self) -> bool:
        """Whether nothing speaks for a closed loop: neither answers nor inputs that know more than the log."""
        return not (self.why_not or self.closed or self.foretold)

    @property
    def closed_loop(self) -> bool | None:
        """Whether the loop is closed; None where inputs know more than the log, or nothing was tested."""
        return True if self.closed else (False if self.open else None)

    @property
    def other_sensors(self) -> tuple[str, ...]:
        """Channels of a closed loop whose inputs were not made from the logged measurement of that channel."""
        if not self.closed:
            return ()
        answered = {(a.input, a.channel) for a in self.answers if a.chance < ALPHA and a.share >= _OWN_ANSWER}
        made = {way: own for way, own in self.driven.items() if self.new.get(way, 0.0) < _PLAYED}
        from_log = {c for way, own in made.items() if any((way, c) in answered for c in own) for c in own}
        return tuple(dict.fromkeys(c for own in made.values() for c in own if c not in from_log))

    @property
    def not_from_the_log(self) -> tuple[str, ...]:
        """Channels of a closed loop whose inputs know more of a step than the log does.

        Those of `other_sensors`, and those whose innovations inputs foretell, beyond what the physics explains: that of
        a fit without the effects that these data have may be physics, that of the last one has no other name.
        """
        if not self.closed:
            return ()
        played = {way for way, share in self.new.items() if share >= _PLAYED}
        surely = [a.channel for a in self.knowledge if a.chance < ALPHA and a.input not in played]
        return tuple(dict.fromkeys((*self.other_sensors, *surely)))

    @property
    def known(self) -> dict[str, float]:
        """By channel: standard errors by which what inputs know of a step beyond the log may bend an estimate.

        Inputs may know `FACTOR` times as much of a step as they may be seen to foretell of later ones.
        """
        out, others = dict[str, float](), self.other_sensors
        for a in self.knowledge:
            if a.channel in others or a.chance < ALPHA:
                known = FACTOR * float(np.sqrt(self.rows * a.upper))
                out[a.channel] = max(out.get(a.channel, 0.0), known)
        return out

    @property
    def hidden(self) -> dict[str, float]:
        """By channel: the larger one of `known` and of what inputs do that move between rows (`moving`)."""
        most = self.moving
        for channel, known in self.known.items():
            most[channel] = max(most.get(channel, 0.0), known)
        return most

    @property
    def hidden_from_tests(self) -> dict[str, float]:
        """The part of `hidden` on channels of which specification tests cannot tell physics from what inputs know."""
        hidden, smoothed = self.hidden, self.smoothed if self.closed else ()
        return {c: hidden[c] for c in (*self.other_sensors, *smoothed) if c in hidden}

    @property
    def moving(self) -> dict[str, float]:
        """By channel of `other_sensors`: the standard errors of `between`."""
        return {c: self.between.get(c, 0.0) for c in self.other_sensors}

    @property
    def foretold(self) -> bool:
        """Whether inputs foretell innovations: a controller that saw more, or an undeclared lag, delay or law."""
        return any(a.chance < ALPHA for a in self.knowledge)

    @property
    def functions_of_state(self) -> tuple[str, ...]:
        """Names of directions whose inputs are nearly a function of the logged state, in a closed loop."""
        return tuple(name for name, share in self.new.items() if share < _NEW and self.closed)

    @property
    def findings(self) -> list[str]:
        """What was found, and what follows from it, in words."""
        return sentences(self)

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return {
            "closed_loop": self.closed_loop,
            "made_from_other_sensors": list(self.other_sensors),
            "inputs_foretell_innovations": self.foretold,
            "functions_of_the_logged_state": list(self.functions_of_state),
            "inputs_that_never_move": list(self.still),
            **({"restored_from_a_smoother": list(self.smoothed)} if self.smoothed else {}),
            "answers": [asdict(a) for a in self.answers],
            "knowledge": [asdict(a) for a in self.knowledge],
            "new_share_of_inputs": dict(self.new),
            "not_tested": self.why_not,
            "findings": self.findings,
        }


def feedback_summary(system: System, runs: Sequence[Run], clock: float = 1.0) -> LoopTest:
    """Test recordings for feedback, against the declared physics fitted to them.

    Args:
        system: The machine; it is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.

    Returns:
        What was found; `why_not` says where nothing could be tested.
    """
    if not runs:
        return LoopTest(why_not="there is no run")
    why = _smoothed(runs, system.nu)
    if why:
        return LoopTest(why_not=why)
    if len(still_inputs(runs, system)) == system.nu:
        return LoopTest(still=tuple(system.input_names), why_not=NO_INPUT)
    try:
        regression = regression_of(system, runs, clock=clock)
        regression.run(ITERATIONS)
    except (ConfigError, DataError, NonFiniteError) as error:
        return LoopTest(why_not=str(error).rstrip("."))
    return tested(regression, runs)


def tested(regression: Regression, runs: Sequence[Run]) -> LoopTest:
    """The test by a regression of runs that has settled, or why there is none."""
    system = regression.physics.vector.system
    why = _smoothed(runs, system.nu)
    if why:
        return LoopTest(why_not=why)
    restored = {name for run in runs for name in run.band}
    names = [regression.physics.names[channel] for channel in regression.rows]
    smoothed = tuple(name for name in names if name.removesuffix(" (body)") in restored)
    return replace(loop_test(regression, still=still_inputs(runs, system)), smoothed=smoothed)


def still_inputs(runs: Sequence[Run], system: System) -> tuple[str, ...]:
    """Names of inputs that never move."""
    moving = np.ptp(np.concatenate([run.u[:, : system.nu] for run in runs]), axis=0)
    return tuple(name for name, size in zip(system.input_names, moving, strict=True) if not size > 0)


def _smoothed(runs: Sequence[Run], nu: int) -> str:
    width = smoothing_width(runs, nu)
    return f"the inputs were smoothed over {width:.2g} s and know the future" if width > 0 else ""


def loop_test(regression: Regression, *, still: Sequence[str] = ()) -> LoopTest:
    """Test the loop by a fitted regression in weak form.

    Args:
        regression: Where its iteration has settled.
        still: Names of inputs that never move.
    """
    if len(still) == regression.physics.vector.system.nu:
        return LoopTest(still=tuple(still), why_not=NO_INPUT)
    ways = signals.directions(regression)
    series = extended(regression.series)
    if not ways:
        return LoopTest(still=tuple(still), why_not="no channel is driven by an input alone")
    if len(series) < _FEWEST:
        return LoopTest(
            still=tuple(still), why_not=f"the runs are too short ({len(series)} steps of at least {_FEWEST})"
        )
    u = signals.inputs_of(regression)
    driven = u @ np.stack([way.weights for way in ways], 1)
    known = [*regression.rows]
    answers, together = _answers(regression, ways, driven, signals.principal(u), series)
    return LoopTest(
        answers=answers,
        together=together,
        knowledge=_knowledge(regression, ways, driven, known, series),
        new=_new(regression, ways, driven, series),
        driven={way.name: tuple(regression.physics.names[c] for c in way.channels) for way in ways},
        rows=len(regression.series),
        between=between_rows.lengths(regression, ways),
        still=tuple(still),
    )


# ---- the tests --------------------------------------------------------------------------------------------


def own_innovations(values: Array, among: Array, series: Series) -> Array:
    """What columns (N, n) hold that the past of `among` (N, m) does not foretell, zero near starts."""
    live = signals.late(series, _OWN)
    past = signals.lagged(among, series, range(1, _OWN + 1))
    past = np.column_stack((past, np.ones(len(past))))[live]
    out = np.zeros_like(values)
    out[live] = signals.without(values[live], signals.basis_of(past))
    return out


def _answers(
    regression: Regression, ways: Sequence[Direction], driven: Array, among: Array, series: Series
) -> tuple[tuple[Answer, ...], float]:
    """Every answer, and the chance of all own ones together."""
    new = own_innovations(driven, among, series)
    rows = max(1, min(_ANSWERS, round(_ANSWER_S / regression.dt)))
    live = signals.late(series, max(rows, _OWN))
    nothing = np.zeros((int(live.sum()), 0))
    found, own = [], []
    for j, way in enumerate(ways):
        known = signals.foreknown(new[live, j], driven[live, j], _FOREKNOWN)
        for i, channel in enumerate(regression.rows):
            columns = signals.lagged(regression.white[i][:, None], series, range(1, rows + 1))[live]
            score = signals.score_test(new[live, j], signals.binned(columns, _BINS), nothing)
            chance, share = (1.0, 0.0) if known else score
            found.append(
                (way.name, regression.physics.names[channel], share, chance, _within(new[live, j], columns))
            )
            own += [chance] if channel in way.channels else []
    statistic = -2.0 * float(np.log(np.maximum(own, 1e-300)).sum())
    return _judged(found, regression.dt), float(chi2.sf(statistic, 2 * len(own))) if own else 1.0


def _within(new: Array, columns: Array) -> int:
    """Rows by which most of an answer has come."""
    size = np.square(columns.T @ new) / np.maximum(np.square(columns).sum(0), 1e-300)
    return int(np.searchsorted(np.cumsum(size), _MOST_OF_IT * size.sum())) + 1


def _knowledge(
    regression: Regression, ways: Sequence[Direction], driven: Array, known: Sequence[int], series: Series
) -> tuple[Answer, ...]:
    rows = max(2, min(_KNOWN, round(_KNOWN_S / regression.dt)))
    live = signals.late(series, rows + 1)
    found = []
    for j, way in enumerate(ways):
        columns = signals.lagged(driven[:, [j]], series, range(rows + 1))[live]
        for channel in way.channels:
            i = known.index(channel)
            fitted = signals.basis_of(regression.fitted_columns(i)[live])
            chance, share = signals.score_test(regression.white[i][live], columns, fitted)
            found.append((way.name, regression.physics.names[channel], share, chance, 0))
    n, count = max(int(live.sum()), 1), rows + 1
    return tuple(
        replace(a, upper=min(1.0, a.share + _UPPER * float(np.sqrt(2 * count + 4 * n * a.share)) / n))
        for a in _judged(found, regression.dt)
    )


def _first_of_box(regression: Regression) -> NDArray[np.int64]:
    """Row of the steps at which each box begins."""
    parts = [a + np.arange((b - a) // regression.box) * regression.box for a, b in regression.single.edges]
    return np.concatenate(parts)


def _new(
    regression: Regression, ways: Sequence[Direction], driven: Array, series: Series
) -> dict[str, float]:
    """Share of each direction's variance that a quadratic function of the logged state does not give."""
    system = regression.physics.vector.system
    x = np.asarray(regression.physics.steps.seen0)[_first_of_box(regression)]
    x = signals.spread_out(regression, (x - x.mean(0)) / np.maximum(x.std(0), 1e-12))
    live = signals.late(series, 1)
    columns = [np.ones((len(series), 1)), x]
    pairs = system.nx * (system.nx + 1) // 2
    if 20 * pairs < len(series):
        columns.append(np.stack([x[:, i] * x[:, k] for i in range(system.nx) for k in range(i + 1)], 1))
    basis = signals.basis_of(np.concatenate(columns, 1)[live])
    values = driven[live] - driven[live].mean(0)
    left = np.square(signals.without(values, basis)).sum(0)
    return {
        way.name: float(a / b) if b > 0 else 0.0
        for way, a, b in zip(ways, left, np.square(values).sum(0), strict=True)
    }


def _judged(found: Sequence[tuple[str, str, float, float, int]], dt: float) -> tuple[Answer, ...]:
    chances = signals.holm([chance for *_, chance, _ in found])
    rows = zip(found, chances, strict=True)
    return tuple(Answer(a, b, share, chance, dt * within) for (a, b, share, _, within), chance in rows)
