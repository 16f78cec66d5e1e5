"""Columns that are logged rows later than all else are named as that, beside whatever else the physics lacks."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import nsde_torch
from nsde_torch.data import RawRun, Run
from nsde_torch.errors import ConfigError
from nsde_torch.recording.faults import SensorDelay
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import assert_interval
from tests.helpers.own_machines import sailed

BOAT, DRAG = "tests.helpers.own_machines:Boat", "force[surge] = c1 surge abs(turn)"


def _turn_late(run: RawRun, rows: int) -> RawRun:
    x = run.x.copy()
    x[rows:, 2] = run.x[:-rows, 2]
    return replace(run, x=x)


def _starboard_late(run: RawRun, rows: int) -> RawRun:
    u = run.u.copy()
    u[rows:, 1] = run.u[:-rows, 1]
    return replace(run, u=u)


@pytest.mark.parametrize(
    ("channel", "late"),
    [
        ("turn", _turn_late),
        pytest.param("starboard", _starboard_late, marks=pytest.mark.slow),
    ],
)
def test_a_column_that_is_a_row_late_is_found_beside_a_drag(
    channel: str, late: Callable[[RawRun, int], RawRun]
) -> None:
    runs = [late(run, 1) for run in sailed(slip=0.3)]
    found = nsde_torch.diagnose(runs, system=BOAT, say=False).content()
    assert found["added"] == ["sensor_delay", DRAG]
    assert_interval(found["parameters"], f"sensor_delay.{channel}", 0.05, width=0.01)
    assert_interval(found["parameters"], f"{DRAG}.c1", -0.3, width=0.01)


def _turn_filtered(run: RawRun, time: float) -> RawRun:
    """The turn through a filter of first order, straight between rows, with the noise of a converter behind it."""
    keep = float(np.exp(-0.05 / time))
    new, old = 1.0 - time / 0.05 * (1.0 - keep), time / 0.05 * (1.0 - keep) - keep
    x = run.x.copy()
    x[:, 2] = lfilter([new, old], [1.0, -keep], run.x[:, 2], zi=run.x[:1, 2] * (keep + old))[0]
    x[:, 2] += 0.01 * np.random.default_rng(len(x)).standard_normal(len(x))
    return replace(run, x=x)


@pytest.mark.slow
def test_a_sensor_behind_a_filter_is_that_and_no_delay() -> None:
    runs = [_turn_filtered(run, 0.15) for run in sailed(slip=0.3)]
    found = nsde_torch.diagnose(runs, system=BOAT, say=False).content()
    assert found["added"][0] == "sensor_lag"
    assert found["parameters"]["sensor_lag.turn"]["value"] == pytest.approx(0.15, rel=0.15)
    assert DRAG in found["added"]


def test_nothing_is_late_where_an_input_acts_late() -> None:
    found = nsde_torch.diagnose(sailed(late=1), system=BOAT, say=False).content()
    assert "sensor_delay" not in found["added"]


def test_an_input_is_moved_by_whole_rows_and_others_stay() -> None:
    system = make_system("cartpole")
    t = 0.02 * np.arange(100)
    run = Run("run", t, np.zeros((100, 4)), np.arange(100.0)[:, None], ((0, 100),))
    there = SensorDelay().undo(run, system, {"force": 0.04})
    (segment,) = there.segments
    assert segment == (0, 98)
    assert (there.u[:98, 0] == np.arange(2.0, 100.0)).all()
    assert (there.x == run.x).all()
    with pytest.raises(ConfigError, match="'push' is no state"):
        SensorDelay().undo(run, system, {"push": 0.04})
