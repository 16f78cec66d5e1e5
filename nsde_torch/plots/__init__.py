"""Figures: functions of arrays that return a matplotlib `Figure`; `save` writes it.

Nothing here touches pyplot or a screen, and matplotlib is imported by the first figure, not by this package.
"""

from nsde_torch.plots.calibration import calibration_curve
from nsde_torch.plots.data_figure import data_summary
from nsde_torch.plots.distance import DistanceSlice, distance_map, slice_grid
from nsde_torch.plots.horizon import horizon_errors
from nsde_torch.plots.learning_figure import learning_curves
from nsde_torch.plots.rollouts import rollout_bands
from nsde_torch.plots.style import save

__all__ = [
    "DistanceSlice",
    "calibration_curve",
    "data_summary",
    "distance_map",
    "horizon_errors",
    "learning_curves",
    "rollout_bands",
    "save",
    "slice_grid",
]
