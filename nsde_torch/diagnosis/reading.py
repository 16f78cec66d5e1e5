"""What a diagnosis reads: runs with the logged channels that an effect could read, and options that fit the machine."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.diagnosis.begun import Begun
from nsde_torch.diagnosis.candidates import candidate_names, check_candidates, on_coordinates
from nsde_torch.diagnosis.decisions import Budgets, Decisions
from nsde_torch.diagnosis.hidden import Feedback, shown_by_instruments
from nsde_torch.diagnosis.not_done import OptionalStages
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.search import Search, search_in
from nsde_torch.effects import effect_class, effects_of, register
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.chain import Recorded
from nsde_torch.recording.fault import level
from nsde_torch.sysid.in_loop import hangs_on_band, identify_in_loop
from nsde_torch.sysid.instruments import with_columns
from nsde_torch.sysid.loop_test import LoopTest, tested
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.standing import moving
from nsde_torch.systems import System
from nsde_torch.systems.coordinates import check_pushes

if TYPE_CHECKING:
    from nsde_torch.diagnosis.outcome import Outcome

_CHECKED = 50  # rows of the data at which coordinates are checked


@dataclass(frozen=True)
class Log:
    """A log that was read, its recording chain undone."""

    system: System  # declared system, which reads the logged channels
    recorded: Recorded  # the recording chain, undone
    runs: tuple[Run, ...]  # its runs, with the logged channels behind the inputs
    options: Options  # settings
    decisions: Decisions  # what is decided by
    budgets: Budgets  # how much is tried
    say: Callable[[str, int, int], None]  # told stage, number done and number in all
    # speeds below which coordinates with dry friction stand, by column; rows in which one does are left out
    slowest: Mapping[int, float] = field(default_factory=dict)
    stages: OptionalStages = field(default_factory=OptionalStages)  # stages that may fail, and those that did
    # takes what is known after a stage (`not_done.SELECTION` and those after it; None: within the selection)
    so_far: "Callable[[str | None, Log, Outcome], None]" = lambda stage, log, outcome: None
    begun: Begun | None = None
    """What an earlier diagnosis had selected, which the selection starts from; None: the declared physics."""

    def search(self, runs: Sequence[Run]) -> Search:
        """A search in runs of the log."""
        r = self.recorded
        return search_in(
            self.system,
            moving(runs, self.slowest)[0] if self.slowest else runs,
            r.clock,
            self.options,
            inputs=not r.inputs_restored,
            stages=r.stages,
            moved=bool(r.delays or r.lags),
            decisions=self.decisions,
            # what a smoother did to states looks like laws (`ceiling`)
            budgets=replace(self.budgets, laws=0) if any(run.band for run in runs) else self.budgets,
            say=self.say,
            so_far=partial(self.so_far, None, self),
        )

    @property
    def feedback(self) -> Feedback:
        """What is asked of the loop that the log was recorded in."""
        return Feedback(self._loop_test, self._shown, self._hangs)

    def identified(self, physics: System) -> Identification:
        """Physics identified as `nsde sysid` does: with signals from outside the loop where there are any."""
        return identify_in_loop(
            physics, self.runs, clock=self.recorded.clock, instruments=self.options.instruments
        )

    def _hangs(self, regression: Regression) -> NDArray[np.float64]:
        return hangs_on_band(regression, self.runs, clock=self.recorded.clock)

    def _loop_test(self, regression: Regression) -> LoopTest:
        if self.recorded.inputs_restored:
            return LoopTest(why_not="the inputs were logged as an average and know the future")
        return self.stages.attempt(
            "the test of feedback",
            lambda: tested(regression, self.runs),
            LoopTest(why_not="it could not be computed"),
        )

    def _shown(self, physics: System, effect: str) -> bool:
        return bool(self.options.instruments) and shown_by_instruments(
            self.identified(physics), effect, level("effects", self.decisions.alpha, self.recorded.stages)
        )


def read_effects(system: System, runs: Sequence[Run], options: Options) -> dict[str, str]:
    """Register effects of one's own, first of all: they may read channels that no other does.

    Args:
        system: Declared system.
        runs: Its runs.
        options: Settings.

    Returns:
        Names of the effects by their keys `module:Class`.

    Raises:
        DataError: an instrument is no column of the log.
        ConfigError: a candidate that the system cannot have.
    """
    check_candidates(system, options.candidates or ())
    if options.instruments:  # told before any work
        with_columns(system, runs, options.instruments)
    own = {key: register(key) for key in options.also}
    reading = system.reading(*logged_channels(system, runs))
    able = candidate_names(reading)
    for name in on_coordinates(reading, options.candidates or ()):
        if name not in able:
            raise ConfigError(
                f"`candidates` names {name!r}, which {system.name!r} cannot have beyond its declared physics and the "
                f"logged channels; it could have: {', '.join(able)}."
            )
    for key, name in own.items():
        if not set(on_coordinates(reading, [name])) & set(able):
            raise ConfigError(
                f"`also` names {key!r}, which {system.name!r} cannot have: it acts on the port "
                f"{effect_class(name).port.value!r} and reads "
                f"{', '.join(effect_class(name).exogenous) or 'no channel'}."
            )
    return own


def read_log(
    system: System,
    recorded: Recorded,
    options: Options,
    *,
    decisions: Decisions,
    budgets: Budgets,
    say: Callable[[str, int, int], None],
) -> Log:
    """The log with its channels.

    Args:
        system: Declared system.
        recorded: Its runs, the recording chain undone.
        options: Settings.
        decisions: What is decided by.
        budgets: How much is tried.
        say: Told stage, number done and number in all.

    Raises:
        DataError: there is no run.
    """
    runs = tuple(with_channels(system, recorded.runs))
    if not runs:
        raise DataError("no run to diagnose.")
    some = slice(None, None, max(1, len(runs[0]) // _CHECKED))
    check_pushes(
        system.with_effects().double(),
        torch.from_numpy(runs[0].x[some].copy()),
        torch.from_numpy(runs[0].u[some].copy()),
    )
    system = system.reading(*logged_channels(system, runs))
    return Log(system, recorded, runs, options, decisions, budgets, say)


def logged_channels(system: System, runs: Sequence[Run]) -> tuple[str, ...]:
    """Logged columns, of all runs and without gaps, that an effect of the catalogue could read."""
    effects = effects_of(system.name, system.ports, system.bound_coordinates())
    names = {name for cls in effects.values() for name in cls.exogenous}
    return tuple(
        n
        for n in sorted(names - set(system.exogenous))
        if all(n in run.extra and np.isfinite(run.extra[n]).all() for run in runs)
    )


def with_channels(system: System, runs: Sequence[Run]) -> list[Run]:
    """Runs with their `logged_channels` behind the inputs."""
    have = logged_channels(system, runs)
    if not have:
        return list(runs)
    return [replace(run, u=np.column_stack((run.u, *(run.extra[n] for n in have)))) for run in runs]
