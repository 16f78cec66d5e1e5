"""`nsde_torch.diagnose`: what `nsde diagnose` does."""

from collections.abc import Callable, Mapping, Sequence
from math import inf, pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from nsde_torch.api.reading import Data, read, split_runs
from nsde_torch.data import DataSet
from nsde_torch.diagnosis.candidates import check_candidates
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose as diagnose_runs
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.stages import StoppedError, read_begun
from nsde_torch.models.identified import SysidSpec
from nsde_torch.progress import Say, Stages, reported
from nsde_torch.recording.times import no_finer
from nsde_torch.sde.exponential import jacobians
from nsde_torch.systems.base import System
from nsde_torch.systems.options import Effects, SystemOptions, system_options
from nsde_torch.systems.parameters import frozen
from nsde_torch.threads import one_thread

_SOME = 50  # rows at which the declared physics is asked how fast it oscillates


@one_thread()
def diagnose(
    data: Data,
    *,
    system: str | type[System] | SystemOptions,
    effects: Effects = (),
    declared: Sequence[str] | None = None,
    parameters: Mapping[str, Any] | None = None,
    alpha: float = 0.01,
    max_effects: int = 8,
    candidates: Sequence[str] | None = None,
    also: Sequence[str] = (),
    test: Sequence[int | str] | None = None,
    test_data: Data | None = None,
    instruments: Sequence[str] = (),
    seed: int = 0,
    max_minutes: float | None = None,
    resume: str | Path | None = None,
    say: Say | Literal[False] | None = None,
    so_far: Callable[[Diagnosis], None] = lambda found: None,
) -> Diagnosis:
    """Find what the declared physics of a machine lacks, as `nsde diagnose` does.

    Ctrl-C (in a notebook: interrupt) ends it with what is known: once the declared physics is fitted, the diagnosis so
    far is returned, marked `so_far`, with `not_done`. Before that, it is a KeyboardInterrupt as ever. Code that must
    not go on with half a diagnosis calls `diagnose(...).finished()`, which raises KeyboardInterrupt then.

    Args:
        data: Folder of CSV files, PX4 log, simulation, arrays or data set (see `nsde_torch.read`).
        system: The machine: key of `nsde_torch.systems.SYSTEMS`, `module:Class`, a class, or `SystemOptions`.
        effects: Physics that is known already: names, `{name: {parameter: value}}` or a file `effects.yaml`.
        declared: Effects that replace the declared ones; None keeps them.
        parameters: Initial values of declared parameters, `name` or `effect.name`, in their units.
        alpha: Chance of naming an effect where nothing is missing, in (0, 0.5].
        max_effects: Most effects to add.
        candidates: Names of the effects to try; None: all that the system may have.
        also: Effects of your own to try beside them, `module:Class`.
        test: Runs to keep back, by index or name; None looks at all.
        test_data: Further runs that are kept back; a run of theirs among `data` is refused.
        instruments: Logged columns that nothing inside the control loop moves: sticks, setpoints.
        seed: Seed of the resamples.
        max_minutes: Time after which it ends with what is known [min]; None: none. `not_done` says what is missing. The
            declared physics is fitted however long that takes.
        resume: Folder of a diagnosis of the same data and declared model that did not come to its end: what it had
            selected is not searched for again.
        say: None: progress is printed on standard error, with what was found so far and roughly how long is left;
            False: nothing is printed; or a function that takes stage, number done and number in all.
        so_far: Takes the diagnosis so far after each round of the search and each later stage.

    Returns:
        The diagnosis: `verdict` ("no_effect", "effect_found" or "unexplained"; "undecided" of one that was stopped
        early), `added` (names), `effects` (names with
        values, for `nsde_torch.train`), `parameters` (value, 90 % interval and unit), `report` (text), `content()`
        (what `diagnosis.json` holds) and `save(folder)`.

    Raises:
        DataError: too few rows, nothing moves, or `resume` of other data.
        ConfigError: an option is out of range, a candidate that the system cannot have, or `resume` of another model.
        CheckpointError: `resume` holds nothing to go on with.

    Example:
        >>> import nsde_torch
        >>> dry = [{"coulomb_friction": {"size": 0.3}}]
        >>> made = nsde_torch.simulate("mass_spring_damper", effects=dry, durations=[5.0] * 2, seed=1)
        >>> found = nsde_torch.diagnose(
        ...     made, system="mass_spring_damper", candidates=["coulomb_friction", "quadratic_damping"]
        ... )
        >>> found.verdict, found.added
        ('effect_found', ['coulomb_friction'])
        >>> round(found.parameters["coulomb_friction.size"]["value"], 1)
        0.3
    """
    options = Options(
        alpha=alpha,
        max_effects=max_effects,
        candidates=None if candidates is None else tuple(candidates),
        also=tuple(also),
        seed=seed,
        instruments=tuple(instruments),
        max_minutes=max_minutes,
    )
    machine_options = system_options(system, effects=effects, declared=declared, parameters=parameters)
    machine = machine_options.make()
    check_candidates(machine, options.candidates or (), options.also)

    def rows_of(source: Data) -> DataSet:
        data = read(source, system=machine)
        return no_finer(data, machine, _twelfth_of_a_period(machine, data))

    runs = rows_of(data)
    looked_at = list(runs.runs)
    if test is not None or test_data is not None:
        other = None if test_data is None else rows_of(test_data)
        looked_at = list(split_runs(runs, test, test_data=other).train)
    spec = SysidSpec(
        machine_options.name,
        dt=runs.dt,
        horizon=machine.defaults.horizon,
        effects=tuple(machine_options.effects),
        declared=None if machine_options.declared is None else tuple(machine_options.declared),
        system_options=dict(machine_options.options),
    )
    names = [run.name for run in looked_at]
    begun = None if resume is None else read_begun(resume, runs, names, spec)
    with reported(say) as told:
        stages = told if isinstance(told, Stages) else None

        def known(found: Diagnosis) -> None:
            if stages is not None and found.so_far is not None:
                stages.known(found.in_short, found.so_far.left_s)
            so_far(found)

        try:
            return diagnose_runs(machine, spec, runs, looked_at, options, begun=begun, say=told, so_far=known)
        except StoppedError as stop:
            if stages is not None:
                stages("stopped, with what is known so far", 1, 1)
            return stop.found


@torch.no_grad()
def _twelfth_of_a_period(machine: System, data: DataSet) -> float:
    """Of the fastest oscillation of the declared physics at some rows of data [s]; inf where there is none."""
    if not data.runs:
        return inf
    run, physics = max(data.runs, key=len), frozen(machine)
    rows = np.linspace(0, len(run) - 1, _SOME).astype(int)
    t, x, u = (torch.from_numpy(np.asarray(values[rows])) for values in (run.t, run.x, run.u))
    memory = physics.augment(x, u)[:, physics.nx :]
    slopes = jacobians(lambda x: physics.drift(t, torch.cat((x, memory), 1), u)[:, : physics.nx], x)
    if not bool(slopes.isfinite().all()):
        return inf
    fastest = float(torch.linalg.eigvals(slopes).imag.abs().max())
    return 2.0 * pi / (12.0 * fastest) if fastest else inf
