"""What was flown is a data set of the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.data import read
from nsde_torch.px4.flight import Recorder
from nsde_torch.px4.flight_log import FlightLog
from nsde_torch.px4.path import PathPoints
from nsde_torch.systems import make_system
from tests.helpers.px4_world import World


def test_a_flight_is_read_back_as_a_run_with_states_motors_and_setpoints(tmp_path: Path) -> None:
    world = World(path=PathPoints(shapes.hover(duration=2.0, height=1.0)))
    with FlightLog(tmp_path / "log" / "flight_0.csv", 4) as log:
        recorder = Recorder(world.flight, log)
        world.run(lambda w: recorder.look(w.now))
        report = recorder.finish()
    assert report.log is not None
    assert report.rmse == pytest.approx(world.rmse, abs=0.02)
    assert report.as_dict()["landed"] is True
    logged = np.loadtxt(report.log, delimiter=",", skiprows=1)
    # steps of 8 and 12 ms, those of the rate loop
    assert np.diff(logged[:, 0]).mean() == pytest.approx(1 / 99, rel=0.02)
    data = read("csv", make_system("quadrotor"), path=tmp_path / "log")
    run = data.runs[0]
    assert run.t[-1] - run.t[0] > 3.0
    assert run.x[:, 2].min() > 0.2
    hovering = run.u[(run.x[:, 2] > 0.9)].mean()
    assert hovering == pytest.approx(world.body.hover_throttle(), abs=0.03)
    assert {"rate_sp_x", "throttle_sp", "battery_voltage"} <= set(run.extra)
