"""Silverbox: a circuit that behaves as a mass on a hardening spring (Wigren, Schoukens, ECC 2013).

    m y'' + d y' + a y + b y^3 = u

Only the output y is measured, at 610.35 Hz. Declared is the linear oscillator. Terms of the catalogue are tried one
after another by output error on the multisine: one is taken where the simulation of held-out stretches is better by
more than `GAIN`, the best first. The input is band-limited, so it is not held over a sample: it is resampled to a finer
grid, and the middle of each fine step is what acts.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, OneDegreeOfFreedom, ResidualPort

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import Work, long_enough, matrices
from .named import ladder, words_of
from .output_error import kept_array, machine, output_error, rms, simulated, times, windows

STEP = 2.0**14 / 1e7  # [s]
FINER = 2  # steps of the integrator in a sample: 17 a period at resonance
ARROW = slice(100, 40575)
INSIDE = 32000  # samples of the arrow whose amplitude the multisine has too
MULTISINE = slice(40650, 127400)
TRAINED = 0.75
SKIPPED = 50  # first samples of each test, from which the first state is estimated
WINDOW = 200
STRETCHES = 30
CANDIDATES = ("constant_force", "cubic_stiffness", "quadratic_damping")
GAIN = 0.05
NORM = 1e3  # errors are in millivolts
WEIGHTS = np.array([NORM, 0.0])


@final
class SilverboxCircuit(OneDegreeOfFreedom):
    """An oscillator of one degree of freedom in volts: a spring and a damper are declared."""

    name = "silverbox"
    gain = "input_gain"
    state_names = ("y", "y_dot")
    state_units = ("V", "V/s")
    input_names = ("u",)
    input_units = ("V",)
    position_derivatives = (("y", "y_dot", "world"),)
    declared = ("linear_spring", "viscous_friction")
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "V/s2")}
    PARAMETERS = {"input_gain": Parameter(1.8e5, "1/s2", low=0.0, scale=1e4, help="gain of the input")}
    defaults = Defaults(STEP, 50, (1e-4, 0.1), 0.1, 1.0, "euler_maruyama")


@final
class Silverbox(PublicBenchmark):
    name = "silverbox"
    title = "Silverbox: a circuit with a cubic spring, output alone measured"
    repository = "biaslab/nsi-silverbox"
    files = ("data/Silverbox/SNLS80mV.mat",)
    protocol = (
        "Identified on the first 75 % of the multisine, simulated over the whole arrow (samples 100 to 40575; its last "
        "fifth is louder than the multisine) and over the rest of the multisine; root mean square of the output after "
        "the first 50 samples, of which the first state is estimated."
    )
    metrics = tuple(BenchmarkMetric(test, "mV") for test in ("arrow", "arrow_no_extrapolation", "multisine"))
    published = (
        PublishedRow(
            "NARX, polynomial of degree 3, prediction error",
            {"arrow": 0.638965},
            "biaslab/nsi-silverbox, experiments/experiment-NARMAXpol3.ipynb",
            "samples 1000 to 40499",
        ),
        PublishedRow(
            "nonlinear ARX, neural network",
            {"arrow": 0.667907},
            "biaslab/nsi-silverbox, experiments/experiment-NLARX.ipynb",
            "root of the mean square error stated",
        ),
    )
    minutes = 5

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        held = matrices(paths[0], ("V1", "V2"), what="Silverbox")
        u, y = held["V1"], held["V2"]
        long_enough(min(len(u), len(y)), MULTISINE.stop, paths[0])
        record = _Record(_finer(u), y)
        middle = MULTISINE.start + round(TRAINED * (MULTISINE.stop - MULTISINE.start))

        def tried(effects: tuple[str, ...], first: Mapping[str, Any]) -> dict[str, Any]:
            return work.stage(
                "model_" + "_".join(["linear", *effects]),
                lambda: record.tried(effects, first, MULTISINE.start, middle, work),
            )

        rungs = ladder(tried, CANDIDATES, first=_FIRST, error="held_out_mV", gain=GAIN)
        taken = tuple(rungs[-1]["effects"])
        tests = {"arrow": ARROW, "multisine": slice(middle, MULTISINE.stop)}
        rows: dict[str, dict[str, float]] = {}
        traces = []
        for made, name in ((rungs[0], "linear oscillator"), (rungs[-1], " + ".join(["linear", *taken]))):
            errors = {}
            for test, part in tests.items():
                path = record.simulated(made, part, f"{test}_{'_'.join(['linear', *made['effects']])}", work)
                errors[test] = (path - y[part])[SKIPPED:]
                if made is rungs[-1]:
                    t = times(len(path), STEP)
                    traces.append(Trace(f"{test}, open loop", "output [V]", t, y[part], path))
            scored = {**errors, "arrow_no_extrapolation": errors["arrow"][: INSIDE - SKIPPED]}
            rows[f"ours, {name}"] = {m.key: NORM * rms(scored[m.key]) for m in self.metrics}
        return BenchmarkOutcome(
            rows,
            taken,
            {name: {"value": value} for name, value in rungs[-1]["values"].items()},
            words_of(taken, "the linear oscillator"),
            traces,
            {"ladder": [{"effects": m["effects"], "held_out_mV": m["held_out_mV"]} for m in rungs]},
        )


class _Record:
    """The whole recording: input on the fine grid (n * FINER,) and output (n,)."""

    def __init__(self, u: Array, y: Array) -> None:
        self.u, self.y = u, y

    def _cut(self, start: int, stop: int, length: int, stride: int) -> Any:
        x = np.stack([self.y[start:stop], np.gradient(self.y[start:stop], STEP)], 1)
        u = self.u[start * FINER : stop * FINER, None]
        return windows([x], [u], dt=STEP, length=length, stride=stride, finer=FINER)

    def tried(
        self, effects: tuple[str, ...], first: Mapping[str, Any], start: int, stop: int, work: Work
    ) -> dict[str, Any]:
        """Values on every other stretch of the training part, and the error on those between."""
        stride = max(2 * WINDOW, (stop - start) // STRETCHES)
        data = self._cut(start, stop, WINDOW, stride)
        system = machine(SilverboxCircuit, effects, first)
        name = " + ".join(["linear", *effects])
        how: dict[str, Any] = {"weights": WEIGHTS, "free": (0, 1)}
        made = output_error(system, data, iterations=12, stage=f"fitting {name}", say=work.say, **how)
        other = self._cut(start + stride // 2, stop, WINDOW, stride)
        fixed = tuple(made.values)
        starts = output_error(system, other, fixed=fixed, iterations=4, stage="checking", **how)
        error = NORM * rms(starts.errors[..., 0])
        return {"effects": list(effects), "values": made.values, "held_out_mV": error}

    def simulated(self, made: Mapping[str, Any], part: slice, name: str, work: Work) -> Array:
        """Output over a test, from a state that its first samples show."""

        def make() -> Array:
            system = machine(SilverboxCircuit, made["effects"], {**_FIRST, **made["values"]})
            first = self._cut(part.start, part.start + SKIPPED + 1, SKIPPED, SKIPPED)
            fixed = tuple(made["values"])
            how: dict[str, Any] = {"weights": WEIGHTS, "free": (0, 1), "fixed": fixed, "iterations": 8}
            start = output_error(system, first, stage="first state", **how).starts
            u = self.u[None, part.start * FINER : (part.stop - 1) * FINER, None]
            return simulated(system, start, u, dt=STEP, finer=FINER)[0, :, 0]

        return kept_array(work, name, make)


_FIRST = {"linear_spring.stiffness": 1.8e5, "viscous_friction.damping": 30.0}


def _finer(u: Array) -> Array:
    """The band-limited input at the middles of the fine steps."""
    from scipy.signal import resample_poly

    fine: Array = resample_poly(u, 2 * FINER, 1)[1::2]
    return fine
