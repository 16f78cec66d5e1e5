"""Evolution of a state: the truth stays in sight whatever the models do."""

import numpy as np
import pytest

from nsde_torch.plots import PredictionBand, evolution

T = np.linspace(0.0, 2.0, 21)


def test_channels_of_one_unit_share_their_scale_so_that_a_still_one_looks_still() -> None:
    truth = np.stack((T, 0.01 * T, 3 * T), axis=1)
    lost = PredictionBand("a model", np.where(T[:, None] > 1, np.nan, 1e6 * truth))
    figure = evolution(T, truth, [lost], names="abc", units=("m", "m", "rad"), title="evolution")
    spans = [np.ptp(ax.get_ylim()) for ax in figure.axes]
    assert spans[0] == pytest.approx(spans[1])
    assert spans[2] == pytest.approx(3 * spans[0])
    for ax, channel in zip(figure.axes, truth.T, strict=True):
        assert ax.get_ylim()[0] < channel.min() <= channel.max() < ax.get_ylim()[1]
