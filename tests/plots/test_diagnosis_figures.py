"""Figures of a diagnosis show what they are given."""

from pathlib import Path

import numpy as np
import pytest

from nsde_torch.plots import save
from nsde_torch.plots.diagnosis import (
    Cloud,
    Panel,
    errors_before_after,
    residual_views,
)

pytestmark = pytest.mark.drawn


def cloud(offset: float) -> Cloud:
    x = np.linspace(-1, 1, 5000)
    return Cloud(x, x + offset, x[::500], x[::500] + offset, np.full(10, 0.1))


def test_a_residual_is_drawn_before_and_after_with_intervals(tmp_path: Path) -> None:
    view = Panel("v_x", "m/s2", "v_body_x", "m/s", {"before": cloud(0.5), "after": cloud(0.0)}, note="odd")
    figure = residual_views([view, view, view], title="left over")
    drawn = [ax for ax in figure.axes if ax.axison]
    assert len(drawn) == 3
    assert drawn[0].get_xlabel() == "v_body_x [m/s]"
    assert "v_x" in drawn[0].get_ylabel()
    assert "m/s²" in drawn[0].get_ylabel()
    assert drawn[0].get_title() == "odd"
    assert len(drawn[0].containers) == 2
    # a page stays small: the scatter is thinned
    scatters = [c for c in drawn[0].collections if hasattr(c, "get_sizes") and len(c.get_sizes())]
    assert max(len(c.get_offsets()) for c in scatters) <= 1500
    assert save(figure, tmp_path / "views.png").stat().st_size > 10_000


def errors(later: float | None) -> object:
    """Errors at two horizons before and after, the second before and its interval of the difference as given."""
    parts = ([0.2, later], [0.1, 0.1], [-0.12, later and -0.35], [-0.08, later and -0.25])
    return errors_before_after(
        [0.1, 1.0], *({"position": p} for p in parts), {"position": "m"}, title="errors"
    )


def test_errors_stand_at_their_horizons_with_the_interval_of_the_difference() -> None:
    (ax,) = errors(0.4).axes
    assert "inputs replayed" in ax.get_ylabel()
    assert ax.lines[0].get_ydata().tolist() == [0.2, 0.4]
    (bars,) = ax.containers
    segments = [s[:, 1].tolist() for s in bars.lines[2][0].get_segments()]
    assert segments == [pytest.approx([0.08, 0.12]), pytest.approx([0.05, 0.15])]
