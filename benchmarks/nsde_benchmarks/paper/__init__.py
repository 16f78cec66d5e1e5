"""The supplement's experiments: from trained models and data to a picture, a claim and a measurement."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_benchmarks.paper.outcome import Check, ExperimentOutcome

__all__ = ["Check", "ExperimentOutcome"]

# the command line imports this package for the keys of `nsde figures`, without torch
__getattr__ = resolver(__name__)
