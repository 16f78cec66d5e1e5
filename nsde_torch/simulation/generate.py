"""Data sets of plants as files that do not say what is in them, and the truth in another file.

The runs are those of the system's recording (`RECORDINGS`), put through a recording chain (`recording`). A data set
is a folder `run_0.csv`, `run_1.csv`, ...: header, times, states, inputs, logged columns, and nothing else.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.data.csv_folder import write_table
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Effect, Parameter, effect_class
from nsde_torch.effects.base import STRICTLY
from nsde_torch.errors import ConfigError, NonFiniteError
from nsde_torch.recording.chain import Recording
from nsde_torch.simulation.make import Making, check_numbers
from nsde_torch.simulation.options import Replay
from nsde_torch.simulation.registry import RECORDINGS, RunRecorder, planned, recorder
from nsde_torch.simulation.replay import joined
from nsde_torch.systems import System, make_system, system_class
from nsde_torch.systems.machines import Effects, machine, make_plant_system, named_effects
from nsde_torch.systems.options import key_of_class
from nsde_torch.systems.values import Numbers, dotted

SCHEMA = 1
_SUBSTEPS = 8


@dataclass(frozen=True)
class Simulation:
    """What `simulate` made."""

    system_name: str  # name of the system
    state_names: tuple[str, ...]  # columns of the runs
    input_names: tuple[str, ...]
    runs: tuple[RawRun, ...]  # as the recording chain logs them
    truth: Mapping[str, Any] = field(repr=False)
    """What made them (`truth.json`): undeclared effects with parameters and units, whether each is a standing one of
    the machine, declared parameters, faults of the recording, noise, seed."""

    def save(
        self, folder: str | Path, *, truth: str | Path | None = None, overwrite: bool = False
    ) -> list[Path]:
        """Write the data set into a folder, made where it is missing, and its truth beside it; returns all these files.

        The truth lies outside the folder; None: in its name with `.truth.json`. With `overwrite`, the CSV files of a
        folder that holds something are replaced, and the truth; else a ConfigError refuses that.
        """
        folder, beside = Path(folder), truth_path(folder, truth)
        check_free(folder, beside, overwrite=overwrite)
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("*.csv"):
            old.unlink()
        files = [folder / f"{run.name}.csv" for run in self.runs]
        for file, run in zip(files, self.runs, strict=True):
            names = ("t", *self.state_names, *self.input_names, *run.extra)
            # times to the nanosecond: sums of steps would show their last digits
            write_table(file, names, (np.round(run.t, 9), run.x, run.u, *run.extra.values()))
        beside.parent.mkdir(parents=True, exist_ok=True)
        content = {**self.truth, "files": [file.name for file in files]}
        beside.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        return [*files, beside]


write = Simulation.save  # a function of what was made


def simulate(
    system: str | type[System],
    *,
    effects: Effects = (),
    parameters: Mapping[str, Any] | None = None,
    durations: Sequence[float] | None = None,
    seed: int,
    process_noise: float = 1.0,
    sensor_noise: float = 1.0,
    declared_only: bool = False,
    dt: float | None = None,
    battery: bool = False,
    recording: Recording | None = None,
    replay: Replay | None = None,
    plan: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
) -> Simulation:
    """Runs of a plant, as its recording chain logs them.

    Args:
        system: A system that has a plant: key of `nsde_torch.systems.SYSTEMS`, `module:Class` or the class of your own
            (`System.machine`).
        effects: Effects beyond those of the machine: `name`, `module:Class` or `{name: {parameter: value}}`. An
            `input_delay` is a pure delay here, not the approximation that models have. Where no size is given and the
            first value adds nothing, it is the parameter's `scale`.
        parameters: Further values, `effect.parameter` (or a mapping), or `name` of the declared physics.
        durations: Length of each run [s] on the clock of the log; None: the system's own.
        seed: Seed of everything random.
        process_noise, sensor_noise: Factors on the machine's gusts and on its sensor noise.
        declared_only: Leave out the undeclared effects that the machine has anyway.
        dt: Step of the log [s]; None: the machine's.
        battery: Log the voltage of a battery though no effect reads it (multirotors).
        recording: Faults of the recording chain.
        replay: Make interventions of the runs: from states of theirs, commands of another time (see
            `nsde_torch.simulation.replay`). None: the runs themselves.
        plan: Inputs to give in place of the system's own recording: a CSV file, or the folder of `nsde design` (see
            `nsde_torch.simulation.planned`).
        options: Further options of the system's recording (`force`, `policy`, `variants`, ...).

    Raises:
        ConfigError: an unknown system, effect, parameter or option, a number out of range, or effects so strong that
            the machine cannot be flown.

    Example:
        >>> made = simulate("mass_spring_damper", effects=[{"coulomb_friction": {"size": 0.2}}], seed=1)
        >>> made.truth["effects"]["coulomb_friction"]["parameters"]["size"]
        0.2
    """
    if not isinstance(system, str):
        system = key_of_class(system)
    spec, recorded = machine(system), recorder(system) if plan is None else planned(system, plan)
    chain = recording or Recording()
    known = make_system(system)
    named = named_effects(effects, system)
    asked, own_values = _with_parameters(named, parameters or {}, known, spec.effects, system)
    chain.check(known)
    check_numbers(durations, seed)
    if dt is not None and not (isfinite(dt) and dt > 0):
        raise ConfigError(f"`dt` must be a step above 0 s; got {dt!r}.")
    if battery and "u_1" not in known.input_names:
        raise ConfigError(f"`battery`: system {system!r} has none; leave it out.")
    nominal = spec.dt if dt is None else float(dt)
    step = nominal * chain.clock
    latency, fine = _latency(asked.pop("input_delay", None), step, spec.step)
    late = chain.rows_late(nominal)
    lengths = [float(d) for d in durations or recorded.durations]
    used = {**recorded.options, **(options or {})}
    own = make_plant_system(system, effects=asked, declared_only=declared_only, values=own_values)
    if replay is not None:
        _check_replay(system, recorded, replay, chain, nominal)
    flown = [(round(d / nominal) + late) * step for d in lengths]
    making = Making(
        effects=asked,
        process_noise=process_noise,
        sensor_noise=sensor_noise,
        declared_only=declared_only,
        latency=latency,
        dt=step,
        step=fine,
        battery=battery,
        values=own_values,
    )
    try:
        made = _recorded(recorded, system, replay, durations=flown, seed=seed, making=making, **used)
    except TypeError as error:
        if "unexpected keyword" in str(error):
            raise ConfigError(f"the recording of {system!r}: {error}.") from error
        raise
    except NonFiniteError as error:
        text = f"the simulation left the finite numbers: {error} Make the effects weaker."
        raise ConfigError(text) from error
    rng = np.random.default_rng([seed, 3])
    digits = len(str(len(made) - 1))
    runs = []
    for i, pieces in enumerate(made):
        logged = [_logged(piece, chain, own, nominal, rng) for piece in pieces]
        runs.append(joined(logged, f"run_{i:0{digits}d}"))
    truth: dict[str, Any] = {
        "schema": SCHEMA,
        "system": system,
        "effects": _undeclared(own, known, () if declared_only else tuple(spec.effects), asked),
        "recording": chain.as_dict(nominal),
        "declared": {
            name: {"value": _plain(value.tolist()), "unit": unit}
            for name, (value, unit) in own.all_declared().items()
            if name in known.all_declared()
        },
        "process_noise": process_noise,
        "sensor_noise": sensor_noise,
        "declared_only": declared_only,
        "dt_s": nominal,
        "durations_s": lengths,
        "seed": seed,
        "options": used,
        "battery": battery,
    }
    if replay is not None:
        truth["replay"] = {"starts": replay.starts, "duration_s": replay.duration, "before_s": replay.before}
    if latency is not None:
        delay = {"parameters": {"delay": latency}, "units": {"delay": "s"}, "standing": False}
        truth["effects"]["input_delay"] = delay
    return Simulation(system, own.state_names, own.input_names, tuple(runs), truth)


def _recorded(how: RunRecorder, system: str, replay: Replay | None, **settings: Any) -> list[list[RawRun]]:
    """The runs of a recording, or the interventions of each run that are made of it."""
    if replay is None or how.replay is None:
        return [[run] for run in how.make(system, **settings)]
    return how.replay(system, replay=replay, **settings)


def _logged(run: RawRun, chain: Recording, own: System, dt: float, rng: np.random.Generator) -> RawRun:
    """A run as the chain logs it, on the clock on which it began."""
    began, step = run.t[0], run.t[1] - run.t[0]
    logged = chain.apply(run, own, dt=dt, rng=rng)
    logged.t = logged.t + began * dt / step
    return logged


def _check_replay(system: str, how: RunRecorder, replay: Replay, chain: Recording, dt: float) -> None:
    if how.replay is None:
        flown = [name for name, known in RECORDINGS.items() if known.replay is not None]
        raise ConfigError(
            f"`pilot=replay` makes interventions of flights, and system {system!r} is not flown; it takes "
            f"{', '.join(flown)}. "
            + (
                "The force on a spring answers no state: its runs are what is asked for as they are."
                if system == "mass_spring_damper"
                else "Take runs whose inputs answer no state: options.policy=random."
                if system == "cartpole"
                else "Leave it out."
            )
        )
    replay.rows(dt)
    late = chain.mixing_times
    if late:
        raise ConfigError(
            f"`pilot=replay` and `recording.{late[0]}` do not go together: a chain that mixes times would mix the rows "
            "before an intervention with those after it. Leave one of them out."
        )


def _with_parameters(
    asked: dict[str, Numbers],
    parameters: Mapping[str, Any],
    known: System,
    standing: Collection[str],
    system: str,
) -> tuple[dict[str, Numbers], Numbers]:
    """Effects (the user's own by their names) with their values joined, and values of the declared physics."""
    own = system_class(system)
    declared: Numbers = {}
    out = {own.effect_key(key): dict(values) for key, values in asked.items()}
    names = {effect_class(key).name: key for key in out}
    for path, value in dotted(parameters):
        called, dot, leaf = path.partition(".")
        name = own.effect_key(called)
        if not dot and name in known.PARAMETERS:
            declared[name] = value
        elif dot and name not in names and name in known.effect_names:
            declared[f"{name}.{leaf}"] = value
        elif dot and name not in names and name in standing:
            out.setdefault(name, {})[leaf] = value
            names[name] = name
        elif name not in names:
            raise ConfigError(
                f"`parameters` names {name!r}, which is neither a parameter of {system!r} "
                f"({', '.join(known.all_declared()) or 'none'}) nor one of the effects that it was asked to have: "
                f"{', '.join(names) or 'none'}."
            )
        elif not dot:
            raise ConfigError(f"`parameters.{name}` takes {{parameter: value}}; got {value!r}.")
        else:
            out[names[name]][leaf] = value
    n_inputs = len(own.input_names)
    for key, values in out.items():
        cls = own.effect_class(key)
        for name, size in _typical(cls, values, n_inputs).items():
            values.setdefault(name, size)
        values.update(
            {n: _off_bounds(cls.PARAMETERS[n], v) for n, v in values.items() if n in cls.PARAMETERS}
        )
    return out, declared


def _typical(cls: type[Effect], given: Collection[str], n_inputs: int) -> Numbers:
    """Sizes for what would add nothing: parameters that start at zero, and a loss that is the same for all inputs."""
    out: Numbers = {}
    for name, spec in cls.PARAMETERS.items():
        initial = spec.initial if isinstance(spec.initial, tuple) else (spec.initial,)
        if spec.per_input:
            out[name] = [spec.scale or 0.1, *[0.0] * (n_inputs - 1)]
        elif not any(initial):
            row = [spec.scale or 0.1] * len(initial)
            out[name] = row if len(row) > 1 else row[0]
    return {} if set(out) & set(given) else out


def _off_bounds(spec: Parameter, value: float | list[float]) -> float | list[float]:
    """A value that lies on a bound moved a little inside: none of a loss is a loss of a millionth of its scale."""
    if isinstance(value, list):
        return [float(_off_bounds(spec, v)) for v in value]  # type: ignore[arg-type]
    margin = STRICTLY * (spec.scale or 1.0)
    if value == spec.low:
        return value + margin
    return value - margin if value == spec.high else value


def _latency(values: Numbers | None, step: float, fine: float) -> tuple[float | None, float | None]:
    """The delay that a plant can have nearest to what was asked, and the fine step for it."""
    if values is None:
        return None, None
    delay = effect_class("input_delay")({"delay": 0.02, **values}).value("delay")
    wanted = float(delay.detach()[0])
    least = max(1, round(step / fine))
    for count in range(least, least + _SUBSTEPS):
        if abs(round(wanted * count / step) * step / count - wanted) < 0.02 * wanted:
            break
    return round(wanted * count / step) * step / count, step / count


def _undeclared(
    own: System, known: System, standing: Sequence[str], asked: Mapping[str, Numbers]
) -> dict[str, Any]:
    wanted = {effect_class(key).name: values for key, values in asked.items()}
    out: dict[str, Any] = {}
    for effect in own.effects:
        assert isinstance(effect, Effect)
        if effect.name in known.effect_names:
            continue
        values, given = effect.declared_parameters(), wanted.get(effect.name, {})
        out[effect.name] = {
            # as they were given: what the effect holds went through single precision
            "parameters": {k: given.get(k, _plain(v.tolist())) for k, (v, _) in values.items()},
            "units": {k: unit for k, (_, unit) in values.items()},
            "standing": effect.name in standing and effect.name not in wanted,
        }
    return out


def _plain(values: list[float]) -> float | list[float]:
    rounded = [float(f"{v:.7g}") for v in values]
    return rounded[0] if len(rounded) == 1 else rounded


def truth_path(folder: str | Path, truth: str | Path | None = None) -> Path:
    """Where the truth of a data set is written: `truth`, or beside the folder."""
    folder = Path(folder)
    return folder.parent / f"{folder.name}.truth.json" if truth is None else Path(truth)


def check_free(folder: Path, truth: Path, *, overwrite: bool) -> None:
    """Refuse to write over what is there, or a truth into the folder of the data."""
    if truth.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(f"`truth`: {truth} lies in the folder of the data; name a file outside {folder}.")
    if folder.is_file():
        raise ConfigError(f"`out`: {folder} is a file; name a folder.")
    if overwrite:
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"`out`: {folder} holds something; name another folder, or add overwrite=true.")
    if truth.exists():
        raise ConfigError(f"`truth`: {truth} exists; name another file, or add overwrite=true.")
