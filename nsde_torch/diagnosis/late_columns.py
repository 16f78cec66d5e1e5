"""Columns of a log that belong to another time and that no kinematics show: a gyro's, a camera's, an input's.

    L(k) = log likelihood of the declared physics in the log with one stream moved back by k rows

A stream is a position with its rate, any other state, an input, or all inputs. At the parameters and noise levels of
the log as it is, L rises as rows are moved to where they belong; what the declared physics lacks does not make it rise,
as a row is a long time where sensors are good (a column that is on time loses hundreds of nats by one). Where it rises,
it has to do so surely beside the effect of the catalogue that explains most of the log as it is, too: a motor that lags
is no late sensor, and a lag explains nothing more once sensors are moved. A state may be behind a filter of first order
instead (`_behind_a_filter`). Inputs are moved to earlier times of the log alone: those that act late have effects. The
optimum of a parabola through three moves says by what part of a row a state is late beyond whole ones.

What is found is taken out before the search. Effects that mend what a late gyro does to a robot on two wheels, five of
them, were looked for in vain for eight minutes (a boat's in tests/diagnosis/test_late_columns.py).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.data.kinematics import pairs_of
from nsde_torch.data.system_info import channel_columns, common_name
from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.joint_selection import FittedPhysics, JointSearch, fitted_at, sure_nats
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.errors import NsdeError
from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.levels import Levels
from nsde_torch.recording.chain import Recorded
from nsde_torch.recording.fault import NATS, Detected, Fault
from nsde_torch.recording.faults import SensorDelay, SensorLag
from nsde_torch.sysid.rough import beginnings
from nsde_torch.systems import System

_LONGEST_S = 0.2  # that a sensor is late at the usual pace [s]
_ROWS = 2500  # from the beginnings of runs that are looked at: 0.03 s for a move of a machine of two states
_NATS = 20.0  # by which a late column has to be likelier than any effect, as nothing else shows it
_PASSES = 2  # until the states that a filter is linearised about have settled
_PAYS = 0.1  # share of what a late column brings, which a channel may lose
_WHOLE = 0.25  # rows that a state may be off by: moves by parts of a row mix the noise of several
_Z90 = 1.645
_FILTER_NATS = 10.0  # by which a filter has to explain more than a delay
_WAVES = 2000  # of an integral over frequencies


@dataclass(frozen=True)
class _Stream:
    """Columns that come from one sensor, or one command."""

    channels: tuple[str, ...]  # states, common names of several, or inputs
    input: bool

    @property
    def named(self) -> str:
        return " and ".join(self.channels) + (" are" if len(self.channels) > 1 else " is")


def late_columns(search: Search, read: Log) -> list[Detected]:
    """Streams that are late against all else, and that nothing else explains; `search` is one in the log's runs.

    Raises:
        DataError: no stretch is long enough for a likelihood.
    """
    clock, runs = read.recorded.clock, read.runs
    if any(run.band for run in runs):  # smoothed states look ahead, and seem to come before what acts on them
        return []
    seconds = _ROWS * runs[0].dt * clock / runs[0].pace
    some: Sequence[Run] = beginnings(runs, clock, seconds=seconds, fewest=100)
    streams = list(_streams(read.system, inputs=not read.recorded.inputs_restored))
    physics, found = fitted_system(search.quick(read.system)), list[Detected]()
    while streams:
        late = _latest(search, physics, some, clock, streams)
        if late is None:
            break
        stream, one = late
        streams.remove(stream)
        found.append(one)
        undone = Recorded(tuple(some), 1.0, (one,))
        some = [undone.like(run, read.system) for run in some]
    return found


def _streams(system: System, *, inputs: bool) -> Iterator[_Stream]:
    pairs = [(common_name(p), common_name(v)) for p, v in pairs_of(system).values()]
    paired = {name for p, v in pairs_of(system).values() for name in (*p, *v)}
    states = [*pairs, *((n,) for n in system.state_names if n not in paired)]
    if len(states) > 1:  # else it is an input that acts late
        yield from (_Stream(channels, False) for channels in states)
    if inputs and system.nu:
        if system.nu > 1:
            yield _Stream(tuple(system.input_names), True)
        yield from (_Stream((name,), True) for name in system.input_names)


def _latest(
    search: Search, system: System, runs: Sequence[Run], clock: float, streams: Sequence[_Stream]
) -> tuple[_Stream, Detected] | None:
    """The stream that is most surely late, and by how much; None where none is."""
    step = runs[0].dt
    most = int(
        min(_LONGEST_S * runs[0].pace / step, 0.1 * min(b - a for run in runs for a, b in run.segments))
    )
    if most < 1:
        return None
    as_logged = [replace(run, segments=tuple((a, b - most) for a, b in run.segments)) for run in runs]

    def without(fault: Fault, stream: _Stream, rows: float) -> list[Run]:
        values = dict.fromkeys(stream.channels, rows * step)
        # of every row, as logged: densities of other rows cannot be compared
        return [
            replace(fault.undo(run, system, values), segments=own.segments, apart=run.apart)
            for run, own in zip(runs, as_logged, strict=True)
        ]

    def fitted(some: Sequence[Run], physics: System) -> FittedPhysics:
        return fitted_at(LogLikelihood(physics, some, clock, run_in=True), physics, None)

    here = fitted(as_logged, system)
    at_rest = _blocks(here.system, as_logged, here.at.levels, clock)
    best, rises = None, sure_nats(search, 0.0)
    for stream in streams:

        def blocks(rows: float, stream: _Stream = stream) -> Array:
            try:
                return _blocks(here.system, without(SensorDelay(), stream, rows), here.at.levels, clock)
            except (NsdeError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
                return np.full(len(at_rest), -inf)

        rows, there = 1, blocks(1.0)
        while rows < most and (further := blocks(rows + 1.0)).sum() > there.sum():
            rows, there = rows + 1, further
        risen = there - at_rest
        if risen.sum() > max(rises, sure_nats(search, sum_error(risen))):
            best, rises = (stream, rows), float(risen.sum())
    if best is None:
        return None
    stream, rows = best
    alone = JointSearch(search, here.at.of, here.system)
    logged = alone.with_one_more(alone.declared) or alone.declared
    late = fitted(without(SensorDelay(), stream, rows), logged.system)
    difference = late.at.blocks - logged.at.blocks
    nats = float(difference.sum())
    if not nats > max(_NATS, sure_nats(search, sum_error(difference))):
        return None
    own, behind = set[str](), None
    if not stream.input:
        own = {system.state_names[k] for c in stream.channels for k in channel_columns(system, c)}
        behind = _behind_a_filter(
            search, late, own, rows, lambda k, physics: fitted(without(SensorLag(), stream, k), physics)
        )
    # where a channel pays for another it is no sensor's time; a little it may, as channels are given those before them:
    # of a car whose sideways speed came 40 ms late that was likelier by 250 nats, and its turn given this less by 18.
    # A column behind a filter may pay itself, as a delay is not what it has (a motor's current behind 4 ms)
    paid = late.at.by_channel < logged.at.by_channel - max(NATS, _PAYS * nats)
    if any(
        lost and (behind is None or name not in own)
        for lost, name in zip(paid, late.at.of.channels, strict=True)
    ):
        return None
    if behind is not None:  # what the physics lacks beside biases it
        seconds, name, how = behind * step, SensorLag.name, "late behind a filter of first order"
        interval: tuple[float | None, float | None] = (None, None)
    else:
        of = _off(late, lambda k: without(SensorDelay(), stream, rows + k), clock)
        if of is None:
            return None
        off, error = of
        time = rows if stream.input or abs(off) < max(_WHOLE, _Z90 * error) else rows + off
        half = max(_Z90 * error, abs(rows + off - time))
        seconds, name, how = time * step, SensorDelay.name, "later than all else"
        interval = (seconds - half * step, seconds + half * step)
    beside = sorted(alone.added(logged.system))
    words = (
        f"{stream.named} logged {_spoken(seconds)} {how}: the declared physics is likelier by {rises:.0f} nats "
        "where what comes late is moved back"
        + (f", and by {nats:.0f} beside {beside[0]}." if beside else ".")
    )
    return stream, Detected(name, dict.fromkeys(stream.channels, (seconds, *interval, "s")), None, words)


def _spoken(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def _behind_a_filter(
    search: Search,
    late: FittedPhysics,
    own: set[str],
    rows: int,
    fitted: Callable[[float, System], FittedPhysics],
) -> float | None:
    """Rows that a filter of first order takes, where that explains surely more than a delay.

    `late` is the fit where its `own` states are moved by so many `rows`, `fitted` that where a filter of so many is
    undone. Of densities of what was logged, x' = x + T D x for the slope D of a spline:

        log p(x) = log p(x') + N / 2 pi  integral of log |1 + i T s(w)|,    s(w) = 3 sin w / (2 + cos w)

    Noise that came after the filter is louder once it is undone, and speaks for a delay. So other channels may say it
    alone: an airspeed behind a tube of 0.15 s is 119 nats more itself as a delay, and 51 less for the rest of a glider.
    How long it takes is found beside the effect that explains most of the log with the filter undone.
    """
    others = [k for k, name in enumerate(late.at.of.channels) if name not in own]
    count = int(late.at.of.space.chunks.counted.sum()) * (len(late.at.of.channels) - len(others))
    w = (np.arange(_WAVES) + 0.5) * np.pi / _WAVES
    slope = 3.0 * np.sin(w) / (2.0 + np.cos(w))

    def score(time: float, physics: System) -> tuple[float, float]:
        there = fitted(time, physics)
        louder = 0.5 * count * float(np.log1p(np.square(time * slope)).mean())
        return there.best.likelihood + louder, float(there.at.by_channel[others].sum())

    def best(physics: System, about: float) -> float:
        found = minimize_scalar(
            lambda time: -score(time, physics)[0],
            bounds=(0.5 * about, 2.0 * about),
            method="bounded",
            options={"maxiter": 8},
        )
        return float(found.x)

    try:
        time = best(late.system, rows)
        whole, rest = score(time, late.system)
        surely = whole > late.best.likelihood + _FILTER_NATS
        gained = rest - float(late.at.by_channel[others].sum())
        lost = late.best.likelihood - (whole - gained)  # by itself
        surely |= bool(others) and gained > max(_FILTER_NATS, _PAYS * lost)
        if not surely:
            return None
        there = fitted(time, late.system)
        undone = JointSearch(search, there.at.of, there.system)
        more = undone.with_one_more(undone.declared)
        return time if more is None else best(more.system, time)
    except (NsdeError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
        return None


@torch.no_grad()
def _blocks(system: System, runs: Sequence[Run], levels: Levels, clock: float) -> Array:
    """Log likelihood of each block of time (B,) at the values of a system and noise levels [nats]."""
    problem = LogLikelihood(system, runs, clock, run_in=True)
    _, about = problem.first(problem.vector.inside(problem.vector.start))
    _, at = problem.settled(levels, about, problem.filtered(levels, about), _PASSES)
    chunks = problem.space.chunks
    return chunks.blocks(torch.stack([at.rows[a:b].sum(0) for a, b in chunks.parts]))


def _off(
    late: FittedPhysics, moved: Callable[[float], Sequence[Run]], clock: float
) -> tuple[float, float] | None:
    """Rows beyond those that a stream was moved by, and their standard error; None where L has no maximum near."""
    before, here, after = (
        float(_blocks(late.system, moved(k), late.at.levels, clock).sum()) for k in (-1.0, 0.0, 1.0)
    )
    bend = 2.0 * here - before - after
    if not bend > 0:
        return None
    return 0.5 * (after - before) / bend, (late.best.inflation / bend) ** 0.5
