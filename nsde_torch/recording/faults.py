"""The faults of a recording chain, by name. A new one is a class here, and its object in the list of `FAULTS`.

Each says what it is called and how it is simulated; how a log shows it, and how it is taken out, is in the file that it
imports. Numpy and what needs it is imported on first use (see `fault`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass, replace
from math import ceil, isfinite, pi
from typing import TYPE_CHECKING, Any, ClassVar, final

from nsde_torch.data.system_info import SystemInfo, channel_columns, rate_columns
from nsde_torch.errors import ConfigError
from nsde_torch.lazy import LazyModule
from nsde_torch.options import documented, key
from nsde_torch.recording.fault import Detected, Fault, LoggedRuns

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import Run
    from nsde_torch.recording import clock_and_biases, latency, noise, smoothing
else:
    np = LazyModule("numpy")
    clock_and_biases, latency, noise, smoothing = (
        LazyModule(f"nsde_torch.recording.{name}")
        for name in ("clock_and_biases", "latency", "noise", "smoothing")
    )


@final
class ClockScale(Fault):
    """A wrong clock: rows are `scale` times as far apart as their times say."""

    name = "clock_scale"
    rank = 10
    stage = "clock"
    option = key(1.0, "physical seconds for each logged second", low=0.5, high=2)

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        """The plant is sampled at steps that are `value` times as long (`Recording.clock`); nothing is left to do."""

    def detect(self, log: LoggedRuns) -> Detected | None:
        return clock_and_biases.wrong_clock(self, log)


class _Latency(Fault):
    """States that are logged late; `latency` finds it and takes it out."""

    stage = "lateness"
    annotation = Mapping[str, float]
    mixes_times = True
    filtered: ClassVar[bool]

    def check(self, value: Any, system: SystemInfo) -> None:
        for channel, seconds in value.items():
            channel_columns(system, channel)
            if not (isfinite(seconds) and seconds >= 0):
                raise ConfigError(f"`{self.name}.{channel}` must be a time of 0 s or more; got {seconds!r}.")

    def detect(self, log: LoggedRuns) -> Detected | None:
        late = [one for one in log.late[1] if one.filtered == self.filtered]
        return latency.detected(late) if late else None


@final
class SensorLag(_Latency):
    """A filtered sensor: T x_log' + x_log = x for some of the states."""

    name = "sensor_lag"
    truth = "sensor_lag_s"
    rank = 20
    option = key(
        {}, "time constant of a filter that a state goes through, recording.sensor_lag.STATE=0.02", unit="s"
    )
    remedy = key({}, "time constants of filters that states went through, {STATE: 0.02}, to undo", unit="s")
    filtered = True

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        run.x = latency.changed(run.x, system, value, lambda x, lag: latency.filtered(x, lag / dt))

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        return latency.on_time(run, system, {}, values)


@final
class SensorDelay(_Latency):
    """A late sensor: x_log(t) = x(t - d) for some of the states."""

    name = "sensor_delay"
    truth = "sensor_delay_s"
    rank = 30
    option = key(
        {},
        "by how much a state is logged late, recording.sensor_delay.STATE=0.02 (p for p_x p_y p_z)",
        unit="s",
    )
    remedy = key(
        {},
        "by how much states or inputs are logged late, {STATE: 0.01}, or {p: 0.01} for p_x p_y p_z, to take out",
        unit="s",
    )
    filtered = False

    def rows_before(self, value: Any, dt: float) -> int:
        return ceil(max(value.values(), default=0.0) / dt - 1e-9)

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        run.x = latency.changed(run.x, system, value, lambda x, delay: latency.moved(x, -delay / dt))

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        return latency.on_time(run, system, values)


