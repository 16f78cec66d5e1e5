"""From the configuration of `nsde fly` to the predictive controller in a process of its own."""

from __future__ import annotations

from omegaconf import DictConfig

from nsde_torch.control.controller import SafetyOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.px4.predictive import PredictiveMaker
from nsde_torch.px4.runner import Process

from . import track_build

LEAD = 0.1
"""Measured best on the simulated machines."""


def predictive(config: DictConfig, reference: Reference) -> Process:
    """The predictive controller."""
    mpc = config.mpc
    return Process(
        PredictiveMaker(
            run=None if config.run == track_build.DECLARED else config.run,
            system=config.system,
            path=reference.path,
            problem=track_build.problem(mpc),
            solver=SolverOptions(
                name=mpc.solver,
                iterations=mpc.iterations,
                tolerance=mpc.tolerance,
                compile=mpc.compile,
                deadline=mpc.deadline,
                cache=mpc.cache,
            ),
            safety=SafetyOptions(keep=mpc.keep, jump=mpc.jump),
            lead=LEAD if config.lead is None else config.lead,
            threads=config.threads,
        )
    )
