"""From the residual of a declared model to the effect that it lacks."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.diagnosis.options import Options
    from nsde_torch.diagnosis.pipeline import diagnose
    from nsde_torch.diagnosis.report import write_report
    from nsde_torch.diagnosis.result import Diagnosis

__all__ = [
    "Diagnosis",
    "Options",
    "diagnose",
    "write_report",
]

__getattr__ = resolver(
    __name__,
    {
        "Diagnosis": "result",
        "Options": "options",
        "diagnose": "pipeline",
        "write_report": "report",
    },
)
