"""Whether a loop was closed over the data, and whether the controller saw more than the log holds.

With e_k the innovations of the channels that inputs drive (what a step brings that the fitted physics, the law of the
noise and the past do not predict), and v_k those of the inputs (against their own past), score tests (`signals`) of

- feedback: v_{k+l} on e_k, l = 1, 2, ..., in six bins, one of them surely or all together (Fisher's sum).
- knowledge: e_k on u_k, u_{k-1}, ..., beyond what the parameters and the noise model took out.
- made: v_k on states of rows before, which a controller makes inputs from, whatever its sensors.

Beside these, of directions of the inputs (docs/content/theory/feedback.md):

- other sensors: in a closed loop, those that are a function of the state to a quarter and hardly answer any channel
  which they drive.
- logged: those that the logged rows before explain surely better than the estimates of them do that the filter of a
  likelihood makes: they were made from these rows, noise and all, by no other sensor.
- new: the share that is no function (of second degree) of the logged state. Where it is small in a closed loop, gains
  rest on what was assumed of the noise (Soderstrom, Gustavsson and Ljung, International Journal of Control 21 (1975)).
- between: a controller with sensors and a clock of its own may move its inputs between rows of the log, by half of
  their change from row to row, always to the same side. What it does is a linear function of the states and of the
  inputs of neighbouring rows; an estimate is biased as far as it lies along these.

Assumed, not checked: logged inputs are those that were commanded; the step of the log is the step of the inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import floor, log10
from typing import Any, TypeAlias

import numpy as np
import torch
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sysid import signals
from nsde_torch.sysid.noise import Series, extended
from nsde_torch.sysid.regression import ITERATIONS, Regression, regression_of
from nsde_torch.sysid.signals import Direction
from nsde_torch.systems import System
from nsde_torch.texts import rendered

ALPHA = 0.01  # chance of a finding where there is none, for each of the tests
_ANSWER_S, _ANSWERS = 0.2, 20  # how long after a disturbance an answer is looked for [s], [rows]
_BINS = (1, 2, 3, 5, 9, 14, 21)  # rows between which it is summed up: an answer to what lasts is smooth
_KNOWN_S, _KNOWN = 0.08, 8  # how long before a disturbance an input may have known of it
_OWN = (*range(1, 21), 25, 30, 37, 45, 55, 70, 85, 100)
"""Rows before whose inputs are their own past. What they did longer ago is in the states, and in what the physics lacks
of them: by ten rows, of sines and steps, a car and two springs that nothing controls were in a closed loop
(tests/sysid/test_loop.py::test_sines_and_steps_that_nothing_controls_are_an_open_loop_whatever_is_missing)."""
_OF_A_RUN, _FEWEST_OWN = 0.25, 10  # share of a run, and rows, that the own past takes at most
_STATES_BEFORE = (1, 2, 3, 5)  # rows whose states a controller may have made an input from
_MOVES = 5.0
"""How much more of inputs may move between rows than states are seen to make. By `FACTOR`, a law of a quadrotor's pitch
command was found beside a wind (closed_loop.py --seed 5801, case_05)."""
_MADE = 0.02  # share of an input's innovation that past states predict, from which it was made from states
_FOREKNOWN = 1e-6  # share of an input that is new: below, it is known beforehand and answers nothing
_UPPER = 1.645  # standard deviations of the upper limit of a share
_MOST_OF_IT = 0.8  # share of an answer that defines its time
_PLAYED = 0.75  # share of an input that is no function of the logged state, above which no controller made it
_OWN_ANSWER = 0.02  # share of an input's innovation below which it hardly answers a channel
_NEW = 0.1  # share of an input's variance below which it is nearly a function of the state
_FEWEST = 400  # rows
_NEIGHBOURS = (-2, -1, 0, 1, 2)  # rows of the log whose inputs may have acted
_ROWS_BEFORE, _FITS = 3, 4  # rows that a controller makes an input of, and fits that weigh them
_PARTS = 40  # of a log, whose scatter says what is sure
_ENOUGH = 20_000  # rows
FACTOR = 3.0
"""How much more inputs may know of their own step than they are seen to know of later ones (see `identify`)."""
NO_INPUT = "no input moves"
Past: TypeAlias = tuple[Mask, Array]
"""The rows that have a past (N,), and orthonormal columns of it (of these rows)."""
_SHOWN = 3  # answers that a sentence names


@dataclass(frozen=True)
class Answer:
    """How inputs of one direction answer, or predict, one channel."""

    input: str  # name of the direction
    channel: str
    share: float  # of the variance of the innovation of the input (an answer) or of the channel (knowledge)
    chance: float  # p value, adjusted for the number of tests (Holm)
    within_s: float = 0.0  # time by which most of it has come [s]; 0 where that means nothing
    upper: float = 0.0  # upper 95 % limit of `share`

    def __str__(self) -> str:
        return f"{self.input} predicts {_percent(self.share)} of the innovation of {self.channel}"


@dataclass(frozen=True)
class FeedbackTest:
    """What data say of the loop that they were recorded in."""

    answers: tuple[Answer, ...] = ()  # inputs on what the physics left unexplained before
    knowledge: tuple[Answer, ...] = ()  # innovations on the inputs at and before their step
    new: dict[str, float] = field(default_factory=dict)
    """Share of the inputs that is no function of the logged state, by direction."""
    driven: dict[str, tuple[str, ...]] = field(default_factory=dict)  # channels that each direction drives
    moved: dict[str, tuple[str, ...]] = field(default_factory=dict)  # and those that it moves within a step
    together: float = 1.0  # chance of all answers of inputs to the channels that they drive, if there is none
    rows: int = 0  # number of innovations of each channel
    between: dict[str, float] = field(default_factory=dict)
    """By channel: standard errors by which inputs that move between rows may bias an estimate."""
    still: tuple[str, ...] = ()  # names of inputs that never move
    why_not: str = ""  # why nothing was tested; empty where it was
    smoothed: tuple[str, ...] = ()
    """Channels whose states were smoothed before they were logged, and restored."""
    made: tuple[str, ...] = ()  # directions that past states predict beyond the past of the inputs
    logged: tuple[str, ...] = ()  # directions that were made from the logged rows, by no other sensor

    @property
    def closed(self) -> bool:
        """Whether inputs answer what the physics does not explain."""
        return self.together < ALPHA or any(a.chance < ALPHA for a in self.answers)

    @property
    def open(self) -> bool:
        """Whether nothing speaks for a closed loop: neither answers nor inputs that know more than the log."""
        return not (self.why_not or self.closed or self.predictive)

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
        # what answers nothing, and past states do not predict, no controller made: a propeller that is set, and
        # weather, had "other sensors" in a ship and a room whose other input answered the log
        made = {
            way: own
            for way, own in self.driven.items()
            if self.new.get(way, 0.0) < _PLAYED
            and (way in self.made or any(a.input == way for a in self.answers if a.chance < ALPHA))
        }
        of_log = {
            c
            for way, own in made.items()
            if way in self.logged or any((way, c) in answered for c in self.moved.get(way, own))
            for c in own
        }
        return tuple(dict.fromkeys(c for own in made.values() for c in own if c not in of_log))

    @property
    def not_from_the_log(self) -> tuple[str, ...]:
        """Channels of which inputs know more of a step than the log does, where these were made from states.

        Those of `other_sensors`, and those whose innovations inputs predict, beyond what the physics explains: that of
        a fit without the effects that these data have may be physics, that of the last one has no other name. Sensors
        much better than those of the log show no answers: inputs that were made from states and predict innovations
        were made from such.
        """
        # what answers innovations is a controller's however much of it is new: of a quadrotor flown by noisy sensors of
        # its own, 77 % (delays, lags and dampings that were none were named)
        answers = {a.input for a in self.answers if a.chance < ALPHA and a.share >= _OWN_ANSWER}
        sure = [
            a
            for a in self.knowledge
            if a.chance < ALPHA
            and (self.new.get(a.input, 0.0) < _PLAYED or a.input in answers)
            and a.input not in self.logged
        ]
        surely = {a.input for a in sure}
        if self.closed:
            own = [a.channel for a in sure]
            return tuple(dict.fromkeys((*self.other_sensors, *own)))
        ways = [way for way in self.driven if way in {*self.made, *surely}] if self.made and surely else []
        return tuple(dict.fromkeys(c for way in ways for c in self.driven[way]))

    @property
    def known(self) -> dict[str, float]:
        """By channel: standard errors by which what inputs know of a step beyond the log may bias an estimate.

        Inputs may know `FACTOR` times as much of a step as they may be seen to predict of later ones.
        """
        out, others = dict[str, float](), self.not_from_the_log
        for a in self.knowledge:
            if a.channel in others or a.chance < ALPHA:
                known = FACTOR * float(np.sqrt(self.rows * a.upper))
                out[a.channel] = max(out.get(a.channel, 0.0), known)
        return out

    @property
    def hidden(self) -> dict[str, float]:
        """By channel: the larger one of `known` and of the part from inputs that move between rows (`moving`)."""
        most = self.moving
        for channel, known in self.known.items():
            most[channel] = max(most.get(channel, 0.0), known)
        return most

    @property
    def hidden_from_tests(self) -> dict[str, float]:
        """The part of `hidden` on channels where specification tests cannot separate physics from what inputs know."""
        hidden, smoothed = self.hidden, self.smoothed if self.closed else ()
        return {c: hidden[c] for c in (*self.other_sensors, *smoothed) if c in hidden}

    @property
    def moving(self) -> dict[str, float]:
        """By channel of `other_sensors`: the standard errors of `between`."""
        return {c: self.between.get(c, 0.0) for c in self.other_sensors}

    @property
    def predictive(self) -> bool:
        """Whether inputs predict innovations: a controller that saw more, or an undeclared lag, delay or law."""
        return any(a.chance < ALPHA for a in self.knowledge)

    @property
    def most_known(self) -> str:
        """What inputs surely predict most of, in words; empty if nothing."""
        return next(map(str, _surely(self.knowledge)), "")

    @property
    def functions_of_state(self) -> tuple[str, ...]:
        """Names of directions whose inputs are nearly a function of the logged state, in a closed loop."""
        return tuple(name for name, share in self.new.items() if share < _NEW and self.closed)

    @property
    def findings(self) -> list[str]:
        """What was found, and what follows from it, in words; the first says whether the loop is closed."""
        predictive = _surely(self.knowledge)
        told = {
            "answers": _surely(self.answers),
            "predictive": predictive,
            "lost": [c for c in self.smoothed if c in {a.channel for a in predictive}],
        }
        constants = {"no_input": NO_INPUT, "shown": _SHOWN, "percent": _percent}
        return rendered(__file__, "feedback.txt", test=self, **told, **constants).splitlines()

    def as_dict(self) -> dict[str, Any]:
        return {
            "closed_loop": self.closed_loop,
            "made_from_other_sensors": list(self.other_sensors),
            "inputs_foretell_innovations": self.predictive,
            "functions_of_the_logged_state": list(self.functions_of_state),
            "inputs_that_never_move": list(self.still),
            **({"restored_from_a_smoother": list(self.smoothed)} if self.smoothed else {}),
            "answers": [asdict(a) for a in self.answers],
            "knowledge": [asdict(a) for a in self.knowledge],
            "new_share_of_inputs": dict(self.new),
            "not_tested": self.why_not,
            "findings": self.findings,
        }


@dataclass(frozen=True)
class FilteredLog:
    """What the filter of a likelihood says of each step of a regression."""

    innovations: Mapping[str, Array]
    """By channel (N,): of what each step brought, over their size; 0 where unknown."""
    logged: Array  # states that sensors measured, as logged at the end of each step (N, m)
    noise: Array  # what the filter takes for noise of these (N, m)
    known: Mask  # whether the filter knew of the step (N,)


def _percent(share: float) -> str:
    """Two digits: of an hour of log a ten-thousandth of an innovation is sure, and was said to be 0 %."""
    return f"{share:.{max(0, -1 - floor(log10(max(share, 1e-9))))}%}" if share < 0.1 else f"{share:.0%}"


def _surely(answers: Sequence[Answer]) -> list[Answer]:
    return sorted((a for a in answers if a.chance < ALPHA), key=lambda a: -a.share)


def feedback_summary(system: System, runs: Sequence[Run], clock: float = 1.0) -> FeedbackTest:
    """Test recordings for feedback, against declared physics fitted to them; `why_not` says where that cannot be."""
    if not runs:
        return FeedbackTest(why_not="there is no run")
    why = _smoothed(runs, system.nu)
    if why:
        return FeedbackTest(why_not=why)
    if len(still_inputs(runs, system)) == system.nu:
        return FeedbackTest(still=tuple(system.input_names), why_not=NO_INPUT)
    try:
        regression = regression_of(system, runs, clock=clock)
        regression.run(ITERATIONS)
    except (ConfigError, DataError, NonFiniteError) as error:
        return FeedbackTest(why_not=str(error).rstrip("."))
    return tested(regression, runs, None)


def tested(regression: Regression, runs: Sequence[Run], log: FilteredLog | None) -> FeedbackTest:
    """The test by a regression of runs that has settled, or why there is none.

    By its own innovations, or those of a likelihood.
    """
    system = regression.physics.vector.system
    why = _smoothed(runs, system.nu)
    if why:
        return FeedbackTest(why_not=why)
    restored = {name for run in runs for name in run.band}
    names = [regression.physics.names[channel] for channel in regression.rows]
    smoothed = tuple(name for name in names if name.removesuffix(" (body)") in restored)
    still, series = still_inputs(runs, system), extended(regression.series)
    ways = signals.directions(regression) if len(still) < system.nu else []
    if len(still) == system.nu:
        why = NO_INPUT
    elif not ways:
        why = "no channel is driven by an input alone"
    elif len(series) < _FEWEST:
        why = f"the runs are too short ({len(series)} steps of at least {_FEWEST})"
    if why:
        return FeedbackTest(still=still, why_not=why, smoothed=smoothed)
    u = np.asarray(regression.physics.steps.u[:, : system.nu])
    u = signals.spread_out(regression, signals.box_means(regression, u))
    driven = u @ np.stack([way.weights for way in ways], 1)
    past = own_past(signals.principal(u), series)
    errors = before = regression.white
    if log is not None:
        values = np.stack([log.innovations[regression.physics.names[c]] for c in regression.rows], 1)
        mean = signals.box_means(regression, values) * regression.box**0.5
        errors = signals.spread_out(regression, mean).T
        # inputs within a box may answer its first rows, and know nothing of its last one
        ends = [
            a + np.arange(1, (b - a) // regression.box + 1) * regression.box
            for a, b in regression.single.edges
        ]
        before = signals.spread_out(regression, values[np.concatenate(ends) - 1]).T
    answers, together = _answers_of(regression, errors, ways, driven, past, series)
    made, shares = _made_from_states(regression, ways, driven, past, series)
    return FeedbackTest(
        answers=answers,
        together=together,
        knowledge=_knowledge_of(regression, before, ways, driven, series),
        new=_new_shares(regression, ways, driven, series),
        driven={way.name: tuple(regression.physics.names[c] for c in way.channels) for way in ways},
        moved={way.name: tuple(regression.physics.names[c] for c in way.moved) for way in ways},
        rows=len(regression.series),
        between=lengths(regression, ways, shares),
        made=made,
        logged=_made_of_logged_rows(regression, ways, log) if log is not None and not smoothed else (),
        still=still,
        smoothed=smoothed,
    )


def still_inputs(runs: Sequence[Run], system: System) -> tuple[str, ...]:
    """Names of inputs that never move."""
    moving = np.ptp(np.concatenate([run.u[:, : system.nu] for run in runs]), axis=0)
    return tuple(name for name, size in zip(system.input_names, moving, strict=True) if not size > 0)


def _smoothed(runs: Sequence[Run], nu: int) -> str:
    width = smoothing_width(runs, nu)
    return f"the inputs were smoothed over {width:.2g} s and know the future" if width > 0 else ""


# ---- statistics -------------------------------------------------------------------------------------------


def own_innovations(values: Array, past: Past) -> Array:
    """What columns (N, n) hold that a past does not predict, zero near starts."""
    live, columns = past
    out = np.zeros_like(values)
    out[live] = signals.without(values[live], columns)
    return out


def own_past(among: Array, series: Series) -> Past:
    """The rows that have a past, and orthonormal columns of that of `among` (N, m) and a constant."""
    usual = float(np.median([b - a for a, b in series.edges]))
    lags = [lag for lag in _OWN if lag <= max(_FEWEST_OWN, _OF_A_RUN * usual)]
    live, past = signals.late(series, lags[-1]), series.lagged(among, lags)
    return live, signals.basis_of(np.column_stack((past, np.ones(len(past))))[live])


def _states(regression: Regression) -> Array:
    """Logged states in whitened rows (N, nx), each of variance one."""
    box = regression.box
    first = [a + np.arange((b - a) // box) * box for a, b in regression.single.edges]
    x = np.asarray(regression.physics.steps.seen0)[np.concatenate(first)]
    return signals.spread_out(regression, (x - x.mean(0)) / np.maximum(x.std(0), 1e-12))


def _answers_of(
    regression: Regression,
    errors: Array,
    ways: Sequence[Direction],
    driven: Array,
    past: Past,
    series: Series,
) -> tuple[tuple[Answer, ...], float]:
    """Every answer, and the chance of all own ones together."""
    new = own_innovations(driven, past)
    rows = max(1, min(_ANSWERS, round(_ANSWER_S * regression.pace / regression.dt)))
    live = past[0] & signals.late(series, rows)
    nothing = np.zeros((int(live.sum()), 0))
    of_channel = []
    for i in range(len(regression.rows)):
        columns = series.lagged(errors[i][:, None], range(1, rows + 1))[live]
        scores = signals.score_tests(new[live], signals.binned(columns, _BINS), nothing)
        size = np.square(columns.T @ new[live]) / np.maximum(np.square(columns).sum(0), 1e-300)[:, None]
        of_channel.append((scores, size.cumsum(0)))
    found, own = [], []
    for j, way in enumerate(ways):
        known = signals.foreknown(new[live, j], driven[live, j], _FOREKNOWN)
        for channel, (scores, sizes) in zip(regression.rows, of_channel, strict=True):
            chance, share = (1.0, 0.0) if known else scores[j]
            within = int(np.searchsorted(sizes[:, j], _MOST_OF_IT * sizes[-1, j])) + 1  # rows
            name = regression.physics.names[channel]
            found.append(Answer(way.name, name, share, chance, regression.dt * within))
            own += [chance] if channel in way.channels else []
    statistic = -2.0 * float(np.log(np.maximum(own, 1e-300)).sum())
    return _adjusted(found), float(chdtrc(2 * len(own), statistic)) if own else 1.0


def _made_from_states(
    regression: Regression, ways: Sequence[Direction], driven: Array, past: Past, series: Series
) -> tuple[tuple[str, ...], list[float]]:
    """Names of directions that past states predict beyond the past of the inputs (Granger, Econometrica 37 (1969)).

    And the largest likely share of the innovation of each that they predict.
    """
    live, before = past
    new = signals.without(driven[live], before)
    columns = series.lagged(_states(regression), _STATES_BEFORE)[live]
    scores = signals.score_tests(new, columns, before)
    known = [signals.foreknown(new[:, j], driven[live, j], _FOREKNOWN) for j in range(len(ways))]
    found = [(1.0, 0.0) if k else score for k, score in zip(known, scores, strict=True)]
    chances = signals.holm([chance for chance, _ in found])
    made = tuple(
        way.name
        for way, chance, (_, share) in zip(ways, chances, found, strict=True)
        if chance < ALPHA and share >= _MADE
    )
    return made, [_upper(share, columns.shape[1], int(live.sum())) for _, share in found]


def _upper(share: float, count: int, rows: int) -> float:
    """Upper 95 % limit of a share of the variance of so many rows that so many columns predict."""
    n = max(rows, 1)
    return min(1.0, share + _UPPER * float(np.sqrt(2 * count + 4 * n * share)) / n)


def _made_of_logged_rows(
    regression: Regression, ways: Sequence[Direction], log: FilteredLog
) -> tuple[str, ...]:
    """Names of directions that the logged rows before explain surely better than the filter's estimates of them do.

    Both beside the inputs of the rows before, weighed so that rows in which a command steps count little. What noise of
    the log's own sensors an input answers no other sensor brought; and a controller with its own is explained better by
    the estimates, however much of the innovations is noise or it moves beside a dither. As far as they answer an
    innovation to a hundredth, as was asked before, a pendulum's controller of logged encoders had other ones.
    """
    steps = regression.physics.steps
    u = np.asarray(steps.u[:, : regression.physics.vector.system.nu])
    rows = np.concatenate([np.arange(a + _ROWS_BEFORE, b) for a, b in regression.single.edges])
    rows = rows[np.all([log.known[rows - lag] for lag in range(1, _ROWS_BEFORE + 1)], 0)]
    rows = rows[:: max(1, len(rows) // _ENOUGH)]
    if len(rows) < _FEWEST:
        return ()
    inputs = _before(u, rows)
    both = [
        _standard(np.concatenate((_before(x, rows), inputs), 1)) for x in (log.logged, log.logged - log.noise)
    ]
    found = []
    for way in ways:
        y, weights = u[rows] @ way.weights, np.ones(len(rows))
        for _ in range(_FITS):
            left = y - both[0] @ _least_squares(weights[:, None] * both[0], weights * y)
            usual = max(1.4826 * float(np.median(np.abs(left))), 1e-300)
            weights = (1.0 + np.square(left / usual)) ** -0.5
        size = [
            np.square(weights * y - x @ _least_squares(x, weights * y))
            for x in (weights[:, None] * columns for columns in both)
        ]
        mean = [max(float(s.mean()), 1e-300) for s in size]
        each = 0.5 * (size[1] / mean[1] - size[0] / mean[0]) + 0.5 * np.log(mean[1] / mean[0])
        nats = np.array([part.sum() for part in np.array_split(each, _PARTS)])
        if signals.surely_more(nats):
            found.append(way.name)
    return tuple(found)


def _before(values: Array, rows: Labels) -> Array:
    """Values of the rows before some, and their first and second differences, which span the same (n, 3 m)."""
    one, two, three = (values[rows - lag] for lag in range(1, _ROWS_BEFORE + 1))
    return np.concatenate((one, one - two, one - 2.0 * two + three), 1)


def _standard(columns: Array) -> Array:
    """Columns of mean nothing and size one, and a constant."""
    centred = columns - columns.mean(0)
    return np.column_stack((centred / np.maximum(centred.std(0), 1e-300), np.ones(len(columns))))


def _least_squares(columns: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(columns.T @ columns, columns.T @ values, rcond=1e-13)[0])


def _knowledge_of(
    regression: Regression, errors: Array, ways: Sequence[Direction], driven: Array, series: Series
) -> tuple[Answer, ...]:
    """What inputs at and before a step predict of the innovations of each channel that they drive."""
    rows = max(2, min(_KNOWN, round(_KNOWN_S * regression.pace / regression.dt)))
    live = signals.late(series, rows + 1)
    found, fitted = [], dict[int, Array]()
    for j, way in enumerate(ways):
        columns = series.lagged(driven[:, [j]], range(rows + 1))[live]
        for channel in way.channels:
            i = [*regression.rows].index(channel)
            if i not in fitted:
                fitted[i] = signals.basis_of(regression.fitted_columns(i)[live])
            ((chance, share),) = signals.score_tests(errors[i][live, None], columns, fitted[i])
            found.append(Answer(way.name, regression.physics.names[channel], share, chance))
    n = int(live.sum())
    return tuple(replace(a, upper=_upper(a.share, rows + 1, n)) for a in _adjusted(found))


def _new_shares(
    regression: Regression, ways: Sequence[Direction], driven: Array, series: Series
) -> dict[str, float]:
    """Share of each direction's variance that a quadratic function of the logged state does not give."""
    system = regression.physics.vector.system
    x, live = _states(regression), signals.late(series, 1)
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


