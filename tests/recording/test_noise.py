"""What is no noise of a column: samples and rotor speeds that are off by far, and lines that were interpolated."""

import numpy as np
import pytest
from numpy.typing import NDArray

import nsde_torch
from nsde_torch.data import DataSet, Finding, RawRun
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import assemble
from nsde_torch.recording.faults import FAULTS
from nsde_torch.recording.noise import check_interpolated, rotor_glitches, shares
from nsde_torch.systems import make_system
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD, Stub
from tests.helpers.flights import flight

Array = NDArray[np.float64]
T = np.arange(1500) * 0.01


def swing(noise: float) -> Array:
    """States of a spring that swings."""
    x = np.stack((0.4 * np.sin(3 * T), 1.2 * np.cos(3 * T)), 1)
    return x + noise * np.array([1.0, 3.0]) * np.random.default_rng(0).normal(size=x.shape)


def read(x: Array, system: Stub = MSD) -> tuple[DataSet, list[Finding]]:
    """A data set of one run, and its findings but those about inputs."""
    t = T[: len(x)].copy()
    data = assemble([RawRun("run", t, x, np.sin(7 * t)[:, None])], system, kind="test")
    return data, [f for f in data.summary.findings if "input" not in f.kind]


# ---- single samples ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("column", "name", "size"), [(0, "q", 0.2), (1, "q_dot", 0.6)])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_single_samples_that_are_off_are_put_on_the_curve_and_told_by_column_and_row(
    column: int, name: str, size: float, noise: float
) -> None:
    x, rows = swing(noise), [300, 340, 900]
    spoilt = x.copy()
    spoilt[rows, column] += [size, size, -size]
    data, (finding,) = read(spoilt.copy())
    assert (finding.kind, finding.action, finding.count) == ("glitch", "interpolated", 3)
    assert (finding.values["column"], finding.values["rows"]) == (name, rows)
    assert data.runs[0].segments == ((0, len(x)),)
    assert np.abs(data.runs[0].x - x).max() < 15 * noise + 1e-3
    assert (np.delete(data.runs[0].x, rows, 0) == np.delete(x, rows, 0)).all()


def test_samples_that_are_off_are_found_beside_one_another_and_beside_missing_rows() -> None:
    """Three within a second, two of them neighbours: none stood out of a neighbourhood that held the others."""
    x, rows = swing(0.003), [300, 320, 340, 341, 700, 705]
    spoilt = x.copy()
    spoilt[rows, 1] += [0.6, -0.5, 0.7, 0.6, -0.6, 0.6]
    kept = np.delete(np.arange(len(x)), [301, 698, 703])
    run = RawRun("run", T[kept], spoilt[kept], np.sin(7 * T[kept])[:, None])
    data = assemble([run], MSD, kind="test")
    (finding,) = [f for f in data.summary.findings if f.kind == "glitch"]
    assert [round(float(T[kept][row]), 2) for row in finding.values["rows"]] == [row / 100 for row in rows]
    assert np.abs(data.runs[0].x[:, 1] - 1.2 * np.cos(3 * data.runs[0].t)).max() < 0.05


def test_what_moves_suddenly_is_kept() -> None:
    """A blow, a bounce, a force that changes its sign, ringing, and a coarse sensor."""
    blow, ringing = swing(0.0), swing(0.0)
    blow[700:] -= 1.5 * np.stack((T[700:] - T[700], np.ones(len(T) - 700)), 1)
    bounce = np.abs(np.mod(T, 2.0) - 1.0) - 0.5
    ball = np.stack((bounce, np.where(np.mod(T, 2.0) < 1.0, -1.0, 1.0)), 1)
    sawtooth = np.stack((np.cumsum(bounce) * 0.01, bounce), 1)
    later = np.arange(len(T) - 700)
    ringing[700:, 1] += 0.5 * np.exp(-later / 3.0) * np.cos(np.pi * 0.6 * later)
    coarse = np.round(swing(0.0) / 0.02) * 0.02
    cases = {"blow": blow, "ball": ball, "saw": sawtooth, "ringing": ringing, "coarse": coarse}
    for name, x in cases.items():
        assert [f.kind for f in read(x)[1] if f.kind in ("glitch", "frozen_rows", "sensor_end")] == [], name


def test_a_glitch_of_a_quaternion_and_of_an_angle_leave_unit_norm_and_wraps_in_order() -> None:
    t, x, u = flight(12.0)
    spoilt = x.copy()
    spoilt[400, 6:10] = [0.5, 0.5, -0.5, 0.5]
    data = assemble([RawRun("run", t, spoilt, u)], HEXACOPTER, kind="test")
    assert np.abs(np.abs((data.runs[0].x[:, 6:10] * x[:, 6:10]).sum(1)) - 1).max() < 1e-5
    theta = 8.0 * np.sin(0.7 * T)
    wrapped = np.stack((np.sin(T), np.cos(T), theta, 5.6 * np.cos(0.7 * T)), 1)
    wrapped[600, 2] += 1.0
    wrapped[:, 2] = np.mod(wrapped[:, 2] + np.pi, 2 * np.pi) - np.pi
    data, findings = read(wrapped, CARTPOLE)
    assert np.abs(data.runs[0].x[:, 2] - theta).max() < 1e-3
    assert {f.kind for f in findings} == {"angle_wrap", "glitch"}


