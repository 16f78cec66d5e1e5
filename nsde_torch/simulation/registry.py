"""Built-in data sets: `simulated("hexacopter")` makes, checks and summarises the runs of a plant.

Every random number comes from `seed`. The runs pass the same checks as measured files, so that a simulated
set is a `DataSet` like any other, of kind `simulated`.
"""

import functools
import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.cache import cache_folder
from nsde_torch.control.shapes import from_csv
from nsde_torch.data import DataSet, RawRun, SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import assemble
from nsde_torch.simulation import cartpole, flights
from nsde_torch.simulation.cartpole import cartpole_episodes
from nsde_torch.simulation.excitation import excited_runs, spring_runs
from nsde_torch.simulation.flights import manual_flights
from nsde_torch.simulation.make import Making, check_numbers
from nsde_torch.simulation.planned import plan_file, planned_flights, planned_runs, read_plan
from nsde_torch.simulation.replay import replayed_flights
from nsde_torch.systems import Multirotor, System, make_system
from nsde_torch.systems.machine import Excitation
from nsde_torch.systems.machines import Effects, machine, make_plant_system, named_effects
from nsde_torch.systems.options import key_of_class

# Simulated runs on disk: one `.npz` for each hash of their settings and of the source files that a simulation runs
# through, so that no change of the code can be answered with old runs. A file that cannot be read is made anew. Writers
# take turns by nothing but an atomic rename: the last one wins, with equal content.

_SOURCES = (
    *("simulation", "systems", "effects", "sde"),
    *("control/cascade.py", "rotation.py", "data/quaternion.py"),
)


@functools.cache
def _code_hash() -> str:
    """Hash of the source files that a simulation runs through."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for part in _SOURCES:
        path = package / part
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def _path_of(settings: Mapping[str, Any], folder: str | Path | None = None) -> Path:
    """File of the runs of a simulation with these settings."""
    text = json.dumps({**settings, "code": _code_hash()}, sort_keys=True, default=list)
    return cache_folder(folder) / f"simulated-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"


def _load(path: Path) -> list[RawRun] | None:
    """Runs of a file, or None where there is none that can be read."""
    try:
        with np.load(path, allow_pickle=False) as content:
            names = content["names"].tolist()
            parts = [[content[f"{part}_{i}"] for part in "txu"] for i in range(len(names))]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return [RawRun(name, t, x, u, source="simulated") for name, (t, x, u) in zip(names, parts, strict=True)]


def _store(path: Path, runs: Sequence[RawRun]) -> None:
    """Write runs, if the folder can be written: a cache is no necessity."""
    content: dict[str, Any] = {"names": np.array([run.name for run in runs])}
    for i, run in enumerate(runs):
        content |= {f"t_{i}": run.t, f"x_{i}": run.x, f"u_{i}": run.u}
    part = path.with_suffix(f".{os.getpid()}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                np.savez(file, allow_pickle=False, **content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


@dataclass(frozen=True)
class RunRecorder:
    """How runs of a machine are made."""

    make: Callable[..., list[RawRun]]  # function (name, *, durations, seed, making, ...) -> runs
    durations: tuple[float, ...]  # lengths of the runs that `simulate` makes by default [s]
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `make` that `simulate` has by default, so that the runs show something."""
    replay: Callable[..., list[list[RawRun]]] | None = None
    """Function that makes interventions of the runs (see `nsde_torch.simulation.replay`); None: none."""


_FLIGHTS = RunRecorder(manual_flights, flights.DURATIONS, replay=replayed_flights)
RECORDINGS: dict[str, RunRecorder] = {
    "hexacopter": _FLIGHTS,
    "quadrotor": _FLIGHTS,
    "cartpole": RunRecorder(cartpole_episodes, cartpole.DURATIONS),
    "mass_spring_damper": RunRecorder(spring_runs, (20.0,) * 6, {"force": "multisine", "force_size": 0.5}),
}
"""How runs of the machines of the package are made, by system."""


def recorder(name: str) -> RunRecorder:
    """How runs of a system's machine are made: its own way, or as its `excitation` says; ConfigError for no plant."""
    own = machine(name)
    if name in RECORDINGS:
        return RECORDINGS[name]
    durations = Excitation(()).durations if own.excitation is None else own.excitation.durations
    return RunRecorder(own.recording or excited_runs, durations)


