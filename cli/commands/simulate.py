"""`nsde simulate`: write runs of a simulated machine as files that do not say what is in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.recording.faults import RecordingOptions
from nsde_torch.simulation.options import Replay

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key, mirrors


@dataclass
class PlantSystem:
    name: str = key("???", "name of a system that has a plant")


@dataclass
class PlantConfig:
    """What the simulated machine holds."""

    effects: Any = key(
        [],
        "effects that nobody declares: names, module:Class of your own, {NAME: {parameter: 1}}, or an effects.yaml of "
        "nsde diagnose; a size that is not given is a typical one (`nsde effects` lists them)",
        file=True,
    )
    parameters: dict[str, Any] = key(
        {}, "values of these effects and of the declared physics, plant.parameters.EFFECT.NAME=1"
    )
    declared_only: bool = key(
        False,
        "leave out the undeclared effects that the machine has anyway (multirotors: rotor drag, motor lag)",
    )
    process_noise: float = key(1.0, "strength of the gusts, relative to the machine's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the machine's own", low=0)
    battery: bool = key(False, "log the battery's voltage though no effect reads it (multirotors)")


@mirrors(RecordingOptions)
class RecordingConfig:
    """Faults of the recording chain."""


@mirrors(Replay)
class ReplayConfig:
    """Interventions, with pilot=replay."""


@dataclass
class SimulateConfig:
    out: str = key("???", "folder of the data set: one CSV file per run, and nothing else", file=True)
    truth: str | None = key(
        None, "file that says what is in it; null: OUT.truth.json, beside the folder", file=True
    )
    overwrite: bool = key(False, "replace the CSV files of a folder that holds something, and the truth")
    seed: int = key(0, "seed of first states, inputs and noise", low=0)
    durations: list[float] | None = key(
        None, "length of each run on the clock of the log; null: the system's own", unit="s", above=0
    )
    dt: float | None = key(None, "step of the log; null: the system's own", unit="s", above=0)
    options: dict[str, Any] = key({}, "further options of the system's recording, options.NAME=1")
    pilot: str = key(
        "manual",
        "manual: the system's own recording, in which inputs may answer states; replay: interventions (multirotors): "
        "from states of such flights, commands of another time, in fresh gusts, marked by the column `intervention`; "
        "plan: the inputs of a plan (nsde design), or of a CSV file of t and the inputs",
        choices=("manual", "replay", "plan"),
    )
    plan: str | None = key(None, "with pilot=plan: folder of nsde design, or the CSV file", file=True)
    threads: int = key(1, "CPU threads of torch", low=1)
    system: PlantSystem = group(PlantSystem, "the machine")
    plant: PlantConfig = group(PlantConfig, "what it holds")
    recording: RecordingConfig = group(RecordingConfig, "how it is logged")
    replay: ReplayConfig = group(ReplayConfig, "interventions, with pilot=replay")


COMMAND = HydraCommand(name="simulate", schema=SimulateConfig, groups={"system": "hexacopter"})


def run(config: Config, job: Job) -> None:
    from nsde_torch.recording.chain import Recording
    from nsde_torch.simulation.generate import check_free, simulate, truth_path, write

    from .. import build

    folder = Path(config.out)
    check_free(folder, truth_path(folder, config.truth), overwrite=config.overwrite)
    if (config.pilot == "plan") != (config.plan is not None):
        raise ConfigError("`pilot=plan` and `plan=FOLDER` go together: give both, or neither.")
    given = build.options(config)
    made = simulate(
        config.system.name,
        recording=Recording(**given["recording"]),
        replay=Replay(**given["replay"]) if config.pilot == "replay" else None,
        **{k: given[k] for k in ("durations", "seed", "dt", "plan", "options")},
        **given["plant"],
    )
    files = write(made, folder, truth=config.truth, overwrite=config.overwrite)
    rows = sum(len(run.t) for run in made.runs)
    seconds = sum(made.truth["durations_s"])
    of = f"{config.replay.starts} interventions on flights of " if config.pilot == "replay" else ""
    print(
        f"{job.took}; wrote {len(made.runs)} runs of {config.system.name} ({of}{seconds:g} s, {rows} rows) into "
        f"{folder}, and what is in them to {files[-1]}"
    )
