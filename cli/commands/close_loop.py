"""`nsde close-loop`: fly, find what the physics lacks, and fly again with it: tracking before and after.

The controller knows the declared physics with the values of the plant; after the diagnosis it also knows the effects
that were found, with the values that were found, but for lags and delays, which `delay` covers. With
`experiments=N` what the diagnosis leaves open is closed by designed flights. Flights before and after meet the same
gusts, which are others than those of the flights that were diagnosed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.design.options import DesignOptions
from nsde_torch.diagnosis.decisions import Options

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key, of
from ..schemas import FlownPlantConfig, LimitsConfig, LinkConfig, MpcConfig, ReferenceConfig


@dataclass
class ExperimentConfig:
    """What an experiment may do, and how long it is looked for."""

    fence: Any = key(
        [[-3.5, 3.5], [-3.5, 3.5], [0.4, 4.0]],
        "lowest and highest x, y, z from the place of take-off that an experiment may reach",
        unit="m",
    )
    speed: float = key(4.0, "largest speed along each axis", unit="m/s", above=0)
    rate: float = key(4.0, "largest rate of turn about each axis", unit="rad/s", above=0)
    duration: float = key(12.0, "length of an experiment", unit="s", low=4)
    samples: int = of(DesignOptions, "samples", default=3)
    proposals: int | None = of(DesignOptions, "proposals", default=16)
    generations: int | None = of(DesignOptions, "generations", default=2)
    rehearsals: int = of(DesignOptions, "rehearsals", default=4)
    baselines: bool = key(
        True, "take a usual flight where none is better: lemniscate, doublets, the longest again"
    )
    least_nats: float = key(
        0.5, "an experiment with less expected evidence than this is not flown", unit="nats", low=0
    )


@dataclass
class CloseLoopConfig:
    by: str = key(
        "vehicle",
        "who flies: vehicle (simulated PX4, in virtual time), plant (that of nsde track), link (a vehicle over "
        "MAVLink: nsde vehicle, a PX4), hand (a person, who puts the logs in)",
        choices=("vehicle", "plant", "link", "hand"),
    )
    logged: int = key(2, "flights that are diagnosed", low=1)
    experiments: int = key(0, "most experiments that are flown for what the diagnosis leaves open", low=0)
    flights: int = key(3, "pairs of flights that are compared, each pair in the same gusts", low=1)
    truth: bool = key(False, "compare with a controller that knows the true effects of the simulated machine")
    alpha: float = of(Options, "alpha")
    max_effects: int = of(Options, "max_effects")
    candidates: list[str] | None = of(
        Options, "candidates", help="effects to try, by name; null: all that the machine may have"
    )
    delay: float = key(
        0.08, "time from a setpoint to its effect, over which the controller looks ahead", unit="s", low=0
    )
    lead: float = key(0.05, "how much earlier than needed rates are asked for", unit="s", low=0)
    seed: int = key(0, "seed of gusts and noise", low=0)
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key("???", "folder to write into; what is finished in it is not done again", file=True)
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly, from the place of take-off")
    plant: FlownPlantConfig = group(
        FlownPlantConfig, "the machine, with effects that the controller does not know"
    )
    mpc: MpcConfig = group(MpcConfig, "the controller")
    experiment: ExperimentConfig = group(ExperimentConfig, "what an experiment may do")
    link: LinkConfig = group(LinkConfig, "how the vehicle is reached, with by=link")
    limits: LimitsConfig = group(LimitsConfig, "when something is wrong in flight, with by=link")


COMMAND = HydraCommand(
    name="close-loop",
    schema=CloseLoopConfig,
    groups={"reference": "lemniscate", "plant": "hexacopter", "mpc": "default", "link": "default"},
    values={"plant": {"effects": [{"linear_drag": {"drag": [0.6, 0.6, 0.2]}}]}},
    goes_on=True,
    folder="close_loops/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.reference}",
)


def run(config: Config, job: Job) -> float | None:
    """Fly, diagnose, experiment, fly again; RMSE of the position after over before, None where it is not known."""
    from ..closed_loop import close_loop

    return close_loop(config, job)
