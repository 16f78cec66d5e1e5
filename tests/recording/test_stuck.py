"""A column that never changes is refused where its partner moves, and reported where nothing contradicts it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, RawRun
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER
from tests.helpers.flights import flight

Array = NDArray[np.float64]


def swing(noise: float = 0.0) -> tuple[Array, Array]:
    """Times and states of a cart and pole that swing."""
    t = np.arange(600) * 0.02
    x = np.stack((np.sin(t), np.cos(t), 0.3 * np.sin(3 * t), 0.9 * np.cos(3 * t)), 1)
    return t, x + noise * np.random.default_rng(0).normal(size=x.shape)


def read(x: Array, t: Array, *, sound: int = 0) -> DataSet:
    """The states after as many sound runs."""
    good = swing()[1]
    runs = [
        RawRun(f"run_{k}", t.copy(), s.copy(), np.sin(7 * t)[:, None]) for k, s in enumerate([good] * sound)
    ]
    return assemble([*runs, RawRun("last", t, x, np.sin(7 * t)[:, None])], CARTPOLE, kind="test")


@pytest.mark.parametrize(("column", "name", "other"), [(2, "theta", "theta_dot"), (1, "x_dot", "x")])
@pytest.mark.parametrize("sound", [0, 2])
def test_a_column_that_stands_still_while_its_partner_moves_is_refused_by_name(
    column: int, name: str, other: str, sound: int
) -> None:
    t, x = swing(0.01)
    x[:, column] = 0.25
    with pytest.raises(DataError, match=rf"'last': '{name}' never changes \(0.25 .*'{other}' does"):
        read(x, t, sound=sound)


def test_a_pole_that_is_locked_is_reported_with_the_remedy_and_not_refused() -> None:
    t, x = swing()
    x[:, 2], x[:, 3] = 0.0, 0.01 * np.random.default_rng(0).normal(size=len(t))  # the rate is noise
    data = read(x, t)
    (finding,) = (f for f in data.summary.findings if f.kind == "constant_state")
    assert finding.values["states"] == ["theta"]
    assert "record runs in which they move" in finding.message
    moves = read(x, t, sound=1)  # in the other run
    assert all(f.kind != "constant_state" for f in moves.summary.findings)


def test_an_attitude_or_a_gyroscope_that_stands_still_in_a_turning_flight_is_refused() -> None:
    t, x, u = flight(20.0)
    for columns, name in ((slice(6, 10), "the quaternion"), (slice(11, 12), "'w_y'")):
        spoilt = x.copy()
        spoilt[:, columns] = spoilt[0, columns]
        with pytest.raises(DataError, match=f"{name} never changes"):
            assemble([RawRun("a", t.copy(), spoilt, u.copy())], HEXACOPTER, kind="test")
