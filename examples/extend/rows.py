"""`nsde rows`: how many rows each run of a data set has, and for how long it lasts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from nsde_torch.cli.hydra_command import HydraCommand, Job
from nsde_torch.cli.keys import group, key
from nsde_torch.cli.schemas import DataConfig, SystemConfig

if TYPE_CHECKING:
    from omegaconf import DictConfig


@dataclass
class RowsConfig:
    """Keys of the command; each documents itself in `nsde rows --help`."""

    least: int = key(0, "leave out runs with fewer rows", low=0)
    system: SystemConfig = group(SystemConfig, "the machine")
    data: DataConfig = group(DataConfig, "where the runs come from")


COMMAND = HydraCommand(
    name="rows",
    schema=RowsConfig,
    groups={"system": "cartpole", "data": "simulated"},
    examples=(("data=csv data.path=logs", "count those of a folder"),),
)


def run(config: DictConfig, job: Job) -> None:
    """Read the data and print a line for each run.

    Args:
        config: The composed and checked configuration.
        job: Where the command writes; nowhere, as it has no folder.
    """
    from nsde_torch.cli import build  # what is heavy is imported here, so that help stays quick

    for one in build.dataset(config.data, build.system(config.system)).runs:
        if len(one) >= config.least:
            print(f"{one.name}: {len(one)} rows, {one.t[-1] - one.t[0]:.1f} s")
