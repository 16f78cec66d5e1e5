"""`nsde track`: follow a reference with model predictive control on a learned model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nsde_torch.errors import ConfigError
from nsde_torch.texts import rendered
from nsde_torch.whole_files import json_text

from ..hydra_command import TEXTS, Config, HydraCommand, Job, say
from ..keys import group, key
from ..quoted import from_file
from ..schemas import FlownPlantConfig, MpcConfig, ReferenceConfig

if TYPE_CHECKING:
    from torch import Tensor

    from nsde_torch.control.loop import Flight
    from nsde_torch.control.reference import StateReference
    from nsde_torch.models import Model
    from nsde_torch.systems import System

RESULT, LOG, PLOTS = "tracking.json", "log", "plots"
_ONE_BY_ONE = 32


@dataclass
class TrackConfig:
    run: str = key(
        "???",
        "run directory of the model to plan with, `declared`: physics with the plant's values, or a file of nsde "
        "export (controller=FILE says the same)",
        file=True,
    )
    beside: list[str] = key(
        [], "further controllers on the same flights: run directories (same mpc), or pid", file=True
    )
    machines: int = key(1, "flights, each with noise of its own", low=1)
    at_once: int | None = key(
        None, "machines in one batch; null: 1 up to 32 machines, else all of them (Monte Carlo)", low=1
    )
    duration: float | None = key(None, "length of a flight; null: that of the reference", unit="s", above=0)
    seed: int = key(0, "seed of the plant's noise", low=0)
    animation: str | None = key(None, "film of the first flight: gif or mp4", choices=("gif", "mp4"))
    threads: int = key(1, "CPU threads of torch; more make small solves slower", low=1)
    out_dir: str = key("???", "folder to write into", file=True)
    start: Any = key(
        {},
        "first values of states, {theta: 3.14}; {}: rest at the origin for reference=setpoint, else the reference's",
    )
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly, or which states to reach")
    plant: FlownPlantConfig = group(FlownPlantConfig, "what is flown")
    mpc: MpcConfig = group(MpcConfig, "the controller")


COMMAND = HydraCommand(
    name="track",
    schema=TrackConfig,
    groups={"reference": "lemniscate", "plant": "hexacopter", "mpc": "default"},
    folder="tracks/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.reference}",
    result=("tracking.json", "a flight"),
    words=from_file,
)


def run(config: Config, job: Job) -> float | None:
    """Follow a reference; RMSE of the position [m], or the largest of the error groups; None if all were lost."""
    from nsde_torch.control.loop import summarise, write_log
    from nsde_torch.control.reference import Reference
    from nsde_torch.systems import Multirotor

    from .. import build, track_build

    names = [config.run, *config.beside]
    if len(set(names)) < len(names):
        raise ConfigError(f"`beside` names a controller twice: {names}.")
    if config.run == track_build.PID:
        raise ConfigError("`run` is the model's run directory (or declared); pid can fly beside=[pid].")
    first = track_build.knowledge(config.run, config.plant)
    known = {config.run: first}
    for name in config.beside:
        if name != track_build.PID:
            known[name] = track_build.knowledge(name, config.plant, beside=first)
    system = track_build.system_of(first)
    for name in config.beside:
        other = system.name if name == track_build.PID else track_build.system_of(known[name]).name
        if other != system.name or (name == track_build.PID and not isinstance(system, Multirotor)):
            flown = "flies multirotors" if name == track_build.PID else f"is of a {other}"
            raise ConfigError(f"`beside`: {name} {flown}, and the machine is a {system.name}.")
    path = track_build.any_reference(config.reference, system)
    length = path.duration if config.duration is None else config.duration
    if length < config.mpc.period:
        raise ConfigError(f"{length:g} s are shorter than the period of the plans, {config.mpc.period:g} s.")
    begin = build.options(config)["start"]
    start = None
    if not isinstance(path, Reference) and (begin or config.reference.kind == "setpoint"):
        start = track_build.set_to("start", begin, system).states[0]
    asked = None
    if isinstance(path, Reference):
        if config.start:
            raise ConfigError("`start` is for other machines: a flight starts where its reference does.")
        asked = track_build.envelope(config, path, first)
        print(
            f"{path.name}: {path.duration:g} s, up to {asked.speed:.2f} m/s and {asked.tilt:.0f} deg of tilt, "
            f"commands {asked.input_low:.2f} to {asked.input_high:.2f}"
        )
    content: dict[str, Any] = {
        "reference": {
            "name": path.name,
            "duration_s": path.duration,
            **path.about,
            "envelope": vars(asked) if asked else None,
        },
        "plant": build.options(config.plant),
        "mpc": build.options(config.mpc),
        "seed": config.seed,
        "controllers": {},
    }
    flights: dict[str, list[Flight]] = {}
    for name in names:
        label = track_build.label(name)
        flights[label] = _fly(config, name, known.get(name, first), first, path, start)
        content["controllers"][label] = {"run": name, **summarise(flights[label], system)}
        say(_text(label, content["controllers"][label]))
    (job.run_dir / RESULT).write_text(json_text(content), encoding="utf-8")
    own = track_build.label(config.run)
    write_log(flights[own], system, job.run_dir / LOG)
    wrote = [RESULT, f"{LOG}/", *_pictures(config, job, flights, path, system)]
    print(f"\n{job.took}; wrote {job.run_dir}: {', '.join(wrote)}")
    found = content["controllers"][own]
    return found.get("rmse_m", max(found.get("rmse", {}).values(), default=None))


def _fly(
    config: Config,
    name: str,
    known: Model | System,
    first: Model | System,
    path: StateReference,
    start: Tensor | None,
) -> list[Flight]:
    """The flights of one controller; every controller meets the same noise of the plant."""
    from nsde_torch.control.loop import fly

    from .. import track_build

    together = config.at_once or (1 if config.machines <= _ONE_BY_ONE else config.machines)
    autopilot, size, out = None, 0, []
    for k, at in enumerate(range(0, config.machines, together)):
        count = min(together, config.machines - at)
        plant = track_build.plant(config.plant, first, seed=config.seed * 100_003 + k)
        if autopilot is None or count != size:
            size = count
            autopilot = track_build.autopilot(name, known, config, path, batch=count, sample=plant.dt)
        out.append(
            fly(
                autopilot,
                plant,
                path,
                machines=count,
                start=start,
                state_latency=config.plant.state_latency,
                duration=config.duration,
            )
        )
    return out


def _text(label: str, found: dict[str, Any]) -> str:
    """One controller in one line or more."""
    status = found["status"].items()
    failed = sum(count for word, count in status if word.endswith(("kept", "hover", "rest")))
    return rendered(TEXTS, "tracking.txt", **found, label=label, failed=failed)


def _pictures(
    config: Config, job: Job, flights: dict[str, list[Flight]], path: StateReference, system: System
) -> list[str]:
    import numpy as np

    from nsde_torch.plots import save
    from nsde_torch.plots.tracking import film, solve_times, states_over_time, tracking
    from nsde_torch.systems import Multirotor

    folder = job.run_dir / PLOTS
    folder.mkdir(exist_ok=True)
    first = next(iter(flights.values()))[0]
    t, ref = first.t.numpy(), first.ref.numpy()
    states = {name: np.concatenate([f.x.numpy() for f in fs], 1) for name, fs in flights.items()}
    if isinstance(system, Multirotor):
        figure = tracking(t, ref, states, title=f"Tracking of the {path.name}")
    else:
        inputs = {name: np.concatenate([f.u.numpy() for f in fs], 1) for name, fs in flights.items()}
        names, units = (*system.state_names, *system.input_names), (*system.state_units, *system.input_units)
        columns = dict(zip(names, units, strict=True))
        figure = states_over_time(t, ref, states, inputs, columns, title=f"{system.name}: {path.name}")
    save(figure, folder / "tracking.png")
    wrote = [f"{PLOTS}/tracking.png"]
    times = {
        name: np.array([d.solve_ms for f in fs for d in f.decisions[1:] if d.cost is not None])
        for name, fs in flights.items()
    }
    times = {name: v for name, v in times.items() if len(v)}
    if times:
        save(solve_times(times, title="Times of solves in the closed loop"), folder / "solve_times.png")
        wrote.append(f"{PLOTS}/solve_times.png")
    if config.animation is not None and not isinstance(system, Multirotor):
        print("animation= films flights; this machine has none")
    elif config.animation is not None:
        file = film(t, ref, next(iter(states.values()))[:, 0], folder / f"flight.{config.animation}")
        wrote.append(f"{PLOTS}/{file.name}")
    return wrote
