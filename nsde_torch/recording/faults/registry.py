"""All faults of a recording chain. A new one is a file beside this and a line here."""

from __future__ import annotations

from nsde_torch.recording.faults.clock_scale import ClockScale
from nsde_torch.recording.faults.derived_rate import DerivedRate
from nsde_torch.recording.faults.dropout import Dropout
from nsde_torch.recording.faults.fault import Fault
from nsde_torch.recording.faults.frame_misalignment import TurnedFrame
from nsde_torch.recording.faults.input_delay import LateStates
from nsde_torch.recording.faults.input_smoothing import InputSmoothing
from nsde_torch.recording.faults.rotor_speed import RotorSpeed
from nsde_torch.recording.faults.sensor_bias import SensorBias
from nsde_torch.recording.faults.sensor_delay import SensorDelay
from nsde_torch.recording.faults.sensor_lag import SensorLag

FAULTS: dict[str, Fault] = {
    fault.name: fault
    for fault in (
        InputSmoothing(),
        LateStates(),
        ClockScale(),
        SensorBias(),
        DerivedRate(),
        SensorDelay(),
        SensorLag(),
        TurnedFrame(),
        RotorSpeed(),
        Dropout(),
    )
}
"""Faults by name, as options list them."""


def in_order() -> list[Fault]:
    """The faults as they act, and are undone (`Fault.rank`)."""
    return sorted(FAULTS.values(), key=lambda fault: fault.rank)


def remedies() -> dict[str, Fault]:
    """The faults that a reader can be told to take out, by the name of its option."""
    return {name: fault for name, fault in FAULTS.items() if fault.remedy is not None}
