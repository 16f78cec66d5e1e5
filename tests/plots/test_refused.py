"""What does not fit into a figure is refused by its name."""

from collections.abc import Callable

import numpy as np
import pytest

from nsde_torch import plots
from nsde_torch.errors import ShapeError
from nsde_torch.plots.diagnosis import before_after, errors_before_after, residual_spectra, residual_views
from nsde_torch.plots.policy_rewards import policy_rewards

ONE, T = {"position": [0.1]}, np.arange(21.0)
STATES = {"names": ["q", "q_dot"], "units": ["m", "m/s"], "title": ""}
SHARES = {"a": ONE, "b": {"position": [0.1, 0.5]}}
CHANNEL = {"names": "a", "units": "m", "title": ""}


def bands(*shape: int) -> Callable[[], object]:
    """Samples of this shape, drawn over 21 rows of two states."""
    return lambda: plots.rollout_bands(T, np.zeros((21, 2)), np.zeros(shape), **STATES)


def flat(*shape: int) -> plots.DistanceSlice:
    """A slice of three by four places."""
    return plots.DistanceSlice(
        np.arange(3.0), np.arange(4.0), np.zeros(shape), "a [m]", "b [m]", np.zeros((1, 2))
    )


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "an empty history": (lambda: plots.learning_curves([]), "history"),
    "samples of fewer rows": (bands(30, 20, 2), "samples"),
    "samples of more states": (bands(30, 21, 3), "samples"),
    "samples of more starts": (bands(2, 30, 21, 2), "samples"),
    "a curve of another length": (lambda: plots.calibration_curve([0.5, 0.9], {"rate": [0.5]}), "rate"),
    "a model's curve of another length": (
        lambda: plots.calibration_of_models([0.1], SHARES, horizons=[1.0], per_horizon=SHARES),
        r"empirical\['b'\]",
    ),
    "rollouts of models": (
        lambda: plots.rollouts_of_models(
            {"a": T}, {"a": np.zeros((21, 2))}, {"a": np.zeros((5, 22, 2))}, **STATES
        ),
        r"measured\['a'\]",
    ),
    "a prediction of another length": (
        lambda: plots.evolution(
            T, np.zeros((21, 1)), [plots.PredictionBand("a model", np.zeros((20, 1)))], **CHANNEL
        ),
        "a model",
    ),
    "eta that does not fit its axes": (lambda: plots.distance_map([flat(3, 4)]), "eta"),
    "no panels": (lambda: residual_views([], title=""), "panel"),
    "no channels": (lambda: residual_spectra([], title=""), "channel"),
    "errors of one horizon for two": (
        lambda: errors_before_after([0.1, 1.0], ONE, ONE, ONE, ONE, {"position": "m"}, title=""),
        "position",
    ),
    "gains of no channel": (
        lambda: before_after({"v_x": (1.0, None, None)}, {}, title="none"),
        "same channels",
    ),
    "no rewards": (lambda: policy_rewards({}), "curves"),
    "no seeds": (lambda: policy_rewards({"SDE": []}), "curves"),
    "an empty curve": (lambda: policy_rewards({"SDE": [[]]}), "curves"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_into_a_figure_is_refused_by_its_name(what: str) -> None:
    draw, named = REFUSED[what]
    with pytest.raises(ShapeError, match=named):
        draw()
