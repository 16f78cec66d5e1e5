"""Figures 15 and 16 of the supplement: what the flights hold, and the neural SDE against system identification."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from nsde_torch import plots
from nsde_torch.data import DataSet, Run, Windows
from nsde_torch.evaluation.metrics import evaluate
from nsde_torch.models.model import Model, inputs_before
from nsde_torch.plots import PredictionBand
from nsde_torch.plots.data_figure import roll_pitch_yaw, speed_and_angles
from nsde_torch.systems import System

from .outcome import Check, ExperimentOutcome, errs_less, prediction, rollout

# Supplement D: 95 % of the magnitudes lie below the first, the largest is the second.
_FIGURE_15 = {"speed_m/s": (1.71, 2.7), "roll_deg": (18, 23), "pitch_deg": (13, 23), "yaw_deg": (24, 80)}
Models = Mapping[str, Sequence[Model]]
_SECONDS = (73.0, 66.0, 64.0)
_TOLERANCE = 0.1
_SHOWN_S = 2.0
_FROM_S = 0.25


def recorded(data: DataSet, system: System, *, data_name: str, note: str = "") -> ExperimentOutcome:
    """Speed and Euler angles of flights, held against the supplement's figures; `note` says what is known of them."""
    size = np.abs(np.concatenate([speed_and_angles(run.x, system) for run in data.runs]))
    q95, top = np.quantile(size, 0.95, axis=0), size.max(axis=0)
    seconds = sorted((run.duration for run in data.runs), reverse=True)
    checks = [
        Check(
            "three flights of 73, 66 and 64 s",
            ", ".join(f"{s:.0f}" for s in seconds) + " s",
            len(seconds) == 3 and all(abs(a - b) < 1.0 for a, b in zip(seconds, _SECONDS, strict=True)),
        )
    ]
    for k, (name, (most, largest)) in enumerate(_FIGURE_15.items()):
        quantity, unit = name.split("_")
        near = abs(q95[k] / most - 1) <= _TOLERANCE and abs(top[k] / largest - 1) <= _TOLERANCE
        claim = f"{quantity}: 95 % below {most:g}, largest near {largest:g} {unit} (within {_TOLERANCE:.0%})"
        checks.append(Check(claim, f"{q95[k]:.3g} and {top[k]:.3g} {unit}", bool(near)))
    return ExperimentOutcome(
        title=f"Flight data ({data_name}): speed and Euler angles",
        source="The flights for training are slow and flat most of the time.",
        checks=checks,
        figures={"flights": plots.data_summary(data, system)},
        values={
            n: {"q95": float(a), "largest": float(b)} for n, a, b in zip(_FIGURE_15, q95, top, strict=True)
        },
        notes=[note] if note else [],
    )


def against_identification(
    models: Models, tests: Sequence[Sequence[Run]], *, data_name: str, note: str, seed: int
) -> ExperimentOutcome:
    """Neural SDE against least-squares system identification on held-out flights."""
    names = {"sde": "neural SDE", "sysid": "system ID"}
    scores = {
        k: [evaluate(m, t, seed=seed) for m, t in zip(ms, tests, strict=True)] for k, ms in models.items()
    }
    groups, horizons = (scores["sde"][0][key] for key in ("units", "horizons_s"))
    keys = [f"{h:g}" for h in horizons]
    values: dict[str, dict[str, dict[str, float]]] = {}
    for kind, results in scores.items():
        errors = [r["errors"]["model"] for r in results]
        values[kind] = {g: {h: float(np.mean([e[g][h] for e in errors])) for h in keys} for g in groups}
    checks = []
    for key in (key for key in keys if float(key) >= _FROM_S):
        pairs = {g: (values["sde"][g][key], values["sysid"][g][key]) for g in groups}
        checks.append(errs_less(key, "system ID", pairs, groups))
    return ExperimentOutcome(
        title=f"Hexacopter ({data_name}): neural SDE against system identification on held-out flights",
        source="The neural SDE predicts held-out flight more accurately than system identification, with intervals.",
        checks=checks,
        figures={"evolution": _evolution(models, tests[0], names, data_name, seed)},
        values=values,
        notes=[note] if note else [],
    )


def _evolution(
    models: Models, test: Sequence[Run], names: Mapping[str, str], data_name: str, seed: int
) -> object:
    first = models["sde"][0]
    s, dt = first.system, first.spec.dt
    assert s.quaternion is not None
    windows = Windows(test, dt, round(_SHOWN_S / dt), dtype=first.clock_scale.dtype)
    every, _, _ = windows.batch(torch.arange(len(windows)))
    velocity = [s.state_names.index(n) for n in ("v_x", "v_y", "v_z")]
    speed = every[..., velocity].norm(dim=-1).mean(1)
    at = speed.argsort()[len(speed) // 2][None]  # of median speed: neither a hover nor the wildest moment
    x, u, _ = windows.batch(at)
    before = inputs_before(s, windows, at)
    channels = [*range(6), *range(10, 13)]

    def shown(state: np.ndarray) -> np.ndarray:
        return np.concatenate([state[..., channels], roll_pitch_yaw(state[..., s.quaternion])], -1)

    truth = shown(x[0].double().numpy())
    drawn = []
    for kind, members in models.items():
        paths = rollout(members[0], x[:, 0], u, seed=seed, measurement=True, u_before=before)[:, 0]
        if kind == "sde":
            states = np.stack([shown(p) for p in paths.double().numpy()])
            low, high = np.quantile(states, [0.025, 0.975], axis=0)
            drawn.append(PredictionBand(names[kind], states.mean(0), low, high))
        else:
            mean = prediction(members[0], paths, names[kind], interval=False).mean
            drawn.append(PredictionBand(names[kind], shown(mean)))
    return plots.evolution(
        np.arange(windows.horizon + 1, dtype=np.float64) * dt,
        truth,
        drawn,
        names=[*(s.state_names[i] for i in channels), "roll", "pitch", "yaw"],
        units=[*(s.state_units[i] for i in channels), "deg", "deg", "deg"],
        title=f"Hexacopter ({data_name}), held-out {windows.locate(at)[0][0]}: open-loop prediction",
        truth_name="measured",
        columns=2,
    )
