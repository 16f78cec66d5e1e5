"""Figures: functions of arrays that return a matplotlib `Figure`; `save` writes it.

Nothing here touches pyplot or a screen, and matplotlib is imported by the first figure, not by this package.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.plots.data_figure import data_summary
    from nsde_torch.plots.evaluation import (
        DistanceSlice,
        PredictionBand,
        calibration_curve,
        calibration_of_models,
        distance_map,
        evolution,
        horizon_errors,
        learning_curves,
        rollout_bands,
        slice_grid,
    )
    from nsde_torch.plots.style import save, warn

__all__ = names(__name__)
__getattr__ = resolver(__name__)
