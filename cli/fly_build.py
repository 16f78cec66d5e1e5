"""From the configuration of `nsde fly` to the predictive controller in a process of its own."""

from __future__ import annotations

from omegaconf import DictConfig

from nsde_torch.control.reference import Reference
from nsde_torch.px4.predictive import PredictiveMaker
from nsde_torch.px4.runner import Process

from . import track_build


def predictive(config: DictConfig, reference: Reference, *, lead: float) -> Process:
    """The predictive controller, which looks `lead` [s] ahead."""
    mpc = config.mpc
    return Process(
        PredictiveMaker(
            run=None if config.run == track_build.DECLARED else config.run,
            system=config.system.name,
            path=reference.path,
            problem=track_build.problem(mpc),
            solver=track_build.solver(mpc),
            safety=track_build.safety(mpc),
            lead=lead,
            threads=config.threads,
        )
    )
