"""The supplement's experiments: from trained models and data to a picture, a claim and a measurement."""

from nsde_torch.experiments.outcome import Check, ExperimentOutcome

__all__ = ["Check", "ExperimentOutcome"]
