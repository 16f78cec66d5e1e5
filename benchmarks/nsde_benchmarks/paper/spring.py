"""Figures 5 and 9 of the supplement: a damped spring from a start outside of the training data, for 8 seconds.

The truth is the spring of supplement B, q'' = -0.5 q' - q, from [0.15 m, -0.15 m/s], in closed form.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import expm

from nsde_torch.models.model import Model
from nsde_torch.plots import evolution

from .outcome import Check, ExperimentOutcome, prediction, rollout

START = (0.15, -0.15)
SECONDS = 8.0
_A = np.array([[0.0, 1.0], [-1.0, -0.5]])
_LOST = 100.0
"""An error this many times as large as the motion is not worth a number."""


def state_evolution(models: Mapping[str, Sequence[Model]], *, title: str, seed: int) -> ExperimentOutcome:
    """Neural SDE, neural ODE and ensemble: `models[kind]` has one model per seed, `title` what they were trained on."""
    values: dict[str, dict[str, list[float]]] = {}

    drawn = []
    names = {"sde": "neural SDE", "ode": "neural ODE", "ensemble": "Gaussian ensemble"}
    t: NDArray[np.float64] = np.zeros(0)
    truth: NDArray[np.float64] = np.zeros((0, 2))
    for kind, members in models.items():
        row = values.setdefault(kind, {"relative_rmse": [], "inside_95": [], "finite_s": []})
        for index, model in enumerate(members):
            dt = model.spec.dt
            steps = round(SECONDS / dt)
            t = np.arange(steps + 1, dtype=np.float64) * dt
            truth = np.asarray([expm(_A * s) @ START for s in t], dtype=np.float64)
            x0 = torch.tensor([START]).to(model.clock_scale)
            paths = rollout(model, x0, x0.new_zeros(1, steps, 1), seed=seed, measurement=False)[:, 0]
            p = prediction(model, paths, names[kind], interval=kind != "ode")
            size = np.sqrt((truth**2).mean(0))
            error = (p.mean - truth) / size
            finite = np.isfinite(error).all(1)
            row["finite_s"].append(float(t[finite][-1]))
            row["relative_rmse"].append(float(np.sqrt((error[finite] ** 2).mean())))
            if kind == "sde":
                middle = (paths.double().quantile(0.5, dim=0).numpy() - truth) / size
                of_median = float(np.sqrt((middle[finite] ** 2).mean()))
                row.setdefault("relative_rmse_of_median", []).append(of_median)
            if p.low is not None and p.high is not None:
                inside = (p.low <= truth) & (truth <= p.high)
                row["inside_95"].append(float(inside.mean()))
            if index == 0:
                drawn.append(p)
    where = f"{title}\nfrom 0.15 m and -0.15 m/s, outside of the training data"
    figure = evolution(t, truth, drawn, names=("q", "q_dot"), units=("m", "m/s"), title=where)
    source = (
        "From a start outside of the training data the neural SDE follows the true motion for 8 s, its interval "
        "covers the truth, and it is more accurate than the neural ODE; the Gaussian ensemble diverges."
    )
    found = {"of the root mean square of the truth, and shares of 8 s": values}
    return ExperimentOutcome(title, source, _checks(values), {"evolution": figure}, found, _notes(values))


def together(*outcomes: ExperimentOutcome) -> ExperimentOutcome:
    first = outcomes[0]
    joined = ExperimentOutcome(title=first.title.split(";")[0], source=first.source)
    for outcome in outcomes:
        what = outcome.title.split("; ")[-1]
        joined.checks += [replace(check, claim=f"{what}: {check.claim}") for check in outcome.checks]
        joined.figures |= {f"{name}: {what}": figure for name, figure in outcome.figures.items()}
        joined.values[what] = outcome.values
        joined.notes += [f"{what}: {note}" for note in outcome.notes]
    return joined


def _checks(values: Mapping[str, Mapping[str, Sequence[float]]]) -> list[Check]:
    inside = float(np.mean(values["sde"]["inside_95"]))
    sde, ode = (float(np.mean(values[k]["relative_rmse"])) for k in ("sde", "ode"))
    errors = {kind: _spread(values[kind]["relative_rmse"]) for kind in values}
    covers = "the truth lies in the 95 % interval of the SDE for at least 90 % of 8 s"
    checks = [
        Check(covers, f"{inside:.1%}", inside >= 0.9),
        Check(
            "the SDE errs at most as much as the ODE", f"{errors['sde']} against {errors['ode']}", sde <= ode
        ),
    ]
    if "ensemble" in values:
        ensemble = values["ensemble"]
        lost = min(ensemble["finite_s"]) < SECONDS - 1e-6
        error = float(np.mean(ensemble["relative_rmse"]))
        claim = "the ensemble diverges or errs at least 3 times as much as the SDE"
        told = f"{errors['ensemble']}, {_times(error / sde)}"
        if lost:
            told = f"leaves the finite numbers after {min(ensemble['finite_s']):.1f} s"
        checks.append(Check(claim, told, lost or error >= 3 * sde))
    return checks


def _spread(values: Sequence[float]) -> str:
    """Mean, and standard deviation over models if there are several."""
    if np.mean(values) > _LOST:
        return f"more than {_LOST:.0f} times the truth's own size"
    mean = f"{np.mean(values):.2%}"
    return f"{mean} ± {100 * np.std(values, ddof=1):.2f}" if len(values) > 1 else mean


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < _LOST else f"more than {_LOST:.0f} times"


def _notes(values: Mapping[str, Mapping[str, Sequence[float]]]) -> list[str]:
    """What the comparison of SDE and ODE is worth."""
    sde, ode = (np.asarray(values[k]["relative_rmse"]) for k in ("sde", "ode"))
    middle = np.mean(values["sde"]["relative_rmse_of_median"])
    told = (
        f"an error is the root mean square over 8 s and both channels, relative to the truth's; of the SDE that of its "
        f"mean (that of its median is {middle:.2%})"
    )
    if len(sde) != len(ode) or len(sde) < 2:
        return [
            f"{told}. One model of each kind cannot tell models apart whose errors are alike; seeds=3 may."
        ]
    difference = sde - ode
    mean, error = difference.mean(), difference.std(ddof=1) / np.sqrt(len(difference))
    word = "more than" if abs(mean) > 2 * error else "less than"
    return [
        f"{told}. SDE minus ODE, of the same seed: {100 * mean:+.2f} % ± {100 * error:.2f} (standard error of "
        f"{len(difference)} pairs), {word} twice what seeds account for."
    ]