@final
class LateStates(Fault):
    """States late, all of them: x_log(t) = x(t - d), so that the log shows inputs a time d before they act.

    No kinematics show it; in physics it is what an effect `input_delay` is too.
    """

    name = "input_delay"
    rank = 40
    option = key(
        0.0, "time by which states are logged late, so that inputs seem to come early", unit="s", low=0
    )
    mixes_times = True

    def rows_before(self, value: Any, dt: float) -> int:
        return round(value / dt)

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        rows = round(value / dt)
        if rows:
            run.x = np.concatenate([np.repeat(run.x[:1], rows, axis=0), run.x[:-rows]])

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        rows = round(value / dt)
        return {"input_delay_s": rows * dt} if rows else {}


class _OfStates(Fault):
    """A fault of single states, with a number for each; a reader takes it out before it looks at anything."""

    annotation = Mapping[str, float]
    remedy_first = True

    def check(self, value: Any, system: SystemInfo) -> None:
        turned = () if system.quaternion is None else system.state_names[system.quaternion]
        free = [n for n in system.state_names if n not in turned]
        unknown = sorted(set(value) - set(free))
        if unknown:
            raise ConfigError(
                f"`{self.name}` takes {', '.join(free)} of system {system.name!r}; got {', '.join(unknown)}."
                + (" An attitude is turned with `frame_misalignment`." if turned else "")
            )

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        run.x = clock_and_biases.misread(run.x, system, self.name, value)

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        run.x = clock_and_biases.without(run, system, self.name, values)


@final
class SensorBias(_OfStates):
    """Biased sensors: x_log = x + b."""

    name = "sensor_bias"
    rank = 50
    stage = "biases"
    option = key({}, "what is added to a state, recording.sensor_bias.STATE=0.1")
    remedy = key(
        {},
        "what sensors read too much, {STATE: 0.01} in its unit, to take out; {RUN: {STATE: 0.01}} in one run",
    )

    def detect(self, log: LoggedRuns) -> Detected | None:
        return clock_and_biases.found_biases(self, log)

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        return replace(run, x=clock_and_biases.without(run, system, self.name, values))


@final
class SensorScale(_OfStates):
    """Sensors that read too much by a factor: x_log = k x. The reader takes that of a single rate out."""

    name = "sensor_scale"
    rank = 48
    stage = "clock"
    option = key({}, "how many times too much a state is read, recording.sensor_scale.STATE=1.05")
    remedy = key({}, "how many times too much sensors read, {STATE: 1.05}, to take out")

    def detect(self, log: LoggedRuns) -> Detected | None:
        return clock_and_biases.scaled_rate(self, log)


@final
class DerivedRate(Fault):
    """Rates that were made of positions: v_log = W q_log, and no sensor's.

    W is the difference from the row before, or the slope of a parabola through some rows (Savitzky and Golay,
    Analytical Chemistry 36 (1964); through three it is the central difference).
    """

    name = "derived_rate"
    truth = "derived_rate_rows"
    rank = 55
    option = key(
        0,
        "rows of the position that its rate is made of: 2 is the difference from the row before, an odd number the "
        "slope of a parabola",
        low=0,
        high=101,
    )
    annotation = int
    mixes_times = True

    def check(self, value: Any, system: SystemInfo) -> None:
        if value and value != 2 and (not value % 2 or value < 3):
            raise ConfigError(f"`{self.name}` must be 2 or an odd number of rows from 3 on; got {value}.")
        if value and (system.quaternion is not None or not system.position_derivatives):
            raise ConfigError(
                f"`{self.name}` is for machines with positions and no quaternion; {system.name!r} is none."
            )

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        from scipy.signal import savgol_filter

        run.x, names = run.x.copy(), list(system.state_names)
        for position, rate, _ in system.position_derivatives:
            q = run.x[:, names.index(position)]
            v = np.diff(q, prepend=q[0]) / dt if value == 2 else savgol_filter(q, value, 2, deriv=1, delta=dt)
            run.x[:, names.index(rate)] = v

    def detect(self, log: LoggedRuns) -> Detected | None:
        """The reader has found it, and the rates are inferred: nothing is left to undo."""
        rates = sorted({name for run in log.runs for name in run.inferred})
        if not rates:
            return None
        made = [f.values for f in log.data.summary.findings if f.kind == self.name]
        how = [f"{v['state']} is {v['how']} of {v['position']}" for v in made if v["state"] in rates]
        how += [f"{name} is not in the log" for name in rates if name not in {v["state"] for v in made}]
        words = (
            f"No sensor measured {' and '.join(rates)} ({', '.join(how)}): inferred from the positions alone."
        )
        why = "known from the reading of the log, and taken into account"
        return Detected(self.name, {}, None, words, short=True, reason=why)


