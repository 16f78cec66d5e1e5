"""Bouc-Wen: a mass on a spring whose force remembers the way it came (Noel, Schoukens, 4TU.ResearchData, 2020).

    m y'' + c y' + k y + z = u,     z' = a y' - b (g |y'| z + d y' |z|)

The set is simulated, not measured: a multisine at 750 Hz whose output carries noise of 8 um is there to identify with,
and two tests without noise. Declared is the linear oscillator. Then the catalogue's hysteresis, whose two weights are
equal, and the law with free weights are fitted by output error on the mean of the periods.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.effects import Law, Parameter, Port
from nsde_torch.systems import Defaults, OneDegreeOfFreedom, ResidualPort

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import Work, long_enough, matrices
from .output_error import kept_array, machine, output_error, rms, simulated, times, windows, with_units

STEP = 1.0 / 750.0  # [s]
FINER = 2  # steps of the integrator in a sample: 34 a period at resonance
PERIOD = 8192
PERIODS = 4
SWEEP = 153000
WINDOW = 127
ITERATIONS = 25
SHOWN = 400  # samples of a picture
UNIT = 1e5  # errors are in hundredths of a millimetre
LINEAR = {"input_gain": 0.5, "linear_spring.stiffness": 4e4, "viscous_friction.damping": 10.0}
FREE = {"stiffness": 1e4, "towards": 100.0, "away": 100.0}
MODELS: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "linear": ((), LINEAR),
    "linear + hysteresis": (("hysteresis",), {"hysteresis.size": 5.0, "hysteresis.reach": 1e-3}),
    "linear + hysteresis, free weights": (
        ("nsde_benchmarks.public.boucwen:FreeHysteresis",),
        {f"free_hysteresis.{name}": value for name, value in FREE.items()},
    ),
}
"""Effects beside the linear oscillator, and first values."""


@final
class FreeHysteresis(Law):
    """Hysteresis by Bouc and Wen with exponent 1 and free weights, in the unit of the force."""

    name = "free_hysteresis"
    reads_position = True
    formula = "-z, dz/dt = k v - g |v| z - h v |z|"
    source = "Bouc, Acustica 24 (1971); Wen, J. Eng. Mech. Div. 102 (1976)"
    PARAMETERS = {
        "stiffness": Parameter(1e4, "force/position", low=0.0, scale=1e4, help="k, of a small motion"),
        "towards": Parameter(0.0, "1/position", scale=100.0, help="g, weight of |v| z"),
        "away": Parameter(0.0, "1/position", scale=100.0, help="h, weight of v |z|"),
    }
    null = {"stiffness": 0.0}
    amplitudes = ("stiffness",)
    sentence = "The force on {it} remembers the way it came (hysteresis), with {stiffness} for small motions."

    @property
    def n_memory(self) -> int:
        """The force z."""
        return 1

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -memory

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = self.v(x)
        bends = self.value("towards") * v.abs() * memory + self.value("away") * v * memory.abs()
        return self.value("stiffness") * v - bends

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`: it came from the origin."""
        return self.value("stiffness") * self.q(x)


@final
class Oscillator(OneDegreeOfFreedom):
    """A mass on a spring with a damper, under a force; its position is measured."""

    name = "bouc_wen_oscillator"
    gain = "input_gain"
    state_names = ("y", "y_dot")
    state_units = ("m", "m/s")
    input_names = ("u",)
    input_units = ("N",)
    position_derivatives = (("y", "y_dot", "world"),)
    declared = ("linear_spring", "viscous_friction")
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "m/s2")}
    PARAMETERS = {"input_gain": Parameter(0.5, "1/kg", low=0.0, help="1 / mass")}
    defaults = Defaults(STEP, 50, (1e-4, 0.1), 0.1, 1.0, "euler_maruyama")


