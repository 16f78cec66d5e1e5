"""Reward per episode against interactions while policies learn, one panel for each environment."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.plots.style import BLACK, BLUE, GREEN, GREY, VERMILLION, legend_below, panels, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curve = Sequence[Mapping[str, float]]

_TITLE = 14  # letters on a line above a panel


@styled
def policy_rewards(
    curves: Mapping[str, Sequence[Curve]],
    *,
    random: float | None = None,
    truth: float | None = None,
    limited: float | None = None,
    title: str = "Reward of policies while they learn",
) -> Figure:
    """Mean over seeds, and one standard deviation over seeds to each side, on the truth and where they learn.

    Curves are by the name of an environment, one per seed: rows with `interactions`, `truth_reward` and
    `environment_reward`. `limited` is the reward of policies that had no more of the truth than the
    models' training data.
    """
    figure, axes = panels(1, len(curves), height=3.8, title=title, sharey=True)
    most = max(map(len, curves.values()))
    handles: dict[str, object] = {}
    for ax, (name, runs) in zip(axes[0], curves.items(), strict=True):
        for column, colour, dash, label in (
            ("environment_reward", GREY, ":", "in the environment it learns in"),
            ("truth_reward", BLUE, "-", "on the truth"),
        ):
            n, mean, std = _over_seeds(runs, column)
            handles[label] = ax.plot(n / 1e3, mean, color=colour, linestyle=dash)[0]
            if len(runs) > 1:
                ax.fill_between(n / 1e3, mean - std, mean + std, color=colour, alpha=0.2, linewidth=0)
        for value, colour, label in (
            (truth, GREEN, "trained on the truth"),
            (limited, VERMILLION, "trained on as much of the truth as the models"),
            (random, BLACK, "random actions"),
        ):
            if value is not None:
                handles[label] = ax.axhline(value, color=colour, linestyle="--", linewidth=1.0)
        shown = textwrap.fill(name, _TITLE)
        ax.set_title(shown if most == 1 else f"{shown}\n{len(runs)} seed{'s' * (len(runs) > 1)}")
        ax.set_xlabel("interactions / 1000")
    axes[0, 0].set_ylabel("reward per episode" + ("\nmean ± std over seeds" if most > 1 else ""))
    legend_below(figure, list(handles.values()), list(handles))
    return figure


def _over_seeds(runs: Sequence[Curve], column: str) -> tuple[Array, Array, Array]:
    """Mean and standard deviation over seeds at the interactions of the shortest curve."""
    shortest = min(runs, key=len)
    n = np.array([row["interactions"] for row in shortest], dtype=float)
    values = []
    for run in runs:
        at = np.array([row["interactions"] for row in run], dtype=float)
        values.append(np.interp(n, at, np.array([row[column] for row in run], dtype=float)))
    table = np.array(values)
    return n, table.mean(0), table.std(0)