# ---- speeds of rotors --------------------------------------------------------------------------------------

MOST = 20_000.0


def speeds(seed: int) -> Array:
    """Speeds of a rotor behind its lag, in steps of 10 rpm, at 50 Hz in a log at 100 Hz (6000,)."""
    rng = np.random.default_rng(seed)
    share, out = 0.4, np.empty(6000)
    command = np.clip(0.4 + 0.1 * np.repeat(rng.standard_normal(600), 10), 0.05, 1)
    for k in range(6000):
        share += 0.25 * (command[k] - share)
        out[k] = share
    return 10 * np.round(0.1 * MOST * np.sqrt(out))[2 * (np.arange(6000) // 2)]


@pytest.mark.parametrize("seed", range(2))
def test_glitches_of_a_rotor_are_found_and_nothing_else_is(seed: int) -> None:
    clean = speeds(seed)
    assert not rotor_glitches(clean, MOST).any()
    rng = np.random.default_rng(seed + 100)
    rows = rng.choice(np.arange(10, 5990, 8), 40, replace=False)
    bad = clean.copy()
    bad[rows[:20]], bad[rows[20:]] = MOST * rng.uniform(3, 12, 20), 0.0
    share, found = shares(bad, MOST, name="u_1", where="run 'a'")
    assert sorted(found) == sorted(rows.tolist())
    np.testing.assert_allclose(share, np.square(clean / MOST), atol=0.08)
    np.testing.assert_allclose(np.delete(share, rows), np.square(np.delete(clean, rows) / MOST))


def test_speeds_in_another_unit_are_refused() -> None:
    for factor, words in (
        (7, r"run 'a': rotor speed 'u_1' is at most .* in nine rows of ten"),
        (0.02, "turns"),
    ):
        with pytest.raises(DataError, match=words):
            shares(factor * speeds(0), MOST, name="u_1", where="run 'a'")


def test_speeds_come_back_as_the_commands_they_were_made_of() -> None:
    t, x, u = flight(20.0)
    run, fault = RawRun("a", t, x, u.copy()), FAULTS["rotor_speed"]
    fault.simulate(run, MOST, HEXACOPTER, dt=0.01, rng=np.random.default_rng(0))
    assert run.u.max() > 1000
    run.u[500, 2] = 10 * MOST
    fault.undo_raw(run, HEXACOPTER, {"u": MOST})
    np.testing.assert_allclose(np.delete(run.u, 500, axis=0), np.delete(u, 500, axis=0), atol=1e-9)
    (note,) = run.notes
    assert (note.kind, note.count, note.action) == ("input_glitch", 1, "interpolated")
    assert note.values["column"] == "u_3"
    with pytest.raises(ConfigError, match="'rpm' is no input of system 'hexacopter'"):
        fault.undo_raw(run, HEXACOPTER, {"rpm": MOST})
    with pytest.raises(ConfigError, match="must be a speed above 0"):
        fault.undo_raw(run, HEXACOPTER, {"u": 0.0})


# ---- lines between every few rows --------------------------------------------------------------------------


@pytest.fixture
def log() -> list[RawRun]:
    (run,) = nsde_torch.simulate("mass_spring_damper", durations=[10.0], seed=5).runs
    return [RawRun("a", run.t, run.x, run.u)]


def told(runs: list[RawRun], *, system: str = "mass_spring_damper") -> list[Finding]:
    out: list[Finding] = []
    check_interpolated(make_system(system), runs, 0.01, out.append)
    return out


@pytest.mark.parametrize("every", [3, 10])
def test_lines_between_every_few_rows_are_told_with_their_rate(log: list[RawRun], every: int) -> None:
    k = np.arange(len(log[0].t))
    log[0].x = np.stack([np.interp(k, k[::every], c[::every]) for c in log[0].x.T], 1)
    (finding,) = told(log)
    assert finding.values["states"] == ["q", "q_dot"]
    assert finding.values["rows"] == pytest.approx(every, rel=0.15)
    assert "interpolated" in finding.message


def test_raw_coarse_and_resting_sensors_are_not_told(log: list[RawRun]) -> None:
    assert not told(log)
    for x in (np.round(log[0].x, 2), 0.0 * log[0].x):
        log[0].x = x
        assert not told(log)


def swinging(noise: float) -> RawRun:
    """A pole that goes round and about its lower rest at pi, 50 Hz, its angle wrapped."""
    rng = np.random.default_rng(1)
    t = 0.02 * np.arange(1500)
    angle = np.pi + 0.9 * np.sin(2.0 * t) + noise * rng.standard_normal(len(t))
    rate = 1.8 * np.cos(2.0 * t) + noise * rng.standard_normal(len(t))
    still = noise * rng.standard_normal((2, len(t)))
    x = np.stack([*still, np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi, rate], 1)
    return RawRun("a", t, x, np.zeros((len(t), 1)))


@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_wraps_of_an_angle_are_no_knots(noise: float) -> None:
    run = swinging(noise)
    assert (np.abs(np.diff(run.x[:, 2])) > np.pi).sum() > 10
    assert not told([run], system="cartpole")
    run.x[5::50, 2] = np.nan
    assert not told([run], system="cartpole")