def planned(name: str, plan: str | Path) -> RunRecorder:
    """How runs of a plan are made (`nsde_torch.simulation.planned`); a DataError where it does not fit the system."""
    machine(name)
    own = make_system(name)
    if isinstance(own, Multirotor):
        return RunRecorder(planned_flights, (from_csv(plan_file(plan)).duration,), {"plan": str(plan)})
    t, _ = read_plan(plan, own.input_names)
    return RunRecorder(planned_runs, (float(t[-1]),), {"plan": str(plan)})


def simulated(
    system: str | SystemInfo,
    *,
    durations: Sequence[float] | None = None,
    seed: int = 0,
    effects: Effects = (),
    process_noise: float = 1.0,
    sensor_noise: float = 1.0,
    cache: str | Path | None = None,
    use_cache: bool = True,
    gap: float | None = None,
    clock: str = "rescale",
    **options: Any,
) -> DataSet:
    """Runs of a plant, as a checked data set of kind `simulated`.

    A ConfigError where the system has no plant (the message names the remedy), an effect, parameter or option is
    unknown, or a number out of range.

    Args:
        system: The system, or its name.
        durations: Length of each run [s]; default: the system's own set.
        seed: Seed of everything random.
        effects: Effects that the plant has and the model need not declare: `name`, or
            `{name: {parameter: value}}`; parameters of an effect that the plant has anyway are replaced.
        process_noise, sensor_noise: Factors on the machine's gusts and on its sensor noise.
        cache: Folder that keeps the runs; default: NSDE_CACHE, else the user's cache folder.
        use_cache: Whether to read and write the cache.
        gap: Time between rows that counts as a gap [s] (see `nsde_torch.recording.read`).
        clock: What to do about a clock that disagrees with the kinematics.
        options: Further options of the system's recording: `force`, `region` (mass_spring_damper), `policy`,
            `exploration` (cartpole).

    Example:
        >>> data = simulated("hexacopter", seed=1, effects=["quadratic_drag"])
        >>> data.names
        ('flight_0', 'flight_1', 'flight_2')
    """
    name = system if isinstance(system, str) else _key(system)
    made = recorder(name)  # refuses a system without a plant
    info: SystemInfo = make_system(system) if isinstance(system, str) else system
    own = make_plant_system(name, effects=effects)
    if tuple(info.state_names) != own.state_names or tuple(info.input_names) != own.input_names:
        raise ConfigError(
            f"the system {name!r} has other columns than the plant of that name; expected states "
            f"{own.state_names} and inputs {own.input_names}. Give your system a name of its own and use "
            "data=csv data.path=FOLDER."
        )
    check_numbers(durations, seed, process_noise=process_noise, sensor_noise=sensor_noise)
    if info.exogenous or own.exogenous:
        raise ConfigError(
            f"simulated runs of {name!r} have no further channels, but effects read "
            f"{sorted({*info.exogenous, *own.exogenous})}. Leave those effects out, or use data=csv."
        )
    lengths = None if durations is None else [float(d) for d in durations]
    when: dict[str, Any] = {"durations": lengths, "seed": int(seed)}
    noise = {"process_noise": float(process_noise), "sensor_noise": float(sensor_noise)}
    which: dict[str, Any] = {"effects": named_effects(effects, name), **noise}
    kept = _path_of({"system": name, **when, **which, "options": options}, cache)
    raw = _load(kept) if use_cache else None
    if raw is None:
        try:
            raw = made.make(name, **when, making=Making(**which), **options)
        except TypeError as error:
            if "unexpected keyword" in str(error):
                raise ConfigError(f"simulated runs of {name!r}: {error}.") from error
            raise
        if use_cache:
            _store(kept, raw)
    try:
        return assemble(raw, info, kind="simulated", gap=gap, clock=clock)
    except DataError as error:
        raise DataError(
            f"the simulated runs do not pass the checks of measured ones: {error} Weaker noise or effects may help."
        ) from error


def _key(system: SystemInfo) -> str:
    """What names the system of a plant: its name, or `module:Class` of the user's own."""
    own = isinstance(system, System) and system.name not in RECORDINGS and type(system).machine is not None
    return key_of_class(type(system)) if own else system.name  # type: ignore[arg-type]
