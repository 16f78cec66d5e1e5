"""Settings of the recording chain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from nsde_torch.options import documented, key


@documented
@dataclass(frozen=True)
class RecordingOptions:
    """Faults of a recording chain; the default has none."""

    input_smoothing: float = key(0.0, "width of the centred moving average of the inputs", unit="s", low=0)
    input_delay: float = key(
        0.0, "time by which states are logged late, so that inputs seem to come early", unit="s", low=0
    )
    clock_scale: float = key(1.0, "physical seconds for each logged second", low=0.5, high=2)
    sensor_bias: Mapping[str, float] = key({}, "what is added to a state, recording.sensor_bias.STATE=0.1")
    sensor_delay: Mapping[str, float] = key(
        {},
        "by how much a state is logged late, recording.sensor_delay.STATE=0.02 (p for p_x p_y p_z)",
        unit="s",
    )
    sensor_lag: Mapping[str, float] = key(
        {}, "time constant of a filter that a state goes through, recording.sensor_lag.STATE=0.02", unit="s"
    )
    frame_misalignment: Sequence[float] = key(
        (0.0, 0.0, 0.0), "turn of the log's body frame against the machine's about x, y, z", unit="deg"
    )
    dropout: float = key(0.0, "share of the rows that is missing", low=0, high=0.5)