@final
class InputSmoothing(Fault):
    """Smoothed inputs: u_log(t) = mean of u over [t - w / 2, t + w / 2], or over the last w."""

    name = "input_smoothing"
    past = "width_of_the_past"
    rank = 60
    option = key(0.0, "width of the centred moving average of the inputs", unit="s", low=0)
    mixes_times = True

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        run.u = smoothing.averaged(run.u, round(value / dt))

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        steps = round(value / dt)
        return {"input_smoothing_s": steps * dt} if steps else {}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """Rows that were lost at a regular distance leave such nulls too, in the spectrum of held inputs.

        So the declared physics has to fit better with inputs that are restored. It says, too, whether a mean is one
        about each row or of the past, of which nulls say nothing: of a slider that lacked nothing, behind a mean of the
        last twelve rows, the current was 47 ms late, and four effects were rejected
        (tests/recording/test_smoothing.py::test_physics_says_whether_a_mean_is_of_the_past).
        """
        inputs = len(log.system.input_names)
        width = smoothing.smoothing_width(log.runs, inputs) if inputs else 0.0
        if not width > 0:
            return None
        half = 0.5 * log.runs[0].dt
        between, last = (width, width - half, width + half, "s"), f"the last {width:.3g} s"
        words = "The log holds a moving average over {} of the inputs that acted."
        tried = [
            Detected(self.name, {name: between}, None, words.format(over))
            for name, over in (("width", f"{width:.3g} s"), (self.past, last))
        ]
        misfits = [log.misfit_with(self, found.plain) for found in tried]
        best = int(np.argmin(misfits))
        return tried[best] if misfits[best] < log.misfit_with(self, {}) else None

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        for name, width in values.items():
            run = smoothing.restored(run, len(system.input_names), width, past=name == self.past)
        return run


@final
class TurnedFrame(Fault):
    """A turned frame: q_log = q (1, r / 2), omega_log = R(r)^T omega, for the rotation r from body to the log's frame.

    No kinematics show it: attitude and rates are turned alike. In a log it is an effect, which a diagnosis looks for as
    it does for the others.
    """

    name = "frame_misalignment"
    truth = "frame_misalignment_deg"
    rank = 70
    option = key(
        (0.0, 0.0, 0.0), "turn of the log's body frame against the machine's about x, y, z", unit="deg"
    )
    annotation = Sequence[float]

    def check(self, value: Any, system: SystemInfo) -> None:
        if len(value) != 3:
            raise ConfigError(f"`frame_misalignment` takes three angles [deg]; got {list(value)}.")
        if system.quaternion is None and any(value):
            raise ConfigError(
                f"`frame_misalignment` needs an attitude, which system {system.name!r} has not. Use `sensor_bias`."
            )

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        from nsde_torch.data.quaternion import conjugate, multiply, rotate

        half = 0.5 * np.radians(value)
        angle, rates = float(np.linalg.norm(half)), rate_columns(system)
        turn = np.append(np.cos(angle), np.sinc(angle / pi) * half)
        run.x = run.x.copy()
        run.x[:, system.quaternion] = multiply(run.x[:, system.quaternion], turn)
        if rates is not None:
            run.x[:, rates] = rotate(conjugate(turn), run.x[:, rates])


