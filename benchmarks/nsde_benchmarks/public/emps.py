"""EMPS: a carriage on a rail, driven by a motor with dry friction, in closed loop (Janot, Gautier, Brunot, 2019).

    M q'' = tau - F_v q' - F_c sign(q') + offset

Two runs of the same reference at 1 kHz; in the second, pulses of force disturb it. Declared are mass and viscous
friction; dry friction and offset are to be found. The model is identified on the first run and simulated over the
whole of the second from its first position at rest, with the measured force alone.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Parameter, Port
from nsde_torch.errors import DataError
from nsde_torch.systems import Defaults, OneDegreeOfFreedom, ResidualPort, System

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import Work, long_enough, matrices
from .named import diagnosed, words_of
from .output_error import kept_array, machine, output_error, rms, simulated, windows

RATE_HZ = 1000.0
ROWS = 5  # of the log to one of what is diagnosed
SKIPPED = 20  # first samples of the test, which are not scored
WINDOW = 500
LEAST = 2000
SOURCE = "forgi86/sysid-neural-continuous, paper"
ABOVE = "published as above 0.99"


@final
class PositioningDrive(OneDegreeOfFreedom):
    """A carriage that a force drives along a rail: viscous friction is declared."""

    name = "positioning_drive"
    state_names = ("q", "q_dot")
    state_units = ("m", "m/s")
    input_names = ("force",)
    input_units = ("N",)
    position_derivatives = (("q", "q_dot", "world"),)
    declared = ("viscous_friction",)
    residual_ports = {Port.FORCE: ResidualPort(1, 0.5, "m/s2")}
    PARAMETERS = {"force_gain": Parameter(0.05, "1/kg", low=0.0, help="1 / mass")}
    defaults = Defaults(0.005, 25, (0.001, 0.05), 0.1, 1.0, "euler_maruyama")
    feature_names = ("q_dot",)
    feature_units = ("m/s",)

    def features(self, x: Tensor) -> Tensor:
        """The velocity (N, 1)."""
        return x[:, 1:]


@final
class Emps(PublicBenchmark):
    name = "emps"
    title = "electro-mechanical positioning system: a drive with dry friction"
    repository = "forgi86/sysid-neural-continuous"
    files = ("examples/EMPS/data/DATA_EMPS.mat", "examples/EMPS/data/DATA_EMPS_PULSES.mat")
    protocol = (
        "Identified on DATA_EMPS, simulated open loop over the whole of DATA_EMPS_PULSES from its first position "
        "with the measured force; R2 and root mean square of the position, without the first 20 samples."
    )
    metrics = (
        BenchmarkMetric("r2", "", higher_is_better=True, digits=4),
        BenchmarkMetric("rmse", "mm", digits=2),
    )
    published = (
        *(
            PublishedRow(f"neural state space, {how}", {"r2": 0.99}, f"{SOURCE}, section on EMPS", ABOVE)
            for how in ("truncated simulation error", "soft-constrained integration")
        ),
        PublishedRow("linear models", {"r2": 0.5}, f"{SOURCE}, of Janot, Gautier and Brunot (2019)"),
    )
    minutes = 6

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        (t, q, force), (t_test, q_test, force_test) = (_read(path) for path in paths)

        log = filtered_log(t, q, force, step=ROWS / RATE_HZ)
        first = work.stage("diagnosis", lambda: diagnosed([log], system=PositioningDrive, say=work.say))

        def drive(values: Mapping[str, Any]) -> System:
            return machine(PositioningDrive, first["effects"], {**first["values"], **values})

        def fitted() -> dict[str, Any]:
            x = np.stack((q, _filtered(q)[1]), 1)
            data = windows([x], [force[:, None]], dt=1 / RATE_HZ, length=WINDOW)
            how: dict[str, Any] = {"weights": np.array([1e4, 0.0]), "free": (0, 1), "iterations": 8}
            return {
                "values": output_error(
                    drive({}), data, stage="fitting to rollouts", say=work.say, **how
                ).values
            }

        def simulate(values: Mapping[str, Any]) -> Array:
            start = np.array([[q_test[0], 0.0]])
            return simulated(drive(values), start, force_test[None, :-1, None], dt=1 / RATE_HZ)[0, :, 0]

        values = work.stage("output_error", fitted)["values"]
        rows = {}
        for name, own in (("diagnosis", first["values"]), ("output error", values)):
            path = kept_array(work, name.replace(" ", "_"), partial(simulate, own))
            error, spread = (path - q_test)[SKIPPED:], (q_test - q_test.mean())[SKIPPED:]
            r2 = 1.0 - float((error**2).sum()) / float((spread**2).sum())
            rows[f"ours, {name}"] = {"r2": r2, "rmse": 1e3 * rms(error)}
        return BenchmarkOutcome(
            rows,
            first["added"],
            {**first["parameters"], "mass": {"value": 1.0 / values["force_gain"], "unit": "kg"}},
            words_of(first["added"], "the drive with viscous friction alone"),
            [Trace("test run, open loop", "position [m]", t_test, q_test, path)],
            {"output_error": values},
        )


def _read(path: Path) -> tuple[Array, Array, Array]:
    held = matrices(path, ("t", "qm", "vir", "gtau"), what="EMPS")
    t, q, force = held["t"], held["qm"], held["vir"] * held["gtau"][0]
    if not len(t) == len(q) == len(force):
        raise DataError(
            f"{path}: t, qm and vir have {len(t)}, {len(q)} and {len(force)} rows. Fetch it again."
        )
    long_enough(len(t), LEAST, path)
    return t, q, force


def _filtered(q: Array) -> tuple[Array, Array]:
    """Positions at 1 kHz behind a zero-phase low-pass at 100 Hz, and their derivative."""
    from scipy.signal import butter, filtfilt

    b, a = butter(4, 100.0 / (0.5 * RATE_HZ))
    smooth = filtfilt(b, a, q)
    return smooth, np.gradient(smooth, 1 / RATE_HZ)


def filtered_log(t: Array, q: Array, force: Array, *, step: float) -> RawRun:
    """A run at 1 kHz on longer steps: filtered and differentiated as its authors do, with the mean force of each."""
    smooth, speed = _filtered(q)
    width = round(step * RATE_HZ)
    rows = np.arange(50, len(t) - 50, width)
    mean = np.array([force[k : k + width].mean() for k in rows])
    return RawRun("emps", t[rows], np.stack((smooth[rows], speed[rows]), 1), mean[:, None])