def _adjusted(found: Sequence[Answer]) -> tuple[Answer, ...]:
    chances = signals.holm([a.chance for a in found])
    return tuple(replace(a, chance=chance) for a, chance in zip(found, chances, strict=True))


# ---- between rows -----------------------------------------------------------------------------------------


def lengths(regression: Regression, ways: Sequence[Direction], made: Sequence[float]) -> dict[str, float]:
    """What inputs do in whitened rows, times half of their change from row to row over all of their change.

    Of that as much as states may have made: `_MOVES` times what they are seen to make of the innovation of inputs
    (`made`, largest likely shares). Beside a dither that is most of an input a weak controller moves little: of a cart
    behind one, 797 nats of a pole's dry friction counted as what feedback may hide
    (tests/sysid/test_loop.py::test_a_weak_controller_beside_a_dither_hides_little).
    """
    physics, known = regression.physics, [*regression.rows]
    u = np.asarray(physics.steps.u[:, : physics.vector.system.nu])
    later = np.ones(len(u), dtype=bool)
    later[[b - 1 for _, b in regression.single.edges]] = False
    at = np.flatnonzero(later)
    out: dict[str, float] = {}
    for way, most in zip(ways, made, strict=True):
        v = u @ way.weights
        share = 0.5 * float((v[at + 1] - v[at]).std() / max(float(v.std()), 1e-300))
        share *= min(1.0, _MOVES * float(np.sqrt(most)))
        for channel, slope in zip(way.channels, way.slopes, strict=True):
            summed = regression.single.summed((v - v.mean())[:, None], regression.box)
            acts = slope * summed * physics.steps.dt
            white = regression.whitened(regression.noises[known.index(channel)], acts)
            name = physics.names[channel]
            out[name] = float(np.hypot(out.get(name, 0.0), share * np.linalg.norm(white)))
    return out


