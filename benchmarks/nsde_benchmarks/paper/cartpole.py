"""Figures 10, 11 and 12 of the supplement: where a cartpole model is unsure, and how it and an ensemble predict."""

from collections.abc import Mapping, Sequence
from math import pi

import numpy as np
import torch

from nsde_torch import plots
from nsde_torch.arrays import Array
from nsde_torch.data import Run, Windows
from nsde_torch.evaluation.metrics import evaluate
from nsde_torch.models.model import Model, inputs_before
from nsde_torch.models.neural_sde import NeuralSDE

from .outcome import Check, ExperimentOutcome, errs_less, prediction, rollout

_X_DOT, _THETA, _THETA_DOT = 1, 2, 3
_GRID = 90
_SHOWN_S = 2.0
_LEAST_AUROC = 0.95


def _rows(runs: Sequence[Run]) -> Array:
    return np.concatenate([run.x[a:b] for run in runs for a, b in run.segments])


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + pi) % (2 * pi) - pi)


@torch.no_grad()
def uncertainty_map(
    model: NeuralSDE, train: Sequence[Run], test: Sequence[Run], *, data_name: str, seed: int
) -> ExperimentOutcome:
    """eta over angle and speeds; `seed` draws the states that stand for "away from the data"."""
    inside, held = _rows(train), _rows(test)
    like = model.clock_scale

    def distance(states: Array) -> Array:
        return np.asarray(model.distance(torch.as_tensor(states).to(like)).double().cpu())

    turn = np.abs(inside[:, _THETA_DOT]).max()
    speed = np.abs(inside[:, _X_DOT]).max()
    grids = (
        (np.linspace(-pi, pi, _GRID), _THETA, "theta [rad], 0 is upright"),
        (np.linspace(-2.5 * speed, 2.5 * speed, _GRID), _X_DOT, "x_dot [m/s]"),
    )
    rates = np.linspace(-2.5 * turn, 2.5 * turn, _GRID)
    slices = []
    for values, column, name in grids:
        states = np.zeros((_GRID * _GRID, 4))
        if column == _X_DOT:  # where the pole hangs or stands, whichever the data know better
            states[:, _THETA] = pi if np.median(np.abs(_wrapped(inside[:, _THETA]))) > pi / 2 else 0.0
        first, second = np.meshgrid(values, rates)
        states[:, column], states[:, _THETA_DOT] = first.ravel(), second.ravel()
        eta = distance(states)
        points = [
            np.stack([_wrapped(r[:, column]) if column == _THETA else r[:, column], r[:, _THETA_DOT]], axis=1)
            for r in (inside, held)
        ]
        eta = eta.reshape(_GRID, _GRID)
        slices.append(plots.DistanceSlice(values, rates, eta, name, "theta_dot [rad/s]", *points))
    rng = np.random.default_rng(seed)
    low, high = inside.min(0), inside.max(0)
    away = (low + high) / 2 + 1.5 * (high - low) * rng.uniform(-1, 1, (5000, 4))
    near = held[rng.permutation(len(held))[:5000]]
    eta_near, eta_away = (distance(r) for r in (near, away))
    auroc = float(np.searchsorted(np.sort(eta_near), eta_away).mean() / len(eta_near))
    sigma_near, sigma_away = (
        float(model.h(torch.as_tensor(e).to(like))[:, _THETA_DOT].mean()) for e in (eta_near, eta_away)
    )
    tells = f"eta tells held-out states from states in three times the training box, AUROC at least {_LEAST_AUROC}"
    sizes = f"theta_dot: {sigma_away:.3g} against {sigma_near:.3g} rad/s per root second"
    title = f"Distance η of a cartpole model trained on {data_name} (cart speed 0 on the left)"
    return ExperimentOutcome(
        title=f"Uncertainty of a cartpole model trained on {data_name}",
        source="The learned uncertainty is low where the training data lie and grows away from them.",
        checks=[
            Check(tells, f"{auroc:.3f}", auroc >= _LEAST_AUROC),
            Check("the diffusion is larger away from the data", sizes, sigma_away > sigma_near),
        ],
        figures={"map": plots.distance_map(slices, title=title)},
        values={"auroc": auroc, "sigma_theta_dot": {"held_out": sigma_near, "away": sigma_away}},
    )


def state_evolution(
    models: Mapping[str, Sequence[Model]], test: Sequence[Run], *, seed: int
) -> ExperimentOutcome:
    """Neural SDE against Gaussian ensemble on held-out episodes: `models[kind]` has one model per seed."""
    names = {"sde": "neural SDE", "ensemble": "Gaussian ensemble"}
    scores = {k: [evaluate(m, test, seed=seed) for m in members] for k, members in models.items()}
    first = models["sde"][0]
    dt = first.spec.dt
    windows = Windows(test, dt, round(_SHOWN_S / dt), dtype=first.clock_scale.dtype)
    at = torch.tensor([len(windows) // 2])
    x, u, _ = windows.batch(at)
    before = inputs_before(first.system, windows, at)
    drawn = []
    for kind, members in models.items():
        paths = rollout(members[0], x[:, 0], u, seed=seed, measurement=True, u_before=before)[:, 0]
        drawn.append(prediction(members[0], paths, names[kind]))
    s = first.system
    figure = plots.evolution(
        np.arange(windows.horizon + 1, dtype=np.float64) * dt,
        x[0].double().numpy(),
        drawn,
        names=s.state_names,
        units=s.state_units,
        title=f"Cartpole, held-out episode {windows.locate([len(windows) // 2])[0][0]}: open-loop prediction",
        truth_name="measured",
        columns=2,
    )
    values: dict[str, dict[str, dict[str, float]]] = {kind: {} for kind in scores}
    checks, groups = [], scores["sde"][0]["units"]
    for kind, results in scores.items():
        for group in results[0]["units"] if results[0]["errors"] else ():
            for what, part, key in (("error", "errors", "model"), ("inside_95", "coverage", "0.95")):
                rows = [r[part][key][group] for r in results]
                values[kind][f"{what}_{group}"] = {
                    h: float(np.mean([r[h] for r in rows])) for h in ("0.5", "1")
                }
    for h in ("0.5", "1"):
        of = {
            kind: [made.get(f"error_{g}", {}).get(h, np.inf) for g in groups] for kind, made in values.items()
        }
        pairs = dict(zip(groups, zip(of["sde"], of["ensemble"], strict=True), strict=True))
        checks.append(errs_less(h, "the ensemble", pairs, {}))
    held = float(np.mean([values["sde"][f"inside_95_{g}"]["1"] for g in groups]))
    checks.append(
        Check("the 95 % interval of the SDE holds at least 90 % at 1 s", f"{held:.0%}", held >= 0.9)
    )
    return ExperimentOutcome(
        title="Cartpole: state evolution of the neural SDE and of the ensemble",
        source="The neural SDE follows held-out motion closely and covers it, where the ensemble drifts off.",
        checks=checks,
        figures={"evolution": figure},
        values=values,
        notes=["An error is the root mean square over starts of held-out episodes; attitude in degrees."],
    )