@final
class Dropout(Fault):
    """Dropped rows; the first row and the last stay. A reader finds the gaps that they leave (`times`)."""

    name = "dropout"
    rank = 80
    option = key(0.0, "share of the rows that is missing", low=0, high=0.5)

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        keep = rng.random(len(run.t)) >= value
        keep[[0, -1]] = True
        run.rows(keep)


@final
class RotorSpeed(Fault):
    """Inputs that are logged as speeds of rotors, u_log = n_max sqrt(u), where shares of thrust are due.

    What takes it out is (u_log / n_max)^2, without the glitches of the line (`noise`).
    """

    name = "rotor_speed"
    truth = "rotor_speed_of_full_thrust"
    rank = 90
    option = key(0.0, "log speeds of rotors for commands: the speed of full thrust, 0 for commands", low=0)
    remedy = key(
        {}, "inputs are speeds of rotors: that of full thrust, {u_1: 22000}, or {u: 22000} for u_1 ... u_4"
    )
    remedy_first = True

    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        run.u = float(value) * np.sqrt(np.clip(run.u, 0.0, None))

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        """Values by name of an input, or by the common name of several."""
        from nsde_torch.data.raw import Finding

        names, u = system.input_names, run.u.copy()
        for channel, most in values.items():
            columns = [k for k, name in enumerate(names) if name == channel or name.startswith(channel + "_")]
            if not columns:
                raise ConfigError(
                    f"`rotor_speed`: {channel!r} is no input of system {system.name!r}; inputs: {', '.join(names)}."
                )
            number = isinstance(most, int | float) and not isinstance(most, bool)
            if not (number and isfinite(most) and most > 0):
                raise ConfigError(f"`rotor_speed.{channel}` must be a speed above 0; got {most!r}.")
            for k in columns:
                u[:, k], rows = noise.shares(run.u[:, k], float(most), name=names[k], where=run.label)
                if rows:
                    text = f"{len(rows)} rows of rotor speed {names[k]!r} that no rotor can have had"
                    at = {"column": names[k], "rows": rows}
                    run.notes.append(Finding("input_glitch", run.name, len(rows), text, "interpolated", at))
        run.u = u


_ALL: tuple[Fault, ...] = (
    InputSmoothing(), LateStates(), ClockScale(), SensorBias(), SensorScale(), DerivedRate(), SensorDelay(),
    SensorLag(), TurnedFrame(), RotorSpeed(), Dropout(),
)  # fmt: skip
FAULTS: dict[str, Fault] = {fault.name: fault for fault in _ALL}
"""Faults by name, as options list them."""


def in_order() -> list[Fault]:
    """The faults as they act, and are undone (`Fault.rank`)."""
    return sorted(FAULTS.values(), key=lambda fault: fault.rank)


def remedies() -> dict[str, Fault]:
    """The faults that a reader can take out on request, by the name of its option."""
    return {name: fault for name, fault in FAULTS.items() if fault.remedy is not None}


def _options(name: str, doc: str, fields: Mapping[str, tuple[Any, Any]]) -> type[Any]:
    made = make_dataclass(name, [(field, *own) for field, own in fields.items()], frozen=True)
    made.__doc__, made.__module__ = doc, __name__
    return documented(made)


def recording_options() -> type[Any]:
    """A dataclass with an option for each fault that there is now."""
    fields = {name: (fault.annotation, fault.option) for name, fault in FAULTS.items()}
    return _options("RecordingOptions", "Faults of a recording chain; the default has none.", fields)


RecordingOptions = recording_options()
"""Sizes of the faults of a simulated recording, by name; the keys `recording.NAME` of `nsde simulate`."""
RemedyOptions = _options(
    "RemedyOptions",
    "What a reader takes out of a log.",
    {name: (dict[str, float], fault.remedy) for name, fault in remedies().items()},
)
"""What a reader takes out, by name of the fault and of the states; the keys `data.NAME` of the commands."""
