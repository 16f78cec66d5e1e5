"""Time on the ground is cut out of a flight; a hover that is perfectly still is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Finding, RawRun
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from nsde_torch.recording.standstill import CLEAR
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight

Array = NDArray[np.float64]
STAND = 300  # rows


def log(command: float, *, noise: float = 0.02, rise: int = 0) -> tuple[Array, Array, Array]:
    """A machine that stands still for three seconds on a command, which then rises, and flies for 20 s."""
    t, x, u = flight(20.0)
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.clip(np.arange(len(t)) / 100, 0, 1))
    still = np.tile(x[0], (STAND, 1))
    still[:, 3:6], still[:, 10:13] = 0.0, 0.0
    x = x.copy()
    x[:, 3:6] *= ramp[:, None]  # it starts from rest
    x[:, 10:13] *= ramp[:, None]
    x[:, 2] += ramp
    states = np.concatenate((still, x))
    states[:, 3:6] += noise * np.random.default_rng(0).normal(size=(len(states), 3))
    states[:, 10:13] += noise * np.random.default_rng(1).normal(size=(len(states), 3))
    before = np.full(STAND, command)
    if rise:
        before[-rise:] = np.linspace(command, 0.35, rise)
    inputs = np.concatenate((np.repeat(before[:, None], 6, axis=1), u))
    return 0.01 * np.arange(len(states)), states, inputs


def read(t: Array, x: Array, u: Array) -> tuple[DataSet, list[Finding]]:
    """The data set of one log, and what was found about the ground."""
    data = assemble([RawRun("log", t, x, u)], HEXACOPTER, kind="test", clock="trust")
    return data, [f for f in data.summary.findings if f.kind == "on_ground"]


@pytest.mark.parametrize("rise", [0, 60])
def test_a_machine_that_stands_still_on_low_commands_is_on_the_ground_until_it_moves(rise: int) -> None:
    data, (finding,) = read(*log(0.1, rise=rise))
    assert finding.action == "dropped"
    assert STAND - 5 <= finding.count <= STAND + 45
    assert data.runs[0].t[0] == pytest.approx(3.0, abs=0.45)
    assert "3" in finding.message
    assert "% of the commands of flight" in finding.message


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_hover_that_is_perfectly_still_is_kept(noise: float) -> None:
    data, findings = read(*log(0.4, noise=noise))
    assert findings == []
    assert data.runs[0].segments[0][0] == 0


def test_a_short_drop_of_the_commands_in_flight_is_no_ground() -> None:
    t, x, u = log(0.4)
    u[800:900] *= 0.3  # it dives
    assert read(t, x, u)[1] == []


def test_a_log_that_never_leaves_the_ground_beside_one_that_flies_is_refused_by_name() -> None:
    t, x, u = log(0.1)
    parked = RawRun("parked", t[:STAND].copy(), x[:STAND].copy(), u[:STAND].copy())
    with pytest.raises(
        DataError, match=r"'parked': the machine stands on the ground throughout\. Leave the run out"
    ):
        assemble([RawRun("log", t, x, u), parked], HEXACOPTER, kind="test", clock="trust")


def test_a_machine_without_rotors_may_stand_still_on_nothing() -> None:
    t, x, u = log(0.1)
    boat = replace(HEXACOPTER, name="boat", input_names=tuple(f"thruster_{k}" for k in range(6)))
    data = assemble([RawRun("log", t, x, u)], boat, kind="test", clock="trust")
    assert not [f for f in data.summary.findings if f.kind == "on_ground"]


def test_a_machine_that_bounces_on_the_ground_is_on_it_until_it_is_clear_of_it() -> None:
    t, x, u = log(0.1)
    bounces = np.abs(np.sin(np.linspace(0, 3 * np.pi, 90)))  # three times 12 cm up and down before it climbs
    x[STAND : STAND + 90, 2] = x[0, 2] + 0.12 * bounces
    data, (finding,) = read(t, x, u)
    assert STAND + 88 <= finding.count <= STAND + 130
    low = data.runs[0].x[:, 2] < x[0, 2] + CLEAR
    assert not low[:100].any()


def test_what_flies_low_long_after_it_stood_is_kept() -> None:
    t, x, u = log(0.1, noise=0.0)
    # from a table, and no higher
    x[STAND:, 5] = 0.02 * np.cos(t[STAND:] - 2.0)
    x[STAND:, 2] = x[0, 2] + 0.01 * np.cumsum(x[STAND:, 5])
    _, (finding,) = read(t, x, u)
    assert finding.count <= STAND + 330
