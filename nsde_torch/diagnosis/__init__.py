"""From the residual of a declared model to the effect that it lacks."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.diagnosis.decisions import Budgets, Decisions, Options, Wording
    from nsde_torch.diagnosis.pipeline import diagnose
    from nsde_torch.diagnosis.report import write_report
    from nsde_torch.diagnosis.result import Diagnosis

__all__ = ["Budgets", "Decisions", "Diagnosis", "Options", "Wording", "diagnose", "write_report"]

__getattr__ = resolver(__name__)
