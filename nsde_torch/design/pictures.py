"""The picture of a plan: what is done, and what one would see if each member were true."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nsde_torch.plots.experiment import Course, Seen, experiment_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.design.experiment import Experiment

_STATES = 4
_POINTS = 600


def picture(experiment: Experiment) -> Figure:
    """Inputs over time, states with their 90 % bands for each member, and the expected evidence of all plans."""
    e, units = experiment, experiment.units
    t = e.dt * np.arange(len(e.plan.table) + 1, dtype=np.float64)
    some = np.unique(np.linspace(0, len(t) - 1, min(len(t), _POINTS)).round().astype(int))
    inputs = np.concatenate((e.plan.table, e.plan.table[-1:]))
    unit = {"yaw": "rad", **units}
    given = [Course(f"{name} [{unit[name]}]", t, inputs[:, i]) for name, i in e.given.items()]
    seen = []
    for i in _telling(experiment):
        name = e.system.state_names[i]
        bands = []
        for r in e.plan.rehearsed:
            low, middle, high = np.quantile(r.states[:, some, i], [0.05, 0.5, 0.95], axis=0)
            bands.append((low, middle, high))
        seen.append(Seen(f"{name} [{units[name]}]", t[some], tuple(bands)))
    plans = [e.plan, *e.baselines]
    nats, q = None, e.question
    if not q.parameters:
        nats = {p.name: [p.nats(i) for i in range(len(q.names))] for p in plans}
    title = (
        f"An experiment to show {', '.join(q.parameters)}"
        if q.parameters
        else f"Which is true: {' or '.join(q.names)}?"
    )
    return experiment_figure(given, seen, q.names, nats, title=title)


def _telling(e: Experiment) -> list[int]:
    """States to draw: those in which members differ most beside what their parameters leave open."""
    spread = [r.states.std(0).mean(0) for r in e.plan.rehearsed]
    middle = [np.median(r.states, 0) for r in e.plan.rehearsed]
    apart = max((np.abs(a - b).max(0) for a in middle for b in middle), key=lambda d: float(d.sum()))
    order = np.argsort(-apart / np.maximum(np.mean(spread, 0), 1e-12))[:_STATES]
    return sorted(int(i) for i in order)
