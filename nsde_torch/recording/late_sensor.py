"""Late sensors as findings: those that kinematics show, those that they hint at, and those that move as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scipy.optimize import minimize_scalar

from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.recording.channels import on_time
from nsde_torch.recording.faults.fault import Fault
from nsde_torch.recording.lateness import Late, sensors
from nsde_torch.recording.log import NATS, Detected, LoggedRuns, Misfits, Recorded, Suspect

_LEAST_STEPS = 0.2  # a delay that is of consequence
_SURELY = 20.0  # nats by which a log is likelier with a sensor moved, where nothing else tells of it
_LATEST_S, _Z90 = 0.2, 1.645


def told(name: str, late: Sequence[Late], how: str, *, short: bool = False) -> Detected | None:
    """Channels that are late as one finding; None for none.

    Args:
        name: Name of the fault.
        late: The channels.
        how: What they are against the others, in words.
        short: Whether it is no finding of its own.
    """
    if not late:
        return None
    words = ", ".join(f"{d.channel} is logged {1e3 * d.seconds:.3g} ms {how} {d.other}" for d in late)
    values = {d.channel: (d.seconds, d.low, d.high, "s") for d in late}
    text = f"Channels do not belong to the same time: {words}, as the one is the integral of the other."
    return Detected(name, values, min(d.p for d in late), text, short)


def suspected(fault: Fault, log: LoggedRuns, *, filtered: bool, how: str) -> list[Suspect]:
    """Channels that are late by less than what is sure: half a step may be how a simulator steps.

    Args:
        fault: Delays, or filters.
        log: The log.
        filtered: Whether it is filters.
        how: See `told`.
    """
    out = []
    for order, d in enumerate(log.late):
        matters = d.p * len(log.late) < log.level(fault.stage) and d.low > _LEAST_STEPS * log.runs[0].dt
        if matters and d.filtered == filtered and d not in log.surely:
            found = told(fault.name, [d], how, short=True)
            assert found is not None
            out.append(Suspect(fault, order, found, {d.channel: d.early.seconds}))
    return out


def late_sensor(
    found: Recorded, system: SystemInfo, misfits: Misfits, *, rows: int, other: float
) -> Recorded | None:
    """What the log is with one sensor moved, position and rate alike, against all else; None where that is no better.

    Kinematics do not show it, and effects that stand for it pay for one channel with another. So it is asked for where
    effects leave structure, has to do better than they, and no channel may pay for it: attitude and rates moved by the
    time that motors lag behind would otherwise stand for them.

    Args:
        found: The recording chain, undone as far as it is known.
        system: The machine.
        misfits: Negative log likelihood per row [nats] of the declared physics in runs, by channel.
        rows: Number of rows.
        other: The misfit of physics with effects, all channels together.
    """
    pairs, step = sensors(system), found.runs[0].dt
    longest = min(_LATEST_S / step, 0.1 * min(b - a for run in found.runs for a, b in run.segments))
    if len(pairs) < 2 or longest < 1.0:  # no sensor is late by as much as a step
        return None
    unmoved = misfits(found.runs)
    other = min(other, float(unmoved.sum()))

    def misfit(runs: Sequence[Run]) -> float:
        return float(misfits(runs).sum())

    best: tuple[float, float, tuple[str, str]] | None = None
    for pair in pairs:

        def of(steps: float, pair: tuple[str, str] = pair) -> float:
            return misfit([on_time(run, system, dict.fromkeys(pair, steps * step)) for run in found.runs])

        at, here = 1.0, of(1.0)
        while 2.0 * at <= longest and (there := of(2.0 * at)) < here:
            at, here = 2.0 * at, there
        if here < other - NATS / rows and (best is None or here < best[0]):
            nearer = minimize_scalar(
                of, bounds=(0.5 * at, min(2.0 * at, longest)), method="bounded", options={"maxiter": 8}
            )
            best = min((here, at, pair), (float(nearer.fun), float(nearer.x), pair))
    if best is None or best[0] > other - _SURELY / rows:
        return None
    here, at, pair = best
    late = dict.fromkeys(pair, at * step)
    runs = tuple(on_time(run, system, late) for run in found.runs)
    if (misfits(runs) > unmoved + NATS / rows).any():
        return None
    bend = (
        misfit([on_time(run, system, late | dict.fromkeys(pair, 1.5 * at * step)) for run in found.runs])
        - here
    )
    half = _Z90 * 0.5 * at * step / max(2.0 * rows * bend, 1e-12) ** 0.5
    if half >= at * step:  # another time would do as well: what it stands for is no delay
        return None
    values = {}
    for channel in pair:
        whole = at * step + found.delays.get(channel, 0.0)
        values[channel] = (whole, whole - half, whole + half, "s")
    told = (
        f"{' and '.join(pair)} are logged {1e3 * at * step:.3g} ms later than all else: the declared physics fits "
        "better so than with any effects."
    )
    return replace(found, runs=runs, faults=(*found.faults, Detected("sensor_delay", values, None, told)))