@final
class BoucWen(PublicBenchmark):
    name = "boucwen"
    title = "Bouc-Wen: a mass on a spring with hysteresis (simulated set)"
    repository = "JanHHoekstra/Model-Augmentation-Public"
    files = tuple(
        f"data/bouc_wen/{signal}{part}.mat"
        for part in ("est_multisine", "val_multisine", "val_sinesweep")
        for signal in "uy"
    )
    protocol = (
        f"Identified on the mean of {PERIODS} periods of the noisy multisine, simulated over the two tests without "
        f"noise: a multisine of {PERIOD} samples in its steady state (the second of two periods), and a sine sweep of "
        f"{SWEEP} samples from rest; root mean square of the output, all samples."
    )
    metrics = tuple(BenchmarkMetric(test, "10 um", digits=3) for test in ("multisine", "sinesweep"))
    published = (
        *(
            PublishedRow(name, {"multisine": value}, f"arXiv 2507.09646, table 1, {source}")
            for name, value, source in (
                ("Koopman model, linear, 50 observables", 16.0, "own row"),
                ("Koopman model, bilinear, 100 observables", 3.69, "own row"),
                ("neural state space (Suykens)", 2.65, "as cited there"),
                ("Koopman model, input affine, 100 observables", 1.43, "own row"),
                ("polynomial nonlinear state space", 1.34, "as cited there"),
                ("neural state space (Suykens), improved", 0.891, "as cited there"),
                ("grey-box neural state space", 0.753, "as cited there"),
            )
        ),
        PublishedRow(
            "output error with the true law, derivative-free",
            {"multisine": 4.68, "sinesweep": 0.186},
            "IFAC-PapersOnLine 50-1 (2017) 464-469, table 4",
            "stated in %, read as 100 m",
            comparable=False,
        ),
    )
    minutes = 5

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        names = ("u", "y", *(path.stem for path in paths[2:]))
        rows_of = (PERIOD * PERIODS,) * 2 + (PERIOD,) * 2 + (SWEEP,) * 2
        signals = []
        for path, name, least in zip(paths, names, rows_of, strict=True):
            signals.append(matrices(path, (name,), what="Bouc-Wen")[name])
            long_enough(len(signals[-1]), least, path)
        u, y = (signal[: PERIOD * PERIODS].reshape(PERIODS, PERIOD).mean(0) for signal in signals[:2])
        tests = {
            "multisine": (signals[2][:PERIOD], signals[3][:PERIOD]),
            "sinesweep": (signals[4], signals[5]),
        }

        values: dict[str, Any] = {}
        rows: dict[str, dict[str, float]] = {}
        left: dict[str, float] = {}
        for name, (effects, first) in MODELS.items():
            fitted = partial(_fitted, effects, {**first, **values}, u, y, name, work)
            made = work.stage(_key("model", name), fitted)
            model, left[name] = made["values"], UNIT * made["left"]
            if not effects:
                # hysteresis carries half of what the linear spring was fitted to
                values = {**model, "linear_spring.stiffness": 0.5 * model["linear_spring.stiffness"]}
            simulate = partial(_simulated, effects, model)
            paths_of = {
                test: kept_array(
                    work, _key(test, name), partial(simulate, force, periodic=test == "multisine")
                )
                for test, (force, _) in tests.items()
            }
            rows[f"ours, {name}"] = {test: UNIT * rms(paths_of[test] - tests[test][1]) for test in tests}
        told = [f"{name} {value:.3f}" for name, value in left.items()]
        system = machine(Oscillator, effects, model)
        return BenchmarkOutcome(
            rows,
            system.effect_names[2:],
            with_units(system, model),
            [f"Left by the stretches of the fit, mean of four noisy periods [10 um]: {', '.join(told)}."],
            [_trace(test, y, paths_of[test]) for test, (_, y) in tests.items()],
        )


def _trace(test: str, measured: Array, path: Array) -> Trace:
    """Half a second around the largest motion of a test."""
    largest = int(np.abs(measured).argmax())
    part = slice(max(0, largest - SHOWN // 2), largest + SHOWN // 2)
    t = times(len(measured), STEP)[part]
    title = f"{test}, open loop, around its largest motion"
    return Trace(title, "position [mm]", t, 1e3 * measured[part], 1e3 * path[part])


def _key(*words: str) -> str:
    return "_".join(words).replace(", ", "_").replace(" + ", "_").replace(" ", "_")


def _fitted(
    effects: tuple[str, ...], first: Mapping[str, Any], u: Array, y: Array, name: str, work: Work
) -> dict[str, Any]:
    """Values whose simulations come closest to a period, in stretches that start at states and memory of their own."""
    x = np.stack([y, np.gradient(np.tile(y, 3), STEP)[PERIOD : 2 * PERIOD]], 1)
    estimate = output_error(
        machine(Oscillator, effects, first),
        windows([x], [_finer(u).reshape(-1, 1)], dt=STEP, length=WINDOW, finer=FINER),
        weights=np.array([UNIT, 0.0]),
        free=(0, 1, 2) if effects else (0, 1),
        side_by_side=True,
        iterations=ITERATIONS,
        stage=f"fitting {name}",
        say=work.say,
    )
    return {"values": estimate.values, "left": rms(estimate.errors[..., 0])}


def _simulated(effects: tuple[str, ...], values: Mapping[str, Any], u: Array, *, periodic: bool) -> Array:
    """Output (n,) from rest, or in the steady state of a periodic input."""
    fine = _finer(u) if periodic else _finer(np.pad(u, (0, PERIOD // 8)))[: len(u)]
    turns = 2 if periodic else 1
    force = np.tile(fine, (turns, 1)).reshape(1, -1, 1)
    path = simulated(machine(Oscillator, effects, values), np.zeros((1, 2)), force, dt=STEP, finer=FINER)
    out: Array = path[0, (turns - 1) * len(u) : turns * len(u), 0]
    return out


def _finer(u: Array) -> Array:
    """The band-limited input at the middles of the fine steps of each sample (n, FINER); it is taken to be periodic."""
    spectrum = np.fft.rfft(u)
    turn = 2j * np.pi * np.fft.rfftfreq(len(u))
    shifts = (np.arange(FINER) + 0.5) / FINER
    return np.stack([np.fft.irfft(spectrum * np.exp(turn * shift), len(u)) for shift in shifts], 1)
