"""What stands still: frozen logs and sensors at their end are cut out, so is time on the ground; rest is kept."""

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Finding, RawRun
from nsde_torch.data.system_info import changed
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD
from tests.helpers.flights import flight

Array = NDArray[np.float64]
T = np.arange(2000) * 0.01

# ---- rows that repeat --------------------------------------------------------------------------------------


def swing(noise: float = 0.003) -> Array:
    """States of a spring that swings."""
    q = 0.4 * np.sin(2 * T) + 0.1 * np.sin(3.3 * T)
    x = np.stack((q, 0.8 * np.cos(2 * T) + 0.33 * np.cos(3.3 * T)), 1)
    return x + noise * np.array([1.0, 3.0]) * np.random.default_rng(0).normal(size=x.shape)


def read(x: Array) -> tuple[DataSet, list[Finding]]:
    """A data set of one run, and what was found about rows that repeat."""
    data = assemble([RawRun("run", T.copy(), x, np.sin(7 * T)[:, None])], MSD, kind="test")
    return data, [f for f in data.summary.findings if f.kind in ("frozen_rows", "sensor_end", "glitch")]


@pytest.mark.parametrize("at", [500, 620, 740])
def test_rows_of_a_log_that_froze_are_cut_out(at: int) -> None:
    x = swing()
    x[at : at + 30] = x[at]
    data, (finding,) = read(x)
    assert (finding.kind, finding.action, finding.count) == ("frozen_rows", "dropped", 29)
    assert data.runs[0].segments == ((0, at + 1), (at + 1, len(x) - 29))


@pytest.mark.parametrize(("column", "name"), [(0, "q"), (1, "q_dot")])
def test_one_sensor_that_repeats_itself_while_the_other_moves_is_cut_out_by_name(
    column: int, name: str
) -> None:
    x = swing()
    x[500:600, column] = x[500, column]
    _, (finding,) = read(x)
    assert (finding.kind, finding.values["column"], finding.count) == ("frozen_rows", repr(name), 99)


@pytest.mark.parametrize(("noise", "found"), [(0.01, ["sensor_end"]), (0.0, [])])
def test_a_level_without_a_rate_that_stands_at_its_highest_is_the_sensor_s_end_and_not_at_nothing(
    noise: float, found: list[str]
) -> None:
    tank = changed(MSD, state_names=("level",), state_units=("V",), position_derivatives=())
    level = 6.0 + 5.0 * np.sin(0.5 * T) + noise * np.random.default_rng(0).normal(size=len(T))
    level = np.minimum(np.round(level, 4), 10.0)
    level[:100] = 0.0  # it is empty as the log begins
    data = assemble([RawRun("run", T.copy(), level[:, None], np.sin(7 * T)[:, None])], tank, kind="test")
    ends = [f for f in data.summary.findings if f.kind == "sensor_end"]
    assert [f.kind for f in ends] == found  # of a tank without noise it may be an overflow
    assert sum(f.count for f in ends) == (level == 10.0).sum() * bool(found)


@pytest.mark.parametrize(("column", "end"), [(0, 0.3), (1, 0.7)])
def test_a_sensor_at_its_end_is_cut_out_with_column_and_value(column: int, end: float) -> None:
    x = swing()
    beyond = np.abs(x[:, column]) > end
    x[:, column] = np.clip(x[:, column], -end, end)
    data, findings = read(x)
    assert {(f.kind, f.values["value"]) for f in findings} == {("sensor_end", -end), ("sensor_end", end)}
    assert sum(f.count for f in findings) == pytest.approx(beyond.sum(), rel=0.1)
    kept = np.concatenate([data.runs[0].x[a:b, column] for a, b in data.runs[0].segments])
    assert (np.abs(kept) == end).mean() < 0.005


def test_a_gyroscope_at_its_end_is_found_against_the_attitude() -> None:
    t, x, u = flight(20.0)
    end = float(np.quantile(np.abs(x[:, 11]), 0.8))
    x[:, 11] = np.clip(x[:, 11], -end, end)
    data = assemble([RawRun("run", t, x, u)], HEXACOPTER, kind="test")
    found = [f for f in data.summary.findings if f.kind == "sensor_end"]
    assert {f.values["column"] for f in found} == {"'w_y'"}


def test_rest_coarse_sensors_and_slow_ones_are_kept() -> None:
    """Machines at rest before exact and coarse sensors, a rate with a bias there, a stop, and a sample that is held."""
    rng = np.random.default_rng(2)
    phase = 2 * np.pi * np.clip(np.mod(T, 5.0) - 1.0, 0.0, None) / 4.0
    moves = np.stack((1.0 - np.cos(phase), 0.5 * np.pi * np.sin(phase)), 1)
    noisy = moves + np.array([0.003, 0.01]) * rng.normal(size=moves.shape)
    biased = moves + np.array([0.0, 0.03])
    biased[:, 1] += 0.02 * rng.normal(size=len(T))
    stop, slow, fine = swing(0.0), swing(0.0), swing(0.0)
    stop[stop[:, 0] > 0.3] = [0.3, 0.0]
    slow[:, 0] = np.repeat(fine[::20, 0], 20)
    coarse, tooth = np.round(noisy / [0.02, 0.05]) * [0.02, 0.05], np.round(fine / 0.05) * 0.05
    cases = {"rest": moves, "noisy": noisy, "coarse": coarse, "biased": biased}
    cases |= {"stop": stop, "slow": slow, "tooth": tooth}
    for name, x in cases.items():
        assert read(x)[1] == [], name


