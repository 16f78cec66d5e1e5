"""Do declared parameters survive states that were smoothed before they were logged?

    python benchmarks/bench_smoothed_states.py --seed 1

Ten smoothers of SciPy, each with a cut-off between 2 and 20 Hz drawn at random, over all states or some of them, on two
runs of each of four machines: `identify_in_loop` on the raw log, on the smoothed log kept as it is, and on the
smoothed log as `nsde_torch.read` restores it. A parameter is right within 5 % of the truth, or where its 90 % interval
holds the truth; otherwise it is confidently wrong.
"""

from collections.abc import Callable, Sequence

import numpy as np
from common import Array, Json, head, line, options
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import bessel, butter, savgol_filter, sosfilt, sosfilt_zi, sosfiltfilt
from study import labelled

import nsde_torch
from nsde_torch.data import DataSet, RawRun
from nsde_torch.errors import NonFiniteError
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.systems import System, make_system

Filter = Callable[[Array, float, float], Array]
"""Columns (n, C), a cut-off [Hz], a step [s]."""


def _twice(order: int, design: Callable[..., Array] = butter) -> Filter:
    def smooth(x: Array, cut: float, dt: float) -> Array:
        return np.asarray(sosfiltfilt(design(order, min(cut, 0.45 / dt), fs=1 / dt, output="sos"), x, axis=0))

    return smooth


def _once(x: Array, cut: float, dt: float) -> Array:
    sos = butter(2, min(cut, 0.45 / dt), fs=1 / dt, output="sos")
    zi = sosfilt_zi(sos)
    return np.stack([sosfilt(sos, c, zi=zi * c[0])[0] for c in x.T], 1)


def _mean(x: Array, cut: float, dt: float) -> Array:
    return np.asarray(uniform_filter1d(x, max(3, round(0.443 / (cut * dt)) | 1), axis=0, mode="nearest"))


def _savgol(x: Array, cut: float, dt: float) -> Array:
    return np.asarray(savgol_filter(x, max(6, round(4 / (3.2 * cut * dt))) | 1, 3, axis=0))


def _spline(x: Array, cut: float, dt: float) -> Array:
    rows, penalty = np.arange(len(x), dtype=np.float64), (2 * np.pi * cut * dt) ** -4.0
    return np.stack([make_smoothing_spline(rows, c, lam=penalty)(rows) for c in x.T], 1)


FILTERS: dict[str, Filter] = {
    "Butterworth 2, zero-phase": _twice(2),
    "Butterworth 4, zero-phase": _twice(4),
    "Butterworth 6, zero-phase": _twice(6),
    "exponential, zero-phase": _twice(1),
    "Butterworth 2, causal": _once,
    "Bessel 3, zero-phase": _twice(3, bessel),
    "Gaussian": lambda x, cut, dt: gaussian_filter1d(x, 0.187 / (cut * dt), axis=0, mode="nearest"),
    "moving average": _mean,
    "Savitzky-Golay 3": _savgol,
    "smoothing spline": _spline,
}
MACHINES: dict[str, tuple[tuple[str, ...], float]] = {
    "mass_spring_damper": ((), 60.0),
    "cartpole": ((), 60.0),
    "hexacopter": (("linear_drag", "motor_lag"), 60.0),
    "quadrotor": (("linear_drag", "motor_lag"), 60.0),
}
"""Machine -> effects that it has and the model is told of; length of a run [s]."""

HOW = ("raw", "kept", "restored")


def truths(truth: Json) -> dict[str, float]:
    effects = {effect: e["parameters"] for effect, e in truth["effects"].items()}
    return {name: p["value"] for name, p in truth["declared"].items()} | dict(labelled(effects))


def judged(machine: str, data: DataSet, true: dict[str, float]) -> Json:
    system = make_system(machine, effects=list(MACHINES[machine][0]))
    try:
        found = identify_in_loop(system, data.runs, clock=data.clock_scale)
    except NonFiniteError:  # refused
        return {"parameters": {}, "settled": False}
    half = found.half_widths(0.9)
    out: Json = {}
    for label, value, width in zip(found.vector.labels, found.values.tolist(), half.tolist(), strict=True):
        error = abs(value - true[label])
        held = np.isnan(width) or error <= width  # nan: no interval is given
        out[label] = {"relative": error / abs(true[label]), "held": bool(held)}
    return {"parameters": out, "settled": found.converged}


def smoothed(
    runs: Sequence[RawRun], system: System, columns: list[int], smooth: Filter, *to: float
) -> list[RawRun]:
    out = []
    for run in runs:
        x = run.x.copy()
        x[:, columns] = smooth(x[:, columns], *to)
        if system.quaternion is not None:
            x[:, system.quaternion] /= np.linalg.norm(x[:, system.quaternion], axis=1, keepdims=True)
        out.append(RawRun(run.name, run.t, x, run.u, dict(run.extra), run.source))
    return out


def wrong(one: Json) -> list[str]:
    return [k for k, p in one["parameters"].items() if p["relative"] > 0.05 and not p["held"]]


def main() -> None:
    given = options(__doc__, seed=1).parse_args()
    rng = np.random.default_rng(given.seed)
    results = []
    worst = [f"{how}: worst" for how in HOW]
    about = ("machine", "smoothed", "smoother", "cut-off [Hz]", "found")
    head(*about, *worst, "confidently wrong: raw, kept, restored")
    for machine, (effects, seconds) in MACHINES.items():
        told = machine in ("hexacopter", "quadrotor")
        made = nsde_torch.simulate(machine, durations=[seconds] * 2, seed=given.seed, declared_only=not told)
        true, dt = truths(made.truth), float(made.truth["dt_s"])
        system = make_system(machine, effects=list(effects))
        raw = judged(machine, nsde_torch.read(made.runs, system=system, state_smoothing="keep"), true)
        for number, (name, smooth) in enumerate(FILTERS.items()):
            cut = float(np.exp(rng.uniform(np.log(2.0), np.log(20.0))))
            some = list(range(6)) if told and number % 3 == 1 else list(range(system.nx))
            log = smoothed(made.runs, system, some, smooth, cut, dt)
            kept = judged(machine, nsde_torch.read(log, system=system, state_smoothing="keep"), true)
            data = nsde_torch.read(log, system=system)
            every = dict(zip(HOW, (raw, kept, judged(machine, data, true)), strict=True))
            found = [f.values for f in data.summary.findings if f.kind == "state_smoothing"]
            results.append(every)
            words = [f"{v['smoother']} {v['order'] or ''} to {v['band_hz']:.3g} Hz" for v in found]
            off = [[p["relative"] for p in one["parameters"].values()] for one in every.values()]
            count = ", ".join(str(len(wrong(one))) for one in every.values())
            cells = [machine, "all states" if len(some) == system.nx else "p, v", name, f"{cut:.1f}"]
            cells += ["; ".join(words) or "nothing", *(f"{100 * max(v, default=np.nan):.1f} %" for v in off)]
            print(line([*cells, count]), flush=True)
    for key in HOW:
        parameters = [p for r in results for p in r[key]["parameters"].values()]
        bad = sum(bool(wrong(r[key])) for r in results)
        right, held = sum(p["relative"] <= 0.05 for p in parameters), sum(p["held"] for p in parameters)
        print(
            f"\n{key}: {right} of {len(parameters)} parameters within 5 %, {held} held by their 90 % interval; "
            f"{bad} of {len(results)} data sets with a parameter that is confidently wrong"
        )


if __name__ == "__main__":
    main()
