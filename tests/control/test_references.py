"""References: closed forms, minimum snap, files, and whether a machine can fly them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, make_interp_spline

from nsde_torch.control import feasible
from nsde_torch.control.options import ProblemOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.shapes import circle, from_csv, hover, lemniscate, waypoints
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.plots.data_figure import roll_pitch_yaw
from nsde_torch.rotation import gravity_direction, rotate_back
from nsde_torch.systems import System

POINTS = [[0, 0, 1], [2, 0, 1.5, 45], [2, 2, 1.0, 90], [0, 2, 1.2, 90]]


@pytest.mark.parametrize(
    ("path", "speed", "seconds", "angles"),
    [(circle(), 3.6, 35.0, (32, 32, 125)), (lemniscate(), 3.4, 40.0, (34, 21, 16))],
)
def test_closed_forms_have_the_supplements_speed_length_and_angles(
    path: FlightPath, speed: float, seconds: float, angles: tuple[float, ...]
) -> None:
    states = Reference(path).states
    assert float(states[:, 3:6].norm(dim=1).max()) == pytest.approx(speed, rel=1e-3)
    assert path.duration == pytest.approx(seconds)
    largest = np.abs(roll_pitch_yaw(states[:, 6:10].numpy())).max(0)
    assert (largest < np.array(angles)).all()
    assert (largest > 0.8 * np.array(angles)).all()


@pytest.mark.parametrize("path", [circle(), lemniscate(), hover(), waypoints(POINTS)])
def test_velocities_and_accelerations_are_derivatives_and_ends_are_at_rest(path: FlightPath) -> None:
    assert np.abs(np.gradient(path.p, path.dt, axis=0) - path.v)[1:-2].max() < 5e-3
    assert np.abs(np.gradient(path.v, path.dt, axis=0) - path.a)[1:-2].max() < 5e-2
    assert np.abs(path.v[[0, -1]]).max() < 1e-9
    assert np.abs(path.a[[0, -1]]).max() < 1e-9


def test_states_point_the_thrust_along_acceleration_and_gravity_and_turn_as_the_rates_say() -> None:
    reference = Reference(circle())
    x, a = reference.states, torch.from_numpy(circle().a)
    force = rotate_back(x[:, 6:10], a + torch.tensor([0.0, 0.0, 9.81]).double())
    assert float(force[:, :2].abs().max()) < 1e-6
    up = gravity_direction(x[:, 6:10])
    turning = torch.gradient(up, spacing=0.01, dim=0)[0] + torch.linalg.cross(x[:, 10:13], up)
    assert float(turning[2:-2].abs().max()) < 2e-3


def test_a_window_starts_a_step_ahead_and_rests_after_the_end() -> None:
    reference = Reference(lemniscate())
    window = reference.window(10.0, dt=0.05, steps=20)
    assert torch.allclose(window[0], reference.states[1005])
    assert torch.allclose(window[-1], reference.states[1100])
    after = reference.window(60.0, dt=0.05, steps=3)
    assert torch.allclose(after[:, :3], reference.states[-1, :3].expand(3, 3))
    assert float(after[:, 3:6].abs().max()) == 0.0


def test_minimum_snap_passes_its_points_at_their_times_and_no_other_path_has_less_snap() -> None:
    times = [0.0, 2.0, 4.5, 6.0]
    path = waypoints(POINTS, times=times)
    for point, t in zip(POINTS, times, strict=True):
        assert np.allclose(path.p[round(t / path.dt)], point[:3], atol=1e-9)
    assert path.yaw[-1] == pytest.approx(np.pi / 2)

    def snap(spline: BSpline) -> float:
        return float(np.trapezoid(spline(np.linspace(0, 6, 4001), 4) ** 2, dx=6 / 4000))

    rest = [(1, 0.0), (2, 0.0), (3, 0.0)]
    x = [p[0] for p in POINTS]
    best = make_interp_spline(times, x, k=7, bc_type=(rest, rest))
    assert np.allclose(path.p[:, 0], best(path.dt * np.arange(len(path.p)).clip(max=600)), atol=1e-9)
    # through one point more, which the best path does not pass: still through all the others, at rest at both ends
    through = [0.0, 1.0, *times[1:]], [0.0, float(best(1.0)) + 0.05, *x[1:]]
    other = make_interp_spline(*through, k=7, bc_type=(rest, rest))
    assert snap(other) > snap(best)


def test_a_file_of_waypoints_is_read_with_its_times(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("t,p_x,p_y,p_z,yaw\n5,0,0,1,0\n7,1,0,1,0.5\n9,1,1,1,1.0\n")
    path = from_csv(file)
    assert path.name == "way"
    assert path.duration == pytest.approx(4.0, abs=0.011)
    assert np.allclose(path.p[200], [1, 0, 1])
    assert path.yaw[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [("a,b\n1,2\n", "no column p_x"), ("p_x,p_y,p_z\n0,0,one\n1,1,1\n", "no number"), ("", "no rows")],
)
def test_files_that_hold_no_waypoints_are_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(DataError, match=words):
        from_csv(file)


@pytest.mark.parametrize(
    ("points", "options", "words"),
    [
        ([[0, 0, 1]], {}, "two or more"),
        ([[0, 0], [1, 1]], {}, "two or more"),
        ([[0, 0, 1], [0, 0, 1]], {}, "the same"),
        (POINTS, {"times": [0, 1, 1, 2]}, "increase"),
        (POINTS, {"speed": 0.0}, "above 0"),
    ],
)
def test_points_that_make_no_path_are_refused(
    points: list[list[float]], options: dict[str, object], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        waypoints(points, **options)  # type: ignore[arg-type]


def test_the_envelope_of_hovering_is_the_hover_command(declared: System) -> None:
    found = feasible.check(Reference(hover()), Predictor(declared, dt=0.05), ProblemOptions())
    # thrust 4.6 sum(u) - 1 = 9.81
    assert found.input_low == pytest.approx((9.81 + 1.0) / 4.6 / 6, abs=1e-4)
    assert found.input_high == pytest.approx(found.input_low, abs=1e-4)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (lemniscate(speed=7.0), "deg at"),
        (circle(speed=6.0, yaw=0.0), "deg at"),
        (hover(height=-1.0), "below the ground"),
        (waypoints([[0, 0, 1, 0], [0, 0, 1, 720]], times=[0.0, 3.0]), "a command of"),
    ],
)
def test_what_a_machine_cannot_fly_is_refused_with_what_and_when(
    declared: System, path: FlightPath, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        feasible.check(Reference(path), Predictor(declared, dt=0.05), ProblemOptions(), tilt=50.0)
