"""Streams whose clocks are offset against each other by another time in each run.

Each stream of a log (motion capture, gyroscope, motor commands) has a clock of its own, and is set to the others anew
in each run. An offset is estimated for each run, with its standard error, and held against one that all runs share,

    Q = sum_r ((d_r - d) / s_r)^2,        d = sum_r (d_r / s_r^2) / sum_r s_r^-2,

which is chi-square with one degree of freedom less than there are runs. Where it is not by chance, the offset of each
run is taken out, drawn towards the mean by how unsure it is (empirical Bayes):

    d + t^2 / (t^2 + s_r^2) (d_r - d),     t^2 the variance between runs (Paule and Mandel 1982).

Kinematics show such offsets between a position and its rate, an attitude and body rates. An offset that all runs share
is left to what looks for late sensors. Those of inputs are not looked for: in a closed loop, what answers what hides
time (measured with `benchmarks/bench_streams.py`: a regression on the declared physics says -8 to 8 ms +- 2 for flights
whose commands are on time).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc, ndtri, stdtr

from nsde_torch.arrays import Array
from nsde_torch.data.findings import Finding
from nsde_torch.data.kinematics import Uncertain
from nsde_torch.data.run import DataSet
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.recording.latency import latencies, on_time

POLICIES = ("undo", "keep")
CHANCE = 1e-4
"""Chance of telling offsets of runs that share one."""
LEAST_STEPS = 0.1
"""Spread between runs below which offsets are of no consequence [steps]."""
FEWEST = 2
"""Runs that can be compared."""
_LARGEST_S = 0.25  # standard error of an offset that says nothing


@dataclass(frozen=True)
class Offsets:
    """Offsets of one stream against another that differ between runs."""

    channel: str  # what is moved: the common name of states
    other: str  # what it is late against
    offsets: Mapping[str, Uncertain]  # as measured, of each run that can show it [s of the log]
    taken: Mapping[str, float]  # what is taken out, by name of the run [s of the log]
    p: float  # chance of such differences between runs that share one offset

    def finding(self) -> Finding:
        """What the data summary says."""
        errors = {run: 1e3 * o.error for run, o in self.offsets.items()}
        each = [f"{run} {1e3 * d:+.3g} +- {errors[run]:.2g} ms" for run, d in self.taken.items()]
        shown = ", ".join(each[:8]) + (f", ... ({len(each)} runs)" if len(each) > 8 else "")
        text = (
            f"{self.channel} is late against {self.other} by another time in each run, by the kinematics ({shown}; "
            "plus is late, minus early). `data.stream_offsets=keep` leaves them as they are"
        )
        values = {f"{run}_s": d for run, d in self.taken.items()}
        return Finding("stream_offset", "", len(self.taken), text, "taken out", values)


def differing(channel: str, other: str, offsets: Mapping[str, Uncertain], *, step: float) -> Offsets | None:
    """Offsets that differ between runs by more than chance, at a `step` [s]; None where one offset would do.

    By run: how late a channel is against another [s of the log]; negative where it is early.
    """
    offsets = {r: o for r, o in offsets.items() if np.isfinite(o.value) and 0 < o.error < _LARGEST_S}
    if len(offsets) < FEWEST:
        return None
    d, s = np.array([(o.value, o.error) for o in offsets.values()]).T
    weight = 1.0 / np.square(s)
    mean = float((weight * d).sum() / weight.sum())
    # errors of few degrees of freedom: the normal deviate that is as rare
    z = [-ndtri(stdtr(o.degrees, -abs(o.value - mean) / o.error)) for o in offsets.values()]
    p = float(chdtrc(len(offsets) - 1, float(np.square(z).sum())))
    between = _between(d, s)
    if p > CHANCE or between**0.5 < LEAST_STEPS * step:
        return None
    weight = 1.0 / (between + np.square(s))
    mean = float((weight * d).sum() / weight.sum())
    drawn = mean + between * weight * (d - mean)
    return Offsets(channel, other, offsets, dict(zip(offsets, drawn.tolist(), strict=True)), p)


def _between(d: Array, s: Array) -> float:
    """Variance between runs with which estimates scatter about their mean by as much as they should."""

    def excess(variance: float) -> float:
        weight = 1.0 / (variance + np.square(s))
        return float((weight * np.square(d - (weight * d).sum() / weight.sum())).sum()) - (len(d) - 1)

    most = float(np.square(d - d.mean()).sum()) + 1e-12
    return float(brentq(excess, 0.0, most)) if excess(0.0) > 0 else 0.0


def on_one_clock(data: DataSet, system: SystemInfo, *, policy: str = "undo") -> DataSet:
    """A data set whose streams are on one clock in every run; the data set itself where they are.

    Returns:
        The data set, with a finding `stream_offset` in its summary for each stream that was moved.

    Raises:
        ConfigError: an unknown policy.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`stream_offsets` must be one of {', '.join(POLICIES)}; got {policy!r}.")
    done = any(finding.kind == "stream_offset" for finding in data.summary.findings)
    if policy == "keep" or done or len(data.runs) < FEWEST:
        return data
    runs, step = list(data.runs), data.runs[0].dt
    seen: dict[tuple[str, str], dict[str, Uncertain]] = {}
    for run in runs:
        for one in latencies(system, [run], clock=data.clock_scale):
            offset = Uncertain(-one.seconds, one.error, one.degrees)
            seen.setdefault((one.other, one.channel), {})[run.name] = offset
    found = [o for pair, offsets in seen.items() if (o := differing(*pair, offsets, step=step)) is not None]
    if not found:
        return data
    for these in found:
        mean = float(np.mean(list(these.taken.values())))  # of runs that cannot show their offset
        runs = [on_time(run, system, {these.channel: these.taken.get(run.name, mean)}) for run in runs]
    moved = {f"{channel}_s" for these in found for channel in (these.channel, these.other)}
    findings = [f for f in data.summary.findings if not (f.kind == "late_sensor" and set(f.values) <= moved)]
    return data.changed(runs, [*findings, *(these.finding() for these in found)])
