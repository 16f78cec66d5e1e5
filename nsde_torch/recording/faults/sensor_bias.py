"""Biased sensors: x_log = x + b.

For a rate that reads b too much, p(t + T) - p(t) - integral of v dt = -b T on average (`nsde_torch.recording.biases`).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any, final

from nsde_torch.errors import ConfigError
from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import Run
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns


@final
class SensorBias(Fault):
    """See the module."""

    name = "sensor_bias"
    rank = 50
    stage = "biases"
    option = key({}, "what is added to a state, recording.sensor_bias.STATE=0.1")
    annotation = Mapping[str, float]
    remedy = key(
        {},
        "what sensors read too much, {STATE: 0.01} in its unit, to take out; {RUN: {STATE: 0.01}} in one run",
    )
    remedy_first = True

    def check(self, value: Any, system: SystemInfo) -> None:
        """See `Fault.check`."""
        turned = () if system.quaternion is None else system.state_names[system.quaternion]
        free = [n for n in system.state_names if n not in turned]
        unknown = sorted(set(value) - set(free))
        if unknown:
            raise ConfigError(
                f"`sensor_bias` takes {', '.join(free)} of system {system.name!r}; got {', '.join(unknown)}."
                + (" An attitude is turned with `frame_misalignment`." if turned else "")
            )

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        run.x = run.x.copy()
        for name, bias in value.items():
            run.x[:, list(system.state_names).index(name)] += bias

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {self.name: {k: v for k, v in value.items() if v}}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`."""
        from scipy.special import stdtrit

        from nsde_torch.recording.biases import rate_biases
        from nsde_torch.recording.log import LEVEL, Detected

        biases, level = rate_biases(log.system, log.runs, log.clock), log.level(self.stage)
        sure = {k: b for k, b in biases.items() if b.p * len(biases) < level and abs(b.value) > b.least}
        if not sure:
            return None
        unit = dict(zip(log.system.state_names, log.system.state_units, strict=True))
        values: dict[str, tuple[float, float | None, float | None, str]] = {}
        for name, bias in sure.items():
            half = float(stdtrit(bias.degrees, 0.5 * (1 + LEVEL))) * bias.error
            values[name] = (bias.value, bias.value - half, bias.value + half, unit[name])
        words = ", ".join(f"{name} by {bias.value:+.3g} {unit[name]}" for name, bias in sure.items())
        return Detected(
            self.name,
            values,
            min(bias.p for bias in sure.values()),
            f"Sensors read too much: {words}; the integral of these rates says so.",
        )

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """See `Fault.undo`."""
        from dataclasses import replace

        return replace(run, x=_less(run.x, system, of_run(values, run.name)))

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        """See `Fault.undo_raw`."""
        run.x = _less(run.x, system, of_run(values, run.name))


def of_run(values: Mapping[str, Any], run: str) -> dict[str, Any]:
    """What sensors read too much in a run: what holds in all, and what `{RUN: {STATE: value}}` says of this one.

    Args:
        values: By state, or by state under the name of a run.
        run: Name of the run.
    """
    out = {k: v for k, v in values.items() if not isinstance(v, Mapping)}
    here = values.get(run)
    for state, value in here.items() if isinstance(here, Mapping) else ():
        out[state] = out.get(state, 0.0) + value
    return out


def _less(x: np.ndarray, system: SystemInfo, values: Mapping[str, float]) -> np.ndarray:
    x = x.copy()
    for name, value in values.items():
        if name not in system.state_names:
            raise ConfigError(
                f"`sensor_bias` names {name!r}, which is no state; states: {', '.join(system.state_names)}."
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise ConfigError(f"`sensor_bias.{name}` must be a finite number; got {value!r}.")
        x[:, list(system.state_names).index(name)] -= value
    return x