def leaning(regression: Regression) -> Array:
    """How far the estimate of each parameter lies along what inputs may do between rows, 0 to 1 (channels, k).

    The share, as a length, of what weighs the rows of a channel in the estimate that lies along what inputs do that are
    linear functions of the states and of the inputs of neighbouring rows.
    """
    system, s = regression.physics.vector.system, regression.physics.steps
    x, u = s.x0[:, : system.nx].numpy(), s.u[:, : system.nu].numpy()
    size = 1e-3 * max(float(np.abs(u).max()), 1e-3)
    columns = []  # what such inputs change in each box (M, channels)
    for way in signals.directions(regression):
        slope = signals.input_slopes(regression, way.weights, size, torch.arange(len(s)))
        v = u @ way.weights
        v = v - v.mean()
        changes = [slope * regression.single.shifted(v, by)[:, None] for by in _NEIGHBOURS]
        changes += [slope * own[:, None] for own in (x - x.mean(0)).T]
        columns += [regression.single.summed(change, regression.box) * s.dt for change in changes]
    none = np.zeros((len(regression.series), len(regression.rows), 0))
    acts = np.stack(columns, 2) if columns else none
    out = np.zeros((len(regression.rows), len(regression.vector)))
    for i, weighs in enumerate(signals.row_weights(regression)):
        length = np.linalg.norm(weighs, axis=0)
        along = signals.basis_of(regression.whitened(regression.noises[i], acts[:, i]))
        out[i] = np.linalg.norm(along.T @ weighs, axis=0) / np.where(length > 0, length, np.inf)
    return out
