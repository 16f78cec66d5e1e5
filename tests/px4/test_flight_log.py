"""What was flown is a data set of the package."""

from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.flight_log import FlightLog, UlogFile
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.recording import read
from nsde_torch.systems import make_system
from tests.helpers.px4_world import World


def test_a_flight_is_read_back_as_a_run_with_states_motors_and_setpoints(tmp_path: Path) -> None:
    world = World(path=PathPoints(shapes.hover(duration=2.0, height=1.0)))
    # PX4 counts from where it was switched on, a log from the place of take-off
    world.body.p = (40.0, -7.0, 0.0)
    with FlightLog(tmp_path / "log" / "flight_0.csv", 4) as log:
        recorder = Recorder(world.flight, log)
        world.run(lambda w: recorder.look(w.now))
        report = recorder.finish()
    assert report.log is not None
    assert report.rmse == pytest.approx(world.rmse, abs=0.02)
    assert report.as_dict()["landed"] is True
    logged = np.loadtxt(report.log, delimiter=",", skiprows=1)
    # every state of PX4's estimator, at its own step
    steps = np.diff(logged[:, 0])
    assert np.median(steps) == pytest.approx(0.008, abs=1e-5)
    assert (steps < 0.0081).mean() > 0.97
    data = read("csv", make_system("quadrotor"), path=tmp_path / "log")
    run = data.runs[0]
    assert run.t[-1] - run.t[0] > 3.0
    assert run.x[:, 2].min() > 0.2
    assert np.abs(run.x[:, :2]).max() < 0.5
    assert world.body.p[:2] == pytest.approx((40.0, -7.0), abs=0.5)
    hovering = run.u[(run.x[:, 2] > 0.9)].mean()
    assert hovering == pytest.approx(world.body.hover_throttle(), abs=0.03)
    assert {"rate_sp_x", "throttle_sp", "battery_voltage"} <= set(run.extra)
    # the same flight as PX4's own log, through NED, FRD and 32 bits
    (same,) = read("ulog", make_system("quadrotor"), path=tmp_path / "log").runs
    assert same.t == pytest.approx(run.t, abs=2e-6)
    assert np.abs(same.x - run.x).max() < 1e-5
    assert np.abs(same.u - run.u).max() < 1e-6
    assert same.extra["battery_voltage"] == pytest.approx(run.extra["battery_voltage"], abs=1e-4)


def test_landing_is_px4s_and_not_logged_though_the_estimate_sinks_at_touch_down(tmp_path: Path) -> None:
    world = World(path=PathPoints(shapes.hover(duration=2.0, height=1.0)))
    believed: list[tuple[float, float]] = []
    with FlightLog(tmp_path / "flight_0.csv", 4) as log:
        recorder = Recorder(world.flight, log)

        def look(w: World) -> None:
            recorder.look(w.now)
            if w.body.on_ground and w.vehicle.flown:
                believed.append((w.vehicle.estimate[0][2], w.vehicle.estimate[1][2]))

        world.run(look)
    assert world.flight.outcome.landed
    assert world.safe
    # as the real one did at 0.7 m/s: speed is kept, half a metre is sunk
    assert min(v for _, v in believed) == pytest.approx(-0.7, abs=0.2)
    assert min(p for p, _ in believed) == pytest.approx(-0.45, abs=0.2)
    landing = next(t for t, phase, _ in world.flight.outcome.actions if phase == "land")
    rows = np.loadtxt(tmp_path / "flight_0.csv", delimiter=",", skiprows=1)
    assert rows[-1, 0] < landing * world.speed + 0.02
    assert rows[:, 3].min() > 0.25


def test_the_ulog_is_read_by_pyulog_with_the_setpoints_in_frd(tmp_path: Path) -> None:
    log = UlogFile(tmp_path / "flight.ulg", 5.0)
    for k in range(3):
        stamp, still = 5.0 + 0.01 * k, (1.0, 0.0, 0.0, 0.0)
        state = VehicleState(stamp, stamp, stamp, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), still, (0.0, 0.5, 0.0))
        nothing = float("nan")  # motors and voltage are not known: left out
        log.add(state, (nothing,) * 4, (stamp, (0.1, 0.2, 0.3), 0.4), nothing)
    log.close()
    read_back = ULog(str(tmp_path / "flight.ulg"))
    assert {d.name for d in read_back.data_list} == {"vehicle_odometry", "vehicle_rates_setpoint"}
    asked = read_back.get_dataset("vehicle_rates_setpoint").data
    assert [asked[k][0] for k in ("roll", "pitch", "yaw")] == pytest.approx([0.1, -0.2, -0.3])
    assert asked["thrust_body[2]"][0] == pytest.approx(-0.4)
    state = read_back.get_dataset("vehicle_odometry").data
    assert [state[f"position[{k}]"][0] for k in range(3)] == [2.0, 1.0, -3.0]
    assert list(state["timestamp"]) == [5_000_000, 5_010_000, 5_020_000]
