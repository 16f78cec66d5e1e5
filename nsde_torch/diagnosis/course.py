"""How far a diagnosis is: what is known so far, as a diagnosis that says what is not done.

After the fit of the declared physics, each round of the selection and each later stage, what is known is given to
whoever listens, and kept for the case that the diagnosis is stopped. It is never less than before: a search that is
repeated (in other rows) is known once it has come to an end.

How long all will yet take is rough: one more round of the selection, and later stages as so many rounds, as they took
on springs and flights.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import final

from nsde_torch.data import DataSet
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.channels import channel_residuals
from nsde_torch.diagnosis.cross_validation import HeldOut, none_held_out
from nsde_torch.diagnosis.explanation import Explanation
from nsde_torch.diagnosis.freed_memory import give_back
from nsde_torch.diagnosis.not_done import (
    CEILING,
    ERRORS,
    ESTIMATES,
    EXPLANATION,
    LAWS,
    NO_TIME,
    NOT_YET,
    OTHER_ROWS,
    SECOND_LOOK,
    SELECTION,
    STOPPED,
    TESTS,
    NotDone,
    SoFar,
)
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.models.identified import SysidSpec
from nsde_torch.progress import Say
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.result import Identification
from nsde_torch.time_limit import TimeLimit, check_time

_ROUNDS: Mapping[str, float] = {  # in order, and how long each takes, in rounds of the selection
    SELECTION: 1.0,
    SECOND_LOOK: 0.5,
    TESTS: 0.2,
    LAWS: 0.5,
    OTHER_ROWS: 1.5,
    ESTIMATES: 0.2,
    ERRORS: 1.0,
    CEILING: 1.0,
    EXPLANATION: 0.2,
}
_ORDER = list(_ROUNDS)
_UNFINISHED = "the diagnosis is not finished"


@final
class DiagnosisCourse:
    """What a diagnosis does and knows.

    Args:
        data: The data set.
        runs: Names of its runs that are looked at.
        options: Settings.
        spec: What models of the system are made of.
        say: Told stage, number done and number in all.
        so_far: Takes what is known after each round and stage.

    Attributes:
        seconds: Time that stages took.
        limit: Of time. It ends nothing before something is known.
    """

    def __init__(
        self,
        data: DataSet,
        runs: tuple[str, ...],
        options: Options,
        spec: SysidSpec,
        *,
        say: Say,
        so_far: Callable[[Diagnosis], None],
    ) -> None:
        self.data, self.runs, self.options, self.spec = data, runs, options, spec
        self.seconds: dict[str, float] = {}
        self._tell, self._so_far = say, so_far
        self._found: Diagnosis | None = None
        self._during = ""
        self._done = self._rounds = 0
        self._began = self._lapped = perf_counter()
        self._round_s = 0.0
        self.limit = TimeLimit(None if options.max_minutes is None else 60.0 * options.max_minutes)
        self.limit.holds = False

    def lap(self, name: str) -> None:
        """Note the time since the last call."""
        now = perf_counter()
        self.seconds[name], self._lapped = now - self._lapped, now

    def say(self, stage: str, done: int, total: int) -> None:
        """Tell that `done` of `total` pieces of a stage are done."""
        if self._done == _ORDER.index(OTHER_ROWS):
            stage = f"second search, {stage}"
        if stage != self._during:
            give_back()
        self._during = stage
        check_time()
        self._tell(stage, done, total)

    def known(
        self,
        stage: str | None,
        log: Log,
        outcome: Outcome,
        *,
        guard: Guarded | None = None,
        errors: HeldOut | None = None,
        most: Ceiling | None = None,
        instrumented: Identification | None = None,
    ) -> None:
        """Keep what is known after a stage, and give it to whoever listens.

        Args:
            stage: The stage that is done; None: a round of the selection.
            log: The log.
            outcome: What was concluded.
            guard: The final physics held against simple fits.
            errors: Errors on runs left out.
            most: What functions could still explain.
            instrumented: Estimates with signals from outside the loop.
        """
        done = 0 if stage is None else _ORDER.index(stage) + 1
        if done < self._done:  # a search that is repeated
            return
        self._done = done

        def known() -> Diagnosis:
            channels = channel_residuals(outcome.declared.regression, outcome.final.regression)
            return Diagnosis(
                log.system,
                self.data,
                self.runs,
                log.recorded,
                outcome.provisional(lambda _: _UNFINISHED),
                errors or none_held_out(log, None),
                Explanation(
                    channels,
                    guard=guard or Guarded(),
                    ceiling=most or Ceiling(NOT_YET),
                ),
                self.options,
                self.spec,
                dict(self.seconds),
                feedback=outcome.test,
                instrumented=instrumented,
                not_done=(*log.stages.not_done, *self._left(NOT_YET)),
                so_far=SoFar(left_s=self._left_s(stage)),
            )

        found = log.stages.attempt("what was known before the end", known, None)
        if found is not None:
            self._found = found
            self.limit.holds = True
            self._so_far(found)

    def stopped(self) -> Diagnosis | None:
        """What is known where Ctrl-C stops it; None while that is nothing."""
        return None if self._found is None else self._ended(self._found, STOPPED, None)

    def timed_out(self) -> Diagnosis:
        """What is known when the time is up."""
        assert self._found is not None  # the limit does not hold before
        return self._ended(self._found, NO_TIME, self.options.max_minutes)

    def _ended(self, found: Diagnosis, why: str, after_min: float | None) -> Diagnosis:
        other = [one for one in found.not_done if one.why != NOT_YET]
        so_far = SoFar(stopped_during=self._during, after_min=after_min)
        return replace(found, not_done=(*other, *self._left(why)), so_far=so_far)

    def too_long(self, stage: str) -> bool:
        """Whether a stage would not end in the time that is left, as far as the rounds so far tell."""
        return self._round_s * _ROUNDS.get(stage, 0.0) > max(self.limit.left_s, 0.0)

    def _left(self, why: str) -> list[NotDone]:
        return [NotDone(stage, why) for stage in _ORDER[self._done :]]

    def _left_s(self, stage: str | None) -> float | None:
        """Roughly how long all will yet take [s]; None before a round has ended."""
        if stage is None or stage == SELECTION:
            self._rounds += 1
        rounds = self._rounds - 1  # what is known first is the declared physics
        if rounds < 1:
            self._began = perf_counter()
            return None
        if stage is None or stage == SELECTION:
            self._round_s = (perf_counter() - self._began) / rounds
        return self._round_s * sum(_ROUNDS[one] for one in _ORDER[self._done :])
