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
- made: v_k on states of rows before, which a controller makes inputs from, whatever its sensors.
- new: the share of the inputs that is no function (of second degree) of the logged state. Where it is small in a closed
  loop, gains rest on what was assumed of the noise (Soderstrom, Gustavsson and Ljung, International Journal of Control
  21 (1975)): with a share of 8 % a simulated gain of 100 came out as 34.

Assumed, not checked: logged inputs are those that were commanded; the step of the log is the step of the inputs.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sysid import between_rows, signals
from nsde_torch.sysid.identify import regression_of
from nsde_torch.sysid.loop_statistics import (
    ALPHA,
    Answer,
    answers_of,
    knowledge_of,
    made_from_states,
    new_shares,
)
from nsde_torch.sysid.loop_words import FACTOR, NO_INPUT, sentences
from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.regression import ITERATIONS, Regression
from nsde_torch.systems import System

_PLAYED = 0.75  # share of an input that is no function of the logged state, above which no controller made it
_OWN_ANSWER = 0.02  # share of what is new in an input, below which it hardly answers a channel
_NEW = 0.1  # share of an input's variance below which it is nearly a function of the state
_FEWEST = 400  # rows


@dataclass(frozen=True)
class LoopTest:
    """What data say of the loop that they were recorded in."""

    answers: tuple[Answer, ...] = ()  # inputs on what the physics left unexplained before
    knowledge: tuple[Answer, ...] = ()  # innovations on the inputs at and before their step
    new: dict[str, float] = field(default_factory=dict)
    """Share of the inputs that is no function of the logged state, by direction."""
    driven: dict[str, tuple[str, ...]] = field(default_factory=dict)  # channels that each direction drives
    together: float = 1.0  # chance of all answers of inputs to the channels that they drive, if there is none
    rows: int = 0  # number of innovations of each channel
    between: dict[str, float] = field(default_factory=dict)
    """By channel: standard errors by which inputs that move between rows may bend an estimate."""
    still: tuple[str, ...] = ()  # names of inputs that never move
    why_not: str = ""  # why nothing was tested; empty where it was
    smoothed: tuple[str, ...] = ()
    """Channels whose states were smoothed before they were logged, and restored."""
    made: tuple[str, ...] = ()  # directions that past states foretell beyond the past of the inputs

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
        """Channels of which inputs know more of a step than the log does, where these were made from states.

        Those of `other_sensors`, and those whose innovations inputs foretell, beyond what the physics explains: that of
        a fit without the effects that these data have may be physics, that of the last one has no other name. Sensors
        much better than those of the log show no answers: inputs that were made from states and foretell innovations
        were made from such.
        """
        surely = {
            a.input for a in self.knowledge if a.chance < ALPHA and self.new.get(a.input, 0.0) < _PLAYED
        }
        if self.closed:
            own = [a.channel for a in self.knowledge if a.chance < ALPHA and a.input in surely]
            return tuple(dict.fromkeys((*self.other_sensors, *own)))
        ways = [way for way in self.driven if way in {*self.made, *surely}] if self.made and surely else []
        return tuple(dict.fromkeys(c for way in ways for c in self.driven[way]))

    @property
    def known(self) -> dict[str, float]:
        """By channel: standard errors by which what inputs know of a step beyond the log may bend an estimate.

        Inputs may know `FACTOR` times as much of a step as they may be seen to foretell of later ones.
        """
        out, others = dict[str, float](), self.not_from_the_log
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
    """Test the loop by a fitted regression in weak form."""
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
    known, among = [*regression.rows], signals.principal(u)
    answers, together = answers_of(regression, ways, driven, among, series)
    return LoopTest(
        answers=answers,
        together=together,
        knowledge=knowledge_of(regression, ways, driven, known, series),
        new=new_shares(regression, ways, driven, series),
        driven={way.name: tuple(regression.physics.names[c] for c in way.channels) for way in ways},
        rows=len(regression.series),
        between=between_rows.lengths(regression, ways),
        made=made_from_states(regression, ways, driven, among, series),
        still=tuple(still),
    )
