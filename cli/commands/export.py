"""`nsde export`: write the predictive controller as a file for a flight computer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nsde_torch.errors import ConfigError

from ..hydra_command import Config, HydraCommand, Job, say
from ..keys import group, key
from ..quoted import as_typed
from ..schemas import FlownPlantConfig, MpcConfig


@dataclass
class ExportConfig:
    run: str = key(
        "???",
        "run directory of the model to plan with, or `declared`: physics with the plant's values",
        file=True,
    )
    out: str = key("???", "file to write: controller.ts, controller.pt2 or controller.c", file=True)
    overwrite: bool = key(False, "replace a file that is there")
    format: str = key(
        "torchscript",
        "torchscript: for libtorch on any processor; aoti: machine code for processors of this kind, three times as "
        "fast (needs g++, takes minutes); c: plain C, a .c and a .h with the estimator of mpc.force_time within",
        choices=("torchscript", "aoti", "c"),
    )
    precision: str = key("float64", "arithmetic within", choices=("float32", "float64"))
    sample: float | None = key(
        None, "step of the prediction over the latency; null: the plant's sample", unit="s", above=0
    )
    threads: int = key(1, "CPU threads of torch", low=1)
    plant: FlownPlantConfig = group(FlownPlantConfig, "the machine that it is for: its name and latency")
    mpc: MpcConfig = group(MpcConfig, "the controller")


COMMAND = HydraCommand(name="export", schema=ExportConfig, groups={"plant": "hexacopter", "mpc": "default"})


def run(config: Config, job: Job) -> None:
    """Write one controller; ConfigError where the file is there already, or cannot hold a setting."""
    import torch

    from nsde_torch.control.loop import DECLARED, system_of
    from nsde_torch.export.container import C
    from nsde_torch.export.write import export
    from nsde_torch.systems import Multirotor
    from nsde_torch.systems.machines import machine

    from .. import track_build

    path = Path(config.out)
    for file in (path, path.with_suffix(".h")) if config.format == C else (path,):
        if file.exists() and not config.overwrite:
            raise ConfigError(f"`out={file}` is there already; name another file, or say overwrite=true.")
    known = track_build.knowledge(config.run, config.plant)
    mpc, name = config.mpc, track_build.machine_name(config.plant, known)
    sample = config.sample or config.plant.dt or machine(name).dt
    latency = track_build.latency(config, known)
    digest = export(
        known,
        path,
        name=name,
        **track_build.planning(mpc, system_of(known)),
        kind=config.format,
        run=None if config.run == DECLARED else Path(config.run),
        sample=sample,
        period=mpc.period,
        latency=latency,
        estimator=track_build.estimator(mpc, latency=latency, sample=sample),
        dtype=getattr(torch, config.precision),
        say=say,
    )
    where = () if isinstance(system_of(known), Multirotor) else ("reference=setpoint",)
    print(
        f"{job.took}; wrote {path} ({path.stat().st_size / 1024:.0f} kB, "
        f"{config.format}, sha256 {digest[:16]}...); check it with: "
        + as_typed("nsde", "verify", *where, paths={"controller": path, "run": config.run})
    )
