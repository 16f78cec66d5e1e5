"""Learning curves of policies: mean over seeds at the same interactions, lines of reference, what is refused."""

from __future__ import annotations

import numpy as np

from nsde_torch.plots.policy_rewards import policy_rewards


def curve(offset: float, every: int = 10) -> list[dict[str, float]]:
    made = range(0, 101, every)
    return [
        {"interactions": n, "truth_reward": n + offset, "environment_reward": 2 * n + offset} for n in made
    ]


def test_lines_are_means_over_seeds_and_the_spread_is_shown() -> None:
    figure = policy_rewards({"SDE": [curve(0.0), curve(10.0, every=20)], "ODE": [curve(0.0)]}, random=-5.0)
    left, right = figure.axes
    assert [ax.get_title() for ax in (left, right)] == ["SDE\n2 seeds", "ODE\n1 seed"]
    imagined, true = left.lines[:2]
    np.testing.assert_allclose(true.get_xdata(), np.arange(0, 101, 20) / 1e3)
    np.testing.assert_allclose(true.get_ydata(), np.arange(0, 101, 20) + 5.0)
    np.testing.assert_allclose(imagined.get_ydata(), 2.0 * np.arange(0, 101, 20) + 5.0)
    assert len(left.collections) == 2
    assert not right.collections


def test_references_are_named_in_the_legend() -> None:
    figure = policy_rewards({"SDE": [curve(0.0)]}, random=-5.0, truth=90.0, limited=10.0)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    limited = "trained on as much of the truth as the models"
    assert words[2:] == ["trained on the truth", limited, "random actions"]