# ---- columns of one value ----------------------------------------------------------------------------------


def poles(noise: float = 0.0) -> tuple[Array, Array]:
    t = np.arange(600) * 0.02
    x = np.stack((np.sin(t), np.cos(t), 0.3 * np.sin(3 * t), 0.9 * np.cos(3 * t)), 1)
    return t, x + noise * np.random.default_rng(0).normal(size=x.shape)


def after_sound_runs(x: Array, t: Array, sound: int) -> DataSet:
    states = [*(poles()[1] for _ in range(sound)), x]
    runs = [RawRun(f"run_{k}", t.copy(), s, np.sin(7 * t)[:, None]) for k, s in enumerate(states)]
    return assemble(runs, CARTPOLE, kind="test")


@pytest.mark.parametrize(("column", "name", "other"), [(2, "theta", "theta_dot"), (1, "x_dot", "x")])
@pytest.mark.parametrize("sound", [0, 2])
def test_a_column_that_stands_still_while_its_partner_moves_is_refused_by_name(
    column: int, name: str, other: str, sound: int
) -> None:
    t, x = poles(0.01)
    x[:, column] = 0.25
    with pytest.raises(DataError, match=rf"'run_{sound}': '{name}' never changes \(0.25 .*'{other}' does"):
        after_sound_runs(x, t, sound)


def test_a_pole_that_is_locked_is_reported_with_the_remedy_and_not_refused() -> None:
    t, x = poles()
    x[:, 2], x[:, 3] = 0.0, 0.01 * np.random.default_rng(0).normal(size=len(t))  # the rate is noise
    data = after_sound_runs(x.copy(), t, 0)
    (finding,) = (f for f in data.summary.findings if f.kind == "constant_state")
    assert finding.values["states"] == ["theta"]
    assert "record runs in which they move" in finding.message
    moves = after_sound_runs(x, t, 1)  # in the other run
    assert all(f.kind != "constant_state" for f in moves.summary.findings)


@pytest.mark.parametrize(("columns", "name"), [(slice(6, 10), "the quaternion"), (slice(11, 12), "'w_y'")])
def test_an_attitude_or_a_gyroscope_that_stands_still_in_a_turning_flight_is_refused(
    columns: slice, name: str
) -> None:
    t, x, u = flight(20.0)
    x[:, columns] = x[0, columns]
    with pytest.raises(DataError, match=f"{name} never changes"):
        assemble([RawRun("a", t, x, u)], HEXACOPTER, kind="test")


# ---- time on the ground ------------------------------------------------------------------------------------

STAND = 300  # rows


def log(command: float, *, noise: float = 0.02, rise: int = 0) -> tuple[Array, Array, Array]:
    """A machine that stands still for three seconds on a command, which then rises, and flies for 20 s."""
    t, x, u = flight(20.0)
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.clip(np.arange(len(t)) / 100, 0, 1))
    still, moving = np.tile(x[0], (STAND, 1)), [3, 4, 5, 10, 11, 12]
    still[:, moving] = 0.0
    x[:, moving] *= ramp[:, None]  # it starts from rest
    x[:, 2] += ramp
    states = np.concatenate((still, x))
    states[:, moving] += noise * np.random.default_rng(0).normal(size=(len(states), 6))
    before = np.full(STAND, command)
    if rise:
        before[-rise:] = np.linspace(command, 0.35, rise)
    inputs = np.concatenate((np.repeat(before[:, None], 6, axis=1), u))
    return 0.01 * np.arange(len(states)), states, inputs


def on_ground(t: Array, x: Array, u: Array, *, system: object = HEXACOPTER) -> tuple[DataSet, list[Finding]]:
    data = assemble([RawRun("log", t, x, u)], system, kind="test", clock="trust")  # type: ignore[arg-type]
    return data, [f for f in data.summary.findings if f.kind == "on_ground"]


@pytest.mark.parametrize("rise", [0, 60])
def test_a_machine_that_stands_still_on_low_commands_is_on_the_ground_until_it_moves(rise: int) -> None:
    data, (finding,) = on_ground(*log(0.1, rise=rise))
    assert finding.action == "dropped"
    assert STAND - 5 <= finding.count <= STAND + 45
    assert data.runs[0].t[0] == pytest.approx(3.0, abs=0.45)
    assert "3" in finding.message
    assert "% of the commands of flight" in finding.message


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_hover_that_is_perfectly_still_is_kept(noise: float) -> None:
    data, findings = on_ground(*log(0.4, noise=noise))
    assert findings == []
    assert data.runs[0].segments[0][0] == 0


def test_a_short_drop_of_the_commands_in_flight_is_no_ground() -> None:
    t, x, u = log(0.4)
    u[800:900] *= 0.3  # it dives
    assert on_ground(t, x, u)[1] == []


def test_a_log_that_never_leaves_the_ground_beside_one_that_flies_is_refused_by_name() -> None:
    t, x, u = log(0.1)
    parked = RawRun("parked", t[:STAND].copy(), x[:STAND].copy(), u[:STAND].copy())
    with pytest.raises(DataError, match=r"'parked': the machine stands on the ground throughout\. Leave"):
        assemble([RawRun("log", t, x, u), parked], HEXACOPTER, kind="test", clock="trust")
